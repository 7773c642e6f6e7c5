"""Scores and verdicts of the accuracy benchmarks: held-out worlds, dirt, ablation, conditions."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.accuracy import ablation, accuracy, conditions
from bench.accuracy.choices import KeyframeView, right
from bench.accuracy.conditions import Variant, rings, spoilt
from bench.harness.worlds import TUNED_SEEDS
from bench.tracking.drives import scenarios
from coview_stream.clouds import read_cloud, write_cloud, write_tum
from coview_stream.errors import InputError
from coview_stream.geometry.transforms import inverse, pose_from, rot_z
from coview_stream.sim import Dirt, SimulationConfig
from coview_stream.sim.dirt import KINDS_OF_DIRT

TINY = SimulationConfig("town", "os64", seed=1, size=120.0, length=9.0, density=10.0)
ERRORS = {"mean": 0.02, "rmse": 0.03, "median": 0.02, "max": 0.05}


def made_up(**changes):
    row = {
        "name": "town-os64-1", "run": TINY.to_dict(), "outside": False,
        "frames": 10, "posed": 9, "success": True, "false_frames": 0, "first_fix_m": 4.0,
        "translation": ERRORS, "rotation": ERRORS, "megabytes": 500.0,
    }  # fmt: skip
    return row | changes


def outside(**changes):
    return made_up(outside=True, posed=0, translation=None, rotation=None) | changes


def missed(rows):
    return {row.name.partition("/")[2] for row in accuracy.verdicts(rows) if not row.holds}


def test_reported_seeds_are_not_those_of_tuning():
    groups = [
        {world.seed for world in accuracy.held_out_worlds()},
        {world.seed for world in accuracy.DIRTY_WORLDS},
        {world["seed"] for world in ablation.WORLDS.values()},
        {scenario.world.seed for scenario in scenarios()},
        set(TUNED_SEEDS),
    ]
    assert len(groups[0]) == 24
    assert groups[3] == set(range(5001, 5011))
    assert sum(map(len, groups)) == len(set.union(*groups))


def test_outside_runs_are_on_the_map_of_another_world_of_the_same_kind():
    assert [run == site for run, site in accuracy.pairs(quick=True)] == [True, True, False]
    for run, site in accuracy.pairs():
        assert run.scene == site.scene
        assert (run.seed == site.seed) == (run == site)


@pytest.mark.parametrize(
    ("rows", "targets"),
    [
        ([made_up(), outside()], set()),
        ([made_up(success=False), outside()], {"runs localized"}),
        ([made_up(false_frames=1), outside()], {"false frames"}),
        ([made_up(translation={"mean": 0.09}), outside()], {"mean translation error, m"}),
        ([made_up(rotation={"mean": 0.31}), outside()], {"mean rotation error, deg"}),
        ([made_up(first_fix_m=None), outside()], {"median first fix"}),
        ([made_up(), outside(posed=1, success=False)], {"outside: poses"}),
        ([made_up(megabytes=1600.0), outside()], {"peak memory of locate"}),
    ],
)
def test_each_target_can_be_missed(rows, targets):
    assert missed(rows) == targets


def test_a_crash_costs_one_row(tmp_path):
    def crash(work, *args):
        raise MemoryError("too large")

    row = accuracy.run_one(tmp_path, TINY, TINY, crash)
    assert row["error"] == "MemoryError: too large"
    assert "runs localized" in missed([row])
    assert accuracy.figures(row)["name"] == "town-os64-1!"


def test_kinds_of_dirt_are_clean_each_alone_and_all_at_once():
    worlds = [accuracy.dirty(TINY, kind) for kind in accuracy.DIRTS]
    assert worlds[0].dirt == Dirt()
    assert [world.dirt.kinds for world in worlds[1:-1]] == [(kind,) for kind in KINDS_OF_DIRT]
    assert worlds[-1].dirt.kinds == KINDS_OF_DIRT
    assert {replace(world, dirt=Dirt()) for world in worlds} == {TINY}


@pytest.mark.parametrize(("kind", "own_map"), [("none", False), ("rain", False), ("years", True), ("real", True)])
def test_a_map_is_made_anew_only_where_the_dirt_concerns_it(kind, own_map, tmp_path):
    made = []

    def call(work, *args):
        made.append((work, *args))
        return made_up()

    row = accuracy.dirty_run(tmp_path, TINY, kind, call)
    config = accuracy.dirty(TINY, kind)
    assert (accuracy.prepare, tmp_path, config if own_map else TINY) in made
    assert made[-1][0] is accuracy.measure
    assert made[-1][2].parent.name == accuracy.world_name(config if own_map else TINY)
    assert (made[-1][3], row["outside"]) == (True, False)


def test_totals_count_a_lost_run_as_endless_and_without_poses():
    lost = made_up(success=False, posed=0, first_fix_m=None, translation=None, rotation=None)
    row = accuracy.total("snow", [made_up(), lost, lost])
    assert row.ours == 30.0
    assert (row.details["found"], row.details["first_fix_m"], row.details["rmse_t"]) == ("1 of 3", np.inf, 0.03)


def test_rows_of_the_ablation_add_sites_up():
    one = {"keyframes": 4, "top1": 3, "top10": 4, "windows": 0, "coarse": 0, "seconds": 2.0, "stations": 9}
    row = ablation.search_row("channels", "a", {"x": one, "y": one | {"top1": 0, "windows": 2, "coarse": 1}})
    assert row.ours == 37.5
    shown = ("top1", "top10", "coarse", "ms", "x", "y")
    assert [row.details[key] for key in shown] == [0.375, 1.0, 0.5, 500, 0.75, 0.0]
    known = {"success": True, "false_frames": 0, "posed": 5, "first_fix_m": 4.0, "e_t": 0.02, "e_r": 0.1, "ms": 3.0}
    located = {"x": one | {"located": known}, "y": one | {"located": known | {"first_fix_m": 8.0, "false_frames": 1}}}
    row = ablation.search_row("channels", "a", located)
    assert (row.details["first"], row.details["worst"], row.details["false"]) == (6.0, 8.0, "1 of 10")
    lost = known | {"success": False, "posed": 0, "first_fix_m": None, "e_t": None, "e_r": None}
    row = ablation.localizer_row("b", {"x": known, "y": lost, "z": lost})
    assert (row.details["right"], row.details["e_t"], row.details["first"]) == ("1 of 3", 0.02, np.inf)
    row = ablation.elsewhere_row("d", {"x": {"posed": 3, "frames": 9}, "y": {"posed": 0, "frames": 4}})
    assert (row.ours, row.details["false"], row.details["runs"]) == (3, "3 of 13", "1 of 2")


@pytest.mark.parametrize(
    ("shift", "degrees", "verdict"), [(2.9, 8.9, True), (3.1, 0.0, False), (0.0, 9.1, False), (0.0, -8.9, True)]
)
def test_a_place_is_right_within_three_metres_and_nine_degrees(shift, degrees, verdict):
    position = np.array([12.0, -5.0, 1.5])
    empty = np.zeros((0, 3), np.float32)
    seen = KeyframeView(empty, position, pose_from(rot_z(1.0), [100.0, 50.0, 3.0]), empty)
    about = pose_from(rot_z(np.radians(degrees)), position + np.array([0.0, shift, 7.0]))
    assert right(seen.T_map_odom @ about @ pose_from(np.eye(3), -position), seen) is verdict


@pytest.fixture
def run():
    """Twenty frames, 2 m apart, on a bend; odometry is the truth in another frame."""
    truth = np.array([pose_from(rot_z(0.05 * k), np.array([2.0 * k, 0.1 * k, 5.0])) for k in range(20)])
    shift = pose_from(rot_z(1.0), np.array([3.0, -2.0, 0.0]))
    return Variant(np.arange(20), 100.0 + 0.5 * np.arange(20), shift @ truth, truth)


def steps(poses):
    return inverse(poses[0]) @ poses[-1], np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)


def test_a_pitched_sensor_sees_the_ground_ahead_rise(run):
    leant = spoilt("sparse3+pitch:2", run, 0)
    assert leant.frames.tolist() == [0, 3, 6, 9, 12, 15, 18]
    point = leant.cloud(np.array([[10.0, 0.0, 0.0]], np.float32))[0]
    np.testing.assert_allclose(point, [10 * np.cos(np.radians(2)), 0.0, -10 * np.sin(np.radians(2))], atol=1e-5)
    np.testing.assert_array_equal(leant.odometry, run.odometry[::3])


def test_bad_odometry_is_too_long_and_its_heading_walks(run):
    straight = spoilt("odo:5:0", run, 0)
    np.testing.assert_allclose(steps(straight.odometry)[1], 1.05 * steps(run.truth)[1], rtol=1e-9)
    wanted = inverse(run.truth[0]) @ run.truth[-1]
    off = [inverse(wanted) @ steps(spoilt("odo:0:0.5", run, seed).odometry)[0] for seed in range(200)]
    degrees = np.std([Rotation.from_matrix(T[:3, :3]).as_euler("xyz", degrees=True)[2] for T in off])
    assert degrees == pytest.approx(0.5 * np.sqrt(steps(run.truth)[1].sum()), rel=0.2)


def test_a_turned_body_sees_the_same_from_behind(run):
    turned = spoilt("rev180", run, 0)
    points = np.random.default_rng(1).normal(size=(30, 3)).astype(np.float32)
    for poses, before in ((turned.truth, run.truth), (turned.odometry, run.odometry)):
        there = turned.cloud(points) @ poses[4, :3, :3].T + poses[4, :3, 3]
        np.testing.assert_allclose(there, points @ before[4, :3, :3].T + before[4, :3, 3], atol=1e-4)


def test_rings_and_range_thin_a_cloud(run):
    elevation, azimuth = np.meshgrid(np.radians(np.linspace(-25, 15, 64)), np.linspace(0, 6.28, 100), indexing="ij")
    around = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    points = 40 * np.stack(around, axis=-1).reshape(-1, 3)
    assert len(rings(points)) == pytest.approx(len(points) / 4, rel=0.3)
    assert len(spoilt("near30", run, 0).cloud(points)) == 0


@pytest.mark.parametrize("wrong", ["fog", "pitch", "pitch:x", "pitch:1:2"])
def test_a_wrong_condition_is_refused_in_words(run, wrong):
    with pytest.raises(InputError, match=wrong.split(":")[0]):
        spoilt(wrong, run, 0)


def test_scores_of_a_trajectory_and_the_verdict_names_the_worst_run(run):
    poses = run.truth[5:15].copy()
    poses[0, 0, 3] += 0.2
    poses[9, 0, 3] += 1.5
    scores = conditions.scored((run.stamps[5:15] + 0.001, poses), (run.stamps, run.truth))
    assert (scores["frames"], scores["posed"], scores["false_frames"]) == (20, 10, 1)
    assert scores["first_fix_m"] == pytest.approx(5 * steps(run.truth)[1][0], rel=1e-6)
    assert scores["first_m"] == pytest.approx(0.2)
    nothing = conditions.scored((np.zeros(0), np.zeros((0, 4, 4))), (run.stamps, run.truth))
    assert (nothing["posed"], nothing["first_m"], nothing["rmse_m"]) == (0, None, None)
    good = conditions.scored((run.stamps, run.truth), (run.stamps, run.truth))
    bad = conditions.scored((run.stamps[:5], run.truth[:5]), (run.stamps, run.truth))
    results = [
        {"set": "street", "density": None, "condition": name, "share": conditions.share(s, good), **s}
        for name, s in (("base", good), ("pitch:2", bad))
    ]
    rows = {row.name: row for row in conditions.verdicts(results)}
    least = rows["conditions/least share, tilt and odometry, %"]
    assert (least.holds, least.text) == (False, "25.0 (street, pitch:2)")
    assert rows["conditions/false frames"].holds


@pytest.mark.slow
def test_holes_leave_so_much_of_the_map_as_is_asked(tmp_path, monkeypatch):
    monkeypatch.setenv("COVIEW_BENCH", str(tmp_path / "work"))
    floor = np.stack(np.meshgrid(*[np.arange(-60.0, 60.0, 0.5)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    frames = tmp_path / "floor" / "run" / "frames"
    frames.mkdir(parents=True)
    write_cloud(tmp_path / "floor" / "base.laz", floor, origin=(1000.0, 2000.0, 0.0))
    poses, near = np.tile(np.eye(4), (3, 1, 1)), np.hypot(*floor[:, :2].T) < 50.0
    write_tum(tmp_path / "floor" / "run" / "odometry.tum", np.arange(3.0), poses)
    poses[:, :3, 3] = (1000.0, 2000.0, 0.0)
    write_tum(tmp_path / "floor" / "truth.tum", np.arange(3.0), poses)
    for k in range(3):
        write_cloud(frames / f"{k}.pcd", floor[near].astype(np.float32))
    real = conditions.set_of("floor", tmp_path)
    for percent in (100.0, 65.0, 20.0):
        cloud, overlap = real.cut(percent)
        assert overlap == pytest.approx(percent, abs=2.0)
        assert len(read_cloud(cloud).points) == pytest.approx(percent / 100.0 * len(floor), rel=0.3)
    with pytest.raises(InputError, match=r"moon-vlp16.*not there"):
        conditions.set_of("moon-vlp16", tmp_path)
