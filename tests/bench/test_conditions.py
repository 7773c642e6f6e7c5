"""Conditions of real runs: what each does to clouds, odometry and truth, and how a trajectory is scored."""

from __future__ import annotations

import json
from argparse import Namespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.accuracy.conditions import cells, share, tables, verdicts
from bench.accuracy.real_runs import RealSet, scored
from bench.accuracy.spoil import Variant, rings, spoilt
from bench.harness.rows import informs
from coview_stream.clouds import read_cloud, read_tum, write_cloud, write_tum
from coview_stream.errors import InputError
from coview_stream.geometry.transforms import inverse, pose_from, rot_z


@pytest.fixture
def run():
    """Twenty frames, 2 m apart, on a bend; odometry is the truth in another frame."""
    truth = np.array([pose_from(rot_z(0.05 * k), np.array([2.0 * k, 0.1 * k, 5.0])) for k in range(20)])
    shift = pose_from(rot_z(1.0), np.array([3.0, -2.0, 0.0]))
    return Variant(np.arange(20), 100.0 + 0.5 * np.arange(20), shift @ truth, truth)


def steps(poses):
    return inverse(poses[0]) @ poses[-1], np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)


def test_the_unspoilt_run_stays_as_it_is(run):
    base, cloud = spoilt("base", run, 0), np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    np.testing.assert_array_equal(base.cloud(cloud), cloud)
    np.testing.assert_array_equal(base.odometry, run.odometry)


def test_a_pitched_sensor_sees_the_ground_ahead_rise_and_odometry_does_not_know(run):
    leant = spoilt("pitch:2", run, 0)
    seen = leant.cloud(np.array([[10.0, 0.0, 0.0]], np.float32))[0]
    np.testing.assert_allclose(seen, [10 * np.cos(np.radians(2)), 0.0, -10 * np.sin(np.radians(2))], atol=1e-5)
    np.testing.assert_array_equal(leant.odometry, run.odometry)
    np.testing.assert_array_equal(leant.truth, run.truth)


def test_bad_odometry_is_too_long_and_its_heading_walks(run):
    straight = spoilt("odo:5:0", run, 0)
    np.testing.assert_allclose(steps(straight.odometry)[1], 1.05 * steps(run.truth)[1], rtol=1e-9)
    walks = [spoilt("odo:0:0.5", run, seed) for seed in range(200)]
    wanted = inverse(run.truth[0]) @ run.truth[-1]
    off = [inverse(wanted) @ steps(walk.odometry)[0] for walk in walks]
    degrees = np.std([Rotation.from_matrix(each[:3, :3]).as_euler("xyz", degrees=True)[2] for each in off])
    assert degrees == pytest.approx(0.5 * np.sqrt(steps(run.truth)[1].sum()), rel=0.2)
    np.testing.assert_array_equal(walks[3].odometry, spoilt("odo:0:0.5#2", run, 3).odometry)


def test_a_turned_body_sees_the_same_from_behind(run):
    turned = spoilt("rev180", run, 0)
    points = np.random.default_rng(1).normal(size=(30, 3)).astype(np.float32)
    for poses, before in ((turned.truth, run.truth), (turned.odometry, run.odometry)):
        there = turned.cloud(points) @ poses[4, :3, :3].T + poses[4, :3, 3]
        np.testing.assert_allclose(there, points @ before[4, :3, :3].T + before[4, :3, 3], atol=1e-4)


def test_frames_are_chosen_in_order_of_time(run):
    assert spoilt("sparse3", run, 0).frames.tolist() == [0, 3, 6, 9, 12, 15, 18]
    assert spoilt("start:4:3", run, 0).frames.tolist() == [4, 5, 6]
    back = spoilt("back", run, 0)
    assert back.frames[0] == 19
    assert (np.diff(back.stamps) > 0).all()
    np.testing.assert_array_equal(back.truth, run.truth[::-1])
    still = spoilt("still:7", run, 0)
    assert set(still.frames) == {7}
    assert np.ptp(still.odometry[:, :3, 3], axis=0).max() < 0.02
    assert spoilt("one:7", run, 0).alone


