"""What bench.tracking scores, and the drives it makes, on numbers small enough to know the answer."""

import json
from dataclasses import replace

import numpy as np
import pytest

from bench import tracking, tracking_coverage, tracking_run, tracking_worlds
from bench.suite import OWN
from bench.tracking_coverage import AXES, NOMINAL, coverage, pooled, shares, spread
from bench.tracking_drives import (
    CLOTH,
    DUST,
    carried,
    covered,
    drift_share,
    jumped,
    kidnapped,
    over_the_gap,
    restarted,
    scaled,
    seen,
    start,
)
from bench.tracking_plot import draw
from bench.tracking_scenarios import QUICK, Scenario, scenarios
from bench.tracking_scores import Told, errors, losses, recovery, score
from bench.tracking_worlds import GAP, World, earlier, in_gap, open_world
from bench.worlds import TUNED_SEEDS
from coview_stream.geometry import inverse, pose_from, rot_z, tilt_of, yaw_of
from coview_stream.rotation import exp_so3
from coview_stream.sim.scenes import build_scene


def way(count=1500, step=0.2):
    """A winding drive of ``step`` metres a frame, tilted by a degree."""
    heading = 0.6 * np.sin(np.arange(count) * step / 20.0) + 0.3
    steps = step * np.column_stack([np.cos(heading), np.sin(heading), np.zeros(count)])
    tilt = exp_so3(np.radians([1.0, 0.0, 0.0]))
    places = np.cumsum(steps, axis=0)
    return np.stack([pose_from(rot_z(h) @ tilt, p) for h, p in zip(heading, places, strict=True)])


def told(states, poses=None, reasons=None, covariance=None, stamps=None):
    count = len(states)
    known = np.array([state == "TRACKING" for state in states])
    poses = np.tile(np.eye(4), (count, 1, 1)) if poses is None else poses.copy()
    poses[~known] = np.nan
    covariance = np.eye(6) if covariance is None else covariance
    stamps = 0.1 * np.arange(count) if stamps is None else np.asarray(stamps)
    reasons = [""] * count if reasons is None else reasons
    return Told(stamps, states, reasons, poses, np.tile(covariance, (count, 1, 1)), np.full(count, 0.005))


def gaussian(covariance, scale=1.0, count=4000, seed=3):
    """Poses whose errors are drawn from a covariance, told with ``scale`` times its sigmas."""
    rng = np.random.default_rng(seed)
    truth = way(count)
    poses = truth.copy()
    twist = rng.multivariate_normal(np.zeros(6), covariance, count)
    poses[:, :3, 3] += twist[:, :3]
    poses[:, :3, :3] = np.stack([exp_so3(t[3:]) @ T[:3, :3] for t, T in zip(twist, truth, strict=True)])
    return told(["TRACKING"] * count, poses, covariance=covariance * scale**2), truth


@pytest.fixture(scope="module")
def covariance():
    """Correlated, metres beside radians."""
    mix = np.random.default_rng(1).normal(size=(6, 6))
    sigma = np.array([0.05, 0.1, 0.02, 0.002, 0.002, 0.004])
    return (mix @ mix.T + np.eye(6)) / 6 * np.outer(sigma, sigma)


def found(covariance, scale=1.0):
    said, truth = gaussian(covariance, scale)
    return shares(pooled([spread(said, errors(said, truth))]))


@pytest.fixture(scope="module")
def honest(covariance):
    return found(covariance)


def test_an_honest_covariance_covers_what_it_promises_on_every_axis(honest):
    parts = honest
    for name in AXES:
        np.testing.assert_allclose(parts["all"][name]["inside"], NOMINAL, atol=0.025)
        assert parts["all"][name]["nees"] == pytest.approx(1.0, abs=0.06)
        assert parts["all"][name]["median_nees"] == pytest.approx(1.0, abs=0.1)
    assert parts["first minute"]["yaw"]["frames"] == 600
    assert parts["later"]["yaw"]["frames"] == 3400


