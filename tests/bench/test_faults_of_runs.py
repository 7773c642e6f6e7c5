"""Faults of runs: each begins where it should, and changes only what it should."""

import numpy as np
import pytest

from bench.faults.faults import BEGINS, FAULTS, UNDISTURBED, Feed
from bench.faults.run import _of_fault
from coview_stream.geometry.transforms import pose_from, rot_z

BY_NAME = {fault.name: fault for fault in FAULTS}
START = {fault.name for fault in FAULTS if fault.bad_input} | {"lever arm 0.6 m, from the start"}


@pytest.fixture(scope="module")
def feed():
    """101 frames of a drive round a bend at 2 m/s, of 10 Hz; each cloud holds its frame's number."""
    stamps = 1000.0 + 0.1 * np.arange(101)
    turn = 0.1 * (stamps - stamps[0])
    truth = np.array([pose_from(rot_z(a), [20 * np.sin(a), 20 - 20 * np.cos(a), 0.3]) for a in turn])
    odometry = pose_from(rot_z(1.0), [50.0, 3.0, 0.0]) @ truth
    clouds = [np.column_stack([np.full(40, k), np.arange(40), np.ones(40)]).astype(np.float32) for k in range(101)]
    return Feed.of(clouds, stamps, odometry, truth)


@pytest.mark.parametrize("name", BY_NAME)
def test_a_fault_leaves_the_time_before_it_alone_changes_something_after_it_and_is_the_same_again(feed, name):
    bad, again = (BY_NAME[name].of(feed, "world") for _ in range(2))
    assert all(map(np.array_equal, bad.clouds, again.clouds))
    np.testing.assert_array_equal(bad.odometry, again.odometry)
    begins = bad.begins
    assert begins == (0 if name in START else np.ceil(BEGINS * 100))
    for part in ("stamps", "odometry", "truth", "clock", "way"):
        np.testing.assert_allclose(getattr(bad, part)[:begins], getattr(feed, part)[:begins])
    assert all(a is b for a, b in zip(bad.clouds[:begins], feed.clouds[:begins], strict=True))
    same = len(bad) == len(feed) and all(map(np.array_equal, bad.clouds, feed.clouds))
    assert not (same and np.array_equal(bad.stamps, feed.stamps) and np.allclose(bad.odometry, feed.odometry))
    assert (np.diff(bad.clock) > 0).all()
    assert (np.diff(bad.way) > -1e-9).all()


def test_a_late_cloud_has_odometry_and_truth_of_its_stamp(feed):
    late = BY_NAME["clouds 0.3 s late"].of(feed, "world")
    cloud = int(late.clouds[60][0, 0])
    np.testing.assert_allclose(late.stamps[60], feed.stamps[cloud] + 0.3)
    np.testing.assert_allclose(late.truth[60], feed.truth[cloud + 3], atol=1e-9)
    np.testing.assert_allclose(late.odometry[60], feed.odometry[cloud + 3], atol=1e-9)


def test_a_growing_lag_is_a_tenth_of_the_time_since(feed):
    late = BY_NAME["clouds' lag grows 0.1 s/s"].of(feed, "world")
    cloud = np.array([points[0, 0] for points in late.clouds])
    lag = late.stamps - feed.stamps[cloud.astype(int)]
    np.testing.assert_allclose(lag, 0.1 * np.maximum(0.0, feed.stamps[cloud.astype(int)] - feed.stamps[40]), atol=1e-6)


def test_late_odometry_is_that_of_the_time_before(feed):
    late = BY_NAME["odometry 1 s late"].of(feed, "world")
    np.testing.assert_allclose(late.odometry[80], feed.odometry[70], atol=1e-9)
    np.testing.assert_allclose(late.odometry[45], feed.odometry[40], atol=1e-9)


def test_other_odometry_is_made_step_by_step(feed):
    np.testing.assert_allclose(feed.moved(lambda k, step, turn: (step, turn)).odometry, feed.odometry, atol=1e-9)
    mirrored = BY_NAME["odometry mirrored"].of(feed, "world").odometry
    a, b = (np.linalg.inv(poses[40]) @ poses[90] for poses in (feed.odometry, mirrored))
    np.testing.assert_allclose(b[:3, 3], a[:3, 3] * (1, -1, 1), atol=1e-9)
    long = BY_NAME["odometry 1.5 times too long"].of(feed, "world").odometry
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(long[40:, :3, 3], axis=0), axis=1), 1.5 * 0.2, atol=1e-4
    )  # chords of 0.2 m


def test_a_kidnapped_robot_has_driven_no_metre(feed):
    taken = BY_NAME["kidnap"].of(feed, "world")
    assert len(taken) == len(feed) - 30
    assert np.linalg.norm(taken.truth[40, :3, 3] - taken.truth[39, :3, 3]) > 5.0
    np.testing.assert_allclose(taken.odometry[40, :3, 3], taken.odometry[39, :3, 3])
    assert taken.way[40] - taken.way[39] < 0.25


def figures(**changes):
    usual = {
        "posed": 100, "frames": 100, "posed_after": 60, "frames_after": 60, "first_fix_m": 0.0, "false": 0, "over": 0,
        "goes_on": True, "worst_m": 0.1, "worst_deg": 0.2, "last_s": 6.0, "last_m": 12.0, "to_name": True,
        "named_s": None, "name": "",
    }  # fmt: skip
    return usual | changes


def test_a_table_row_sums_up_the_runs_of_a_fault():
    ended = figures(goes_on=False, last_s=1.5, last_m=3.0, named_s=2.0, name="the lidar repeats itself", posed_after=6)
    row = _of_fault("scan repeated", [figures(false=3, over=4, worst_m=9.0), ended])
    assert (row["runs"], row["false"], row["false_runs"], row["over"], row["goes_on"]) == (2, 3, 1, 4, 1)
    assert (row["last_s"], row["last_m"], row["worst_m"], row["named"], row["named_s"]) == (1.5, 3.0, 9.0, "1", 2.0)
    assert row["after"] == pytest.approx(55.0)
    assert UNDISTURBED.named == ""