def test_rings_and_range_thin_a_cloud(run):
    elevation, azimuth = np.meshgrid(np.radians(np.linspace(-25, 15, 64)), np.linspace(0, 6.28, 100), indexing="ij")
    around = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    points = 40 * np.stack(around, axis=-1).reshape(-1, 3)
    assert len(rings(points)) == pytest.approx(len(points) / 4, rel=0.3)
    assert len(spoilt("near30", run, 0).cloud(points)) == 0


def test_conditions_can_follow_one_another(run):
    both = spoilt("sparse3+pitch:2+odo:5:0", run, 0)
    assert len(both.frames) == 7
    np.testing.assert_allclose(steps(both.odometry)[1], 1.05 * steps(both.truth)[1], rtol=1e-9)
    assert both.cloud(np.array([[10.0, 0.0, 0.0]], np.float32))[0, 2] < -0.3


@pytest.mark.parametrize("wrong", ["fog", "pitch", "pitch:x", "pitch:1:2", "one:20", "start:30:4"])
def test_a_wrong_condition_is_refused_in_words(run, wrong):
    with pytest.raises(InputError, match=wrong.split(":")[0]):
        spoilt(wrong, run, 0)


def test_a_variant_on_disk_is_a_run(run, tmp_path):
    """With the same stamps in odometry and truth; a lone frame is a cloud file."""
    folder = tmp_path / "street"
    (folder / "run" / "frames").mkdir(parents=True)
    for k in range(20):
        write_cloud(folder / "run" / "frames" / f"{k:06d}.pcd", np.full((3, 3), k + 1, np.float32))
    write_tum(folder / "run" / "odometry.tum", run.stamps, run.odometry)
    write_tum(folder / "truth.tum", run.stamps, run.truth)
    with pytest.raises(InputError, match=r"base\.laz"):
        RealSet(folder).checked()
    made = RealSet(folder).variant("sparse3+pitch:2", tmp_path / "out")
    assert len(list((made / "frames").iterdir())) == 7
    np.testing.assert_array_equal(read_tum(made / "odometry.tum")[0], read_tum(tmp_path / "out" / "truth.tum")[0])
    assert json.loads((tmp_path / "out" / "spoilt.json").read_text())["spec"]["condition"] == "sparse3+pitch:2"
    alone = RealSet(folder).variant("one:4", tmp_path / "one")
    assert read_cloud(alone).points[0, 0] == 5.0


def test_scores_of_a_trajectory(run):
    poses = run.truth[5:15].copy()
    poses[0, 0, 3] += 0.2
    poses[9, 0, 3] += 1.5
    found = scored((run.stamps[5:15] + 0.001, poses), (run.stamps, run.truth))
    assert (found["frames"], found["posed"], found["false_frames"]) == (20, 10, 1)
    assert found["first_fix_m"] == pytest.approx(5 * steps(run.truth)[1][0], rel=1e-6)
    assert found["first_m"] == pytest.approx(0.2)
    nothing = scored((np.zeros(0), np.zeros((0, 4, 4))), (run.stamps, run.truth))
    assert (nothing["posed"], nothing["first_m"], nothing["rmse_m"]) == (0, None, None)


def test_verdicts_name_the_run_that_misses(run):
    good = scored((run.stamps, run.truth), (run.stamps, run.truth))
    bad = scored((run.stamps[:5], run.truth[:5]), (run.stamps, run.truth))
    found = [
        {"set": "street", "condition": what, "runs": {"before": bad | {"share": None}, "now": each}}
        for what, each in (("base", good), ("pitch:2", bad))
    ]
    for each in found:
        each["runs"]["now"] = each["runs"]["now"] | {"share": share(each["runs"]["now"], good)}
    judged = {row.name: row for row in verdicts(found)}
    least = judged["conditions/least share, tilt and odometry, %"]
    assert not least.holds
    assert least.said == "25.0 (street, pitch:2)"
    assert judged["conditions/false frames"].holds
    assert cells(found[1])[3:5] == ["5 > 5", "- > 25"]
    rows = [informs("conditions/street", 1.0, "%", each) for each in found] + list(verdicts(found))
    page = tables(rows, Namespace(before="0123456789"))[""]
    assert "25.0 (street, pitch:2) |  missed" in page
    assert "commit 0123456." in page