@pytest.mark.parametrize(("scale", "one_sigma", "nees"), [(0.5, 0.383, 4.0), (2.0, 0.954, 0.25)])
def test_a_covariance_of_wrong_size_is_found_out(covariance, scale, one_sigma, nees):
    parts = found(covariance, scale)
    assert parts["all"]["yaw"]["inside"][0] == pytest.approx(one_sigma, abs=0.025)
    assert parts["all"]["pose"]["nees"] == pytest.approx(nees, rel=0.06)
    assert {what for what, *_, met in tracking.verdicts([row()], parts) if not met} == {
        "coverage, first minute", "coverage, later"
    }  # fmt: skip


def test_a_covariance_that_is_none_covers_nothing():
    broken = np.stack([np.full((6, 6), np.nan), np.diag([1.0, 1, 1, 1, 1, -1]), np.zeros((6, 6)), np.eye(6)])
    squared = tracking_coverage.squares(np.full((4, 6), 0.1), broken, AXES["pose"])
    np.testing.assert_allclose(squared, [np.inf, np.inf, np.inf, 0.06])
    assert coverage(squared, 6)["inside"][2] == 0.25
    assert coverage(squared, 6)["nees"] is None
    assert coverage(np.zeros(0), 6)["inside"] is None


def test_errors_are_in_map_axes():
    truth = np.stack([pose_from(rot_z(np.pi / 2), [10.0, 0.0, 0.0])])
    poses = np.stack([pose_from(exp_so3(np.array([0.02, 0.0, 0.0])) @ truth[0, :3, :3], [10.1, -0.2, 0.0])])
    error = errors(told(["TRACKING"], poses), truth)
    np.testing.assert_allclose(error.twist, [[0.1, -0.2, 0.0, 0.02, 0.0, 0.0]], atol=1e-12)
    assert error.degrees[0] == pytest.approx(np.degrees(0.02))


def test_false_seconds_last_until_the_next_frame_and_no_longer_than_half_a_second():
    states = ["TRACKING", "TRACKING", "LOST", "TRACKING", "TRACKING"]
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[[1, 3], 0, 3] = 1.2, 40.0
    poses[4, :3, :3] = rot_z(np.radians(5.1))
    stamps = [0.0, 0.1, 0.3, 0.4, 5.0]
    reasons = ["", "", "gone", "", ""]
    figures = score(
        told(states, poses, reasons, stamps=stamps), np.tile(np.eye(4), (5, 1, 1)), np.arange(5.0), []
    )
    assert figures["false_frames"] == 3
    assert figures["false_s"] == pytest.approx(0.2 + 0.5 + 0.15)  # the last one lasts a median gap
    assert figures["doubtful_frames"] == 2
    assert figures["share_right"] == pytest.approx(0.2)
    assert figures["losses"] == 1
    assert figures["reasons"] == ["gone"]
    assert figures["metres"]["max"] == pytest.approx(40.0)
    assert [state for _, state, _ in figures["transitions"]] == ["TRACKING", "LOST", "TRACKING"]


def test_recovery_is_counted_from_the_end_of_the_event_to_the_first_right_pose():
    right = np.array([True, True, False, False, False, True])
    stamps, driven = 0.1 * np.arange(6), np.array([0.0, 1.0, 1.0, 1.0, 3.0, 6.0])
    assert recovery(right, stamps, driven, 2) == pytest.approx((0.3, 5.0))
    assert recovery(right, stamps, driven, 1) == (0.0, 0.0)
    assert recovery(right[:5], stamps, driven, 2) is None


def test_events_tell_how_long_the_robot_was_wrong_about_itself():
    states = ["TRACKING"] * 4 + ["LOST"] * 3 + ["TRACKING"] * 3
    poses = np.tile(np.eye(4), (10, 1, 1))
    truth = poses.copy()
    truth[2:, 0, 3] = 50.0
    poses[7:, 0, 3] = 50.1
    poses[[1, 9], 0, 3] = 90.0  # false, but neither of the event nor before it is over
    figures = score(told(states, poses), truth, np.arange(10.0), [("kidnapped", 2, 2)])
    event = figures["events"][0]
    assert event["false_s"] == pytest.approx(0.2)
    assert (event["recovery_m"], event["recovery_s"]) == pytest.approx((5.0, 0.5))
    never = score(told(states[:7], poses[:7]), truth[:7], np.arange(7.0), [("kidnapped", 2, 2)])
    assert never["events"][0]["recovery_m"] is None


