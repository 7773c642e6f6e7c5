"""Scores of a tracked drive, on numbers small enough to know the answer."""

from __future__ import annotations

import numpy as np
import pytest
from told import told, way

from bench.harness.trajectory_scores import errors, losses, recovery, score
from bench.tracking import coverage as tracking_coverage
from bench.tracking import tracking
from bench.tracking.coverage import AXES, NOMINAL, coverage, pooled, shares, spread
from coview_stream.geometry.transforms import exp_so3, pose_from, rot_z


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
        assert parts["all"][name]["median_nees"] == pytest.approx(1.0, abs=0.1)
    assert parts["first minute"]["yaw"]["frames"] == 600
    assert parts["later"]["yaw"]["frames"] == 3400


@pytest.mark.parametrize(("scale", "one_sigma", "nees"), [(0.5, 0.383, 4.0), (2.0, 0.954, 0.25)])
def test_a_covariance_of_wrong_size_is_found_out(covariance, scale, one_sigma, nees):
    parts = found(covariance, scale)
    assert parts["all"]["yaw"]["inside"][0] == pytest.approx(one_sigma, abs=0.025)
    assert parts["all"]["pose"]["median_nees"] == pytest.approx(nees, rel=0.1)
    assert missed_by([row()], parts) == {
        "coverage, first minute", "coverage, later"
    }  # fmt: skip


def test_a_covariance_that_is_none_covers_nothing():
    broken = np.stack([np.full((6, 6), np.nan), np.diag([1.0, 1, 1, 1, 1, -1]), np.zeros((6, 6)), np.eye(6)])
    squared = tracking_coverage.squares(np.full((4, 6), 0.1), broken, AXES["pose"])
    np.testing.assert_allclose(squared, [np.inf, np.inf, np.inf, 0.06])
    assert coverage(squared, 6)["inside"][2] == 0.25
    assert coverage(squared, 6)["median_nees"] is None
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
    figures = score(told(states, poses, reasons, stamps=stamps), np.tile(np.eye(4), (5, 1, 1)), np.arange(5.0), [])
    assert figures["false_frames"] == 3
    assert figures["false_s"] == pytest.approx(0.2 + 0.5 + 0.15)  # the last one lasts a median gap
    assert figures["doubtful_frames"] == 2
    assert figures["right_percent"] == pytest.approx(20.0)
    assert figures["losses"] == 1
    assert figures["reasons"] == ["gone"]
    assert figures["max_m"] == pytest.approx(40.0)


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
    assert figures["rmse_m"] is None
    assert figures["first_fix_m"] is None
    assert figures["p50_ms"] is None


def test_a_loss_is_a_change_to_lost():
    states = ["SEARCHING", "TRACKING", "LOST", "LOST", "TRACKING", "AMBIGUOUS", "LOST"]
    assert losses(states, list("abcdefg")) == ["c", "g"]


def test_time_since_a_fix_starts_anew_after_a_search_but_not_after_a_doubt():
    states = ["SEARCHING", "TRACKING", "AMBIGUOUS", "TRACKING", "LOST", "AMBIGUOUS", "TRACKING"]
    age = tracking_coverage.since_fix(told(states))
    np.testing.assert_allclose(age, [np.nan, 0.0, np.nan, 0.2, np.nan, np.nan, 0.0])


def missed_by(rows, found):
    return {row.name.partition("/")[2] for row in tracking.verdicts(rows, found) if not row.holds}


def row(**changes):
    out = {
        "name": "plain/x", "plain": True, "drift_percent": 1.0, "driven_m": 300.0, "right_percent": 98.0,
        "first_fix_m": 5.0, "rmse_m": 0.05, "max_m": 0.2, "rmse_deg": 0.05, "max_deg": 0.2, "false_frames": 0,
        "false_s": 0.0, "doubtful_frames": 0, "losses": 0, "reasons": [], "events": [], "p50_ms": 3.0, "p99_ms": 30.0,
        "misleading": 0, "beyond": 0, "alert_s": None, "alert_m": None,
    }  # fmt: skip
    return out | changes


@pytest.mark.parametrize(
    ("changes", "missed"),
    [
        ({}, set()),
        ({"rmse_m": 0.13}, {"rmse of plain drives, m"}),
        ({"rmse_deg": None}, {"rmse of plain drives, deg"}),
        ({"false_frames": 1, "false_s": 0.1}, {"false frames"}),
        ({"misleading": 2}, {"beyond the alert limit, to the alert"}),
        ({"events": [{"recovery_m": 20.1, "recovery_s": 9.0}]}, {"recovery, m driven"}),
        ({"events": [{"recovery_m": None, "recovery_s": None}]}, {"recovery, m driven"}),
    ],
)
def test_targets_are_judged(honest, changes, missed):
    assert missed_by([row(**changes)], honest) == missed
    assert len(tracking.cells(row(**changes))) == 1 + len(tracking._COLUMNS)