def test_a_drive_without_a_pose_scores_without_one():
    figures = score(told(["SEARCHING"] * 3 + ["SKIPPED"]), np.tile(np.eye(4), (4, 1, 1)), np.arange(4.0), [])
    assert figures["metres"] is None
    assert figures["first_fix_m"] is None
    assert figures["skipped"] == 1


def test_a_loss_is_a_change_to_lost():
    states = ["SEARCHING", "TRACKING", "LOST", "LOST", "TRACKING", "AMBIGUOUS", "LOST"]
    assert losses(states, list("abcdefg")) == ["c", "g"]


def test_time_since_a_fix_starts_anew_after_a_search_but_not_after_a_doubt():
    states = ["SEARCHING", "TRACKING", "AMBIGUOUS", "TRACKING", "LOST", "AMBIGUOUS", "TRACKING"]
    age = tracking_coverage.since_fix(told(states))
    np.testing.assert_allclose(age, [np.nan, 0.0, np.nan, 0.2, np.nan, np.nan, 0.0])


def same_steps(a, b):
    """Whether two stretches (N, 4, 4) of odometry differ by where they are and head only."""
    return np.allclose([inverse(T) @ a[-1] for T in a], [inverse(T) @ b[-1] for T in b], atol=1e-9)


def level(odometry):
    return np.allclose([tilt_of(T) for T in odometry], np.radians(1.0), atol=np.radians(0.3))


@pytest.fixture(scope="module")
def drive():
    return start(way(), 0.01, 5)


@pytest.mark.parametrize("share", [0.005, 0.05])
def test_odometry_drifts_as_asked(share):
    truth = way()
    for seed, longer in ((8, 1), (9, -1)):
        odometry = start(truth, share, seed).odometry
        assert drift_share(truth, odometry) == pytest.approx(share, rel=0.02)
        lengths = [np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).sum() for T in (odometry, truth)]
        assert 0.2 * share < longer * (lengths[0] / lengths[1] - 1.0) < share
    assert drift_share(truth, truth) == pytest.approx(0.0, abs=1e-9)


def test_a_kidnapped_robot_stood_still_by_its_odometry(drive):
    got = kidnapped(drive, 400, 900)
    assert len(got) == 1000
    assert same_steps(got.odometry[400:], drive.odometry[900:])
    assert level(got.odometry)
    np.testing.assert_allclose(got.odometry[400, :3, 3], got.odometry[399, :3, 3])
    assert yaw_of(got.odometry[400]) == pytest.approx(yaw_of(got.odometry[399]))
    np.testing.assert_array_equal(got.frames[[399, 400]], [399, 900])
    np.testing.assert_array_equal(got.truth[400], drive.truth[900])
    assert got.driven[400] == got.driven[399]
    assert np.diff(got.stamps) == pytest.approx(0.1)
    assert [(e.begin, e.end) for e in got.events] == [(400, 400)]


def test_a_carried_robot_sees_but_does_not_drive(drive):
    got = carried(drive, 400, 600)
    np.testing.assert_allclose(np.ptp(got.odometry[399:600, :3, 3], axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose([yaw_of(T) for T in got.odometry[399:600]], yaw_of(got.odometry[399]))
    assert level(got.odometry)
    assert same_steps(got.odometry[600:], drive.odometry[600:])
    assert got.driven[600] == got.driven[399]
    assert got.driven[-1] == pytest.approx(drive.driven[-1] - drive.driven[600] + drive.driven[399])
    np.testing.assert_array_equal(got.truth, drive.truth)
    assert [(e.begin, e.end) for e in got.events] == [(400, 600)]


def test_odometry_jumps_once_and_starts_again_at_zero(drive):
    got = jumped(drive, 500, (3.0, 1.0), 15.0)
    step = inverse(drive.odometry[500]) @ got.odometry[500]
    np.testing.assert_allclose(got.odometry[500, :3, 3] - drive.odometry[500, :3, 3],
                               drive.odometry[500, :3, :3] @ [3.0, 1.0, 0.0], atol=1e-9)  # fmt: skip
    assert yaw_of(step) == pytest.approx(np.radians(15.0), abs=1e-3)
    assert same_steps(got.odometry[500:], drive.odometry[500:])
    again = restarted(drive, 500)
    np.testing.assert_allclose(again.odometry[500, :3, 3], 0.0, atol=1e-9)
    assert yaw_of(again.odometry[500]) == pytest.approx(0.0, abs=1e-9)
    assert same_steps(again.odometry[500:], drive.odometry[500:])
    assert level(again.odometry)
    assert level(got.odometry)


def test_odometry_out_of_scale_drives_further(drive):
    got = scaled(drive, 1.05)
    steps = [np.linalg.norm(np.diff(o[:, :3, 3], axis=0), axis=1) for o in (got.odometry, drive.odometry)]
    np.testing.assert_allclose(steps[0], 1.05 * steps[1])
    np.testing.assert_array_equal(got.odometry[:, :3, :3], drive.odometry[:, :3, :3])


def test_a_cover_leaves_near_returns_or_few():
    rng = np.random.default_rng(0)
    points = (rng.normal(size=(500, 3)) * 20).astype(np.float32)
    cloth = seen(points, CLOTH, 7)
    ranges = np.linalg.norm(cloth, axis=1)
    assert ranges.min() >= 0.499
    assert ranges.max() <= 0.901
    np.testing.assert_allclose(np.cross(cloth, points), 0.0, atol=1e-4)
    dust = seen(points, DUST, 7)
    assert len(dust) == 20
    assert (dust[:, None] == points[None]).all(axis=2).any(axis=1).all()
    np.testing.assert_array_equal(dust, seen(points, DUST, 7))
    assert seen(points, 0, 7) is points


def test_a_cover_lies_over_the_sensor_for_the_time_of_the_event(drive):
    got = covered(drive, 100, 400, CLOTH).until(100.0)
    assert np.flatnonzero(got.cover).tolist() == list(range(100, 400))
    assert [(e.begin, e.end) for e in got.events] == [(100, 400)]
    assert got.driven[-1] == pytest.approx(100.0, abs=0.3)


def test_the_gap_is_a_hundred_metres_of_the_drive(drive):
    got = over_the_gap(drive)
    (event,) = got.events
    assert got.driven[event.begin] == pytest.approx(GAP[0], abs=3.0)
    assert got.driven[event.end] == pytest.approx(GAP[1], abs=3.0)
    middle = got.truth[[got.at(170.0)], :3, 3]
    aside = middle + np.array([0.0, 100.0, 0.0])
    np.testing.assert_array_equal(in_gap(drive.truth, np.concatenate([middle, aside])), [True, False])


def test_an_earlier_place_has_other_buildings_and_is_driven_through_as_it_is():
    scene = build_scene("town", 1, 90.0, 0.3)
    past = earlier(scene, 1, 0.3)
    assert past.now is scene.mapped
    ground = len(scene.site.mesh().vertices)
    before, after = past.mapped.solid.vertices, scene.now.solid.vertices
    np.testing.assert_array_equal(before[:ground], after[:ground])
    owner = tracking_worlds._owners(scene)
    moved = set(owner[(before != after).any(axis=1)])
    used = np.zeros(len(after), dtype=bool)
    used[past.mapped.solid.triangles] = True
    gone = {k for k in range(len(scene.footprints)) if not used[owner == k].any()}
    assert -1 not in moved
    assert len(moved | gone) == round(0.3 * len(scene.footprints))
    assert len(gone) == -(-len(moved | gone) // 3)


def test_scenarios_are_named_once_and_driven_where_nobody_tunes():
    assert len({s.name for s in scenarios()}) == len(scenarios())
    plain = [s for s in scenarios() if s.plain]
    assert len(plain) == 10
    assert {s.world.kind for s in plain} == {"town", "campus", "sparse-forest"}
    assert {min(s.drift for s in plain), max(s.drift for s in plain)} == {0.005, 0.05}
    assert all(300.0 <= s.world.length <= 600.0 for s in plain)
    seeds = {s.world.seed for s in scenarios()}
    assert seeds == set(range(5001, 5011))
    assert not seeds & TUNED_SEEDS
    assert "tracking" in OWN


def row(**changes):
    figures = {"rmse": 0.05, "p50": 0.05, "p95": 0.1, "p99": 0.1, "max": 0.2}
    out = {
        "name": "plain/x", "plain": True, "drift": 0.01, "driven_m": 300.0, "share_right": 0.98, "first_fix_m": 5.0,
        "metres": figures, "degrees": figures, "false_frames": 0, "false_s": 0.0, "doubtful_frames": 0, "losses": 0,
        "reasons": [], "events": [], "tracking_step_ms": {"p50": 3.0, "p99": 30.0},
    }  # fmt: skip
    return out | changes


@pytest.mark.parametrize(
    ("changes", "missed"),
    [
        ({}, set()),
        ({"metres": {"rmse": 0.13, "max": 1.0}}, {"rmse of plain drives, m"}),
        ({"degrees": None}, {"rmse of plain drives, deg"}),
        ({"false_frames": 1, "false_s": 0.1}, {"false frames"}),
        ({"events": [{"recovery_m": 20.1, "recovery_s": 9.0}]}, {"recovery, m driven"}),
        ({"events": [{"recovery_m": None, "recovery_s": None}]}, {"recovery, m driven"}),
    ],
)
def test_targets_are_judged(honest, changes, missed):
    judged = tracking.verdicts([row(**changes)], honest)
    assert {what for what, *_, met in judged if not met} == missed
    assert len(tracking.cells(row(**changes))) == len(tracking._HEAD)


def test_a_small_world_is_measured_from_end_to_end(tmp_path, monkeypatch, capsys):
    world = World("sparse-forest", "vlp16", 1, 80.0, 1.0, 2.0, 0.02)
    small = (Scenario("plain/small", world, lambda drive: drive, 0.02),)
    monkeypatch.setattr(tracking, "QUICK", small)
    monkeypatch.setattr(
        tracking_worlds, "_build", lambda file, points: np.save(file.with_suffix(".npy"), points)
    )

    def follow(site, recorded, drive):
        assert np.load(site.with_suffix(".npy")).shape[1] == 3
        assert len(recorded.read(0)) > 1000
        poses = drive.truth.copy()
        poses[:, 0, 3] += 0.05
        return replace(
            told(["TRACKING"] * len(drive), poses, covariance=0.01 * np.eye(6)), stamps=drive.stamps
        )

    monkeypatch.setattr(tracking_run, "follow", follow)
    picture, file = tmp_path / "coverage.png", tmp_path / "rows.json"
    arguments = ["--quick", "--worlds", str(tmp_path), "--plot", str(picture), "--json", str(file)]
    assert tracking.main(arguments) == 1  # a constant error is not what a covariance promises
    written = json.loads(file.read_text())
    assert written["rows"][0]["metres"]["rmse"] == pytest.approx(0.05)
    assert picture.stat().st_size > 10_000
    assert "plain/small" in capsys.readouterr().out
    monkeypatch.setattr(tracking_run, "follow", None)  # an unchanged engine is not asked twice
    assert tracking.main(arguments) == 1
    rounded = open_world(tmp_path, world)
    assert np.abs(rounded.read(3)).max() < 131.0


def test_names_pick_scenarios(capsys):
    assert tracking.main(["--list", "kidnap"]) == 0
    assert capsys.readouterr().out.split() == ["kidnap/town", "kidnap/campus", "kidnap/forest"]
    assert tracking.main(["--list", "--quick"]) == 0
    assert capsys.readouterr().out.split() == [s.name for s in QUICK]
    assert tracking.main(["nothing"]) == 2


def test_a_picture_without_poses_says_so(tmp_path):
    draw(pooled([]), tmp_path / "empty.png", "nothing")
    assert (tmp_path / "empty.png").stat().st_size > 5000
