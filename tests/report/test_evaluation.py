"""Eqs 15-17 on cases small enough to be worked out by hand."""

import json

import numpy as np
import pytest

from coview_stream.errors import InputError
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.report.evaluation import constant_offset, evaluate, frame_errors

STAMPS = 1000.0 + 0.1 * np.arange(20)


def straight_truth():
    """Twenty poses, two metres apart along x."""
    return STAMPS, np.stack([pose_from(np.eye(3), [2.0 * k, 0.0, 0.0]) for k in range(20)])


def shifted(t=(0.0, 0.0, 0.0), yaw_deg=0.0, first=0):
    """The truth from frame ``first`` on, with one constant error."""
    stamps, poses = straight_truth()
    wrong = np.stack([pose_from(rot_z(np.radians(yaw_deg)) @ T[:3, :3], T[:3, 3] + t) for T in poses])
    return stamps[first:], wrong[first:]


NOTHING = (np.zeros(0), np.zeros((0, 4, 4)))


def test_perfect_trajectory_has_zero_error():
    verdict = evaluate(straight_truth(), straight_truth())
    assert verdict.success
    assert (verdict.frames, verdict.posed, verdict.false_frames) == (20, 20, 0)
    assert verdict.share_localised == 1.0
    assert verdict.first_fix_m == 0.0
    assert verdict.translation.max == 0.0
    assert verdict.rotation.max < 1e-6


def test_constant_errors_are_measured():
    verdict = evaluate(shifted(t=(0.3, 0.0, 0.4), yaw_deg=2.0), straight_truth())
    assert verdict.success
    for value in (verdict.translation.mean, verdict.translation.rmse, verdict.translation.median):
        assert value == pytest.approx(0.5)
    assert verdict.rotation.mean == pytest.approx(2.0)


def test_statistics_differ_where_errors_do():
    stamps, poses = straight_truth()
    poses[:, 1, 3] += np.where(np.arange(20) < 5, 2.0, 0.0)
    translation = evaluate((stamps, poses), straight_truth()).translation
    assert translation.mean == pytest.approx(0.5)
    assert translation.rmse == pytest.approx(1.0)
    assert translation.median == 0.0
    assert translation.max == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("error", "right"),
    [({"t": (2.99, 0, 0)}, True), ({"t": (3.01, 0, 0)}, False), ({"yaw_deg": 4.99}, True), ({"yaw_deg": -5.01}, False)],
)
def test_success_thresholds(error, right):
    verdict = evaluate(shifted(**error), straight_truth())
    assert verdict.success is right
    assert verdict.false_frames == (0 if right else 20)
    assert verdict.share_localised == (1.0 if right else 0.0)


def test_no_estimates_is_not_localized():
    verdict = evaluate(NOTHING, straight_truth())
    assert not verdict.success
    assert (verdict.posed, verdict.false_frames, verdict.share_localised) == (0, 0, 0.0)
    assert verdict.first_fix_m is None
    assert verdict.translation is None
    assert json.loads(verdict.to_json())["first_fix_m"] is None


def test_distance_driven_before_first_pose():
    verdict = evaluate(shifted(first=6), straight_truth())
    assert verdict.first_fix_m == pytest.approx(12.0)
    assert verdict.share_localised == pytest.approx(14 / 20)
    assert verdict.success


def test_false_first_pose_is_not_a_success():
    long = (STAMPS[0] + 0.1 * np.arange(200), np.tile(np.eye(4), (200, 1, 1)))
    estimate = (long[0], long[1].copy())
    estimate[1][0, 0, 3] = 50.0
    verdict = evaluate(estimate, long)
    assert verdict.false_frames == 1
    assert not verdict.success
    assert verdict.worst_t_m == pytest.approx(50.0)
    assert verdict.translation.max == 0.0
    estimate[1][0, 0, 3], estimate[1][9, 0, 3] = 0.0, 50.0
    assert evaluate(estimate, long).success


def test_success_needs_more_than_95_percent_correct():
    stamps, poses = straight_truth()
    poses[7, 0, 3] += 10.0  # 95 % of 20 are right: not more than that
    assert not evaluate((stamps, poses), straight_truth()).success


def test_stamps_are_matched_to_the_nearest():
    stamps, poses = straight_truth()
    near = frame_errors((stamps + 0.04, poses), straight_truth())
    assert near.index.tolist() == list(range(20))
    assert near.e_t.max() == 0.0
    far = evaluate((stamps[-3:] + 5.0, poses[-3:]), straight_truth())
    assert (far.posed, far.unmatched) == (0, 3)


def test_error_at_the_odometry_origin_contains_the_lever_arm():
    true = pose_from(np.eye(3), [100.0, 0.0, 0.0])
    estimated = pose_from(np.eye(3), [100.0, 1.5, 2.0])
    assert evaluate(straight_truth(), straight_truth(), (estimated, true)).origin_t_m == pytest.approx(2.5)


def test_empty_truth_is_refused():
    with pytest.raises(InputError, match="no pose"):
        evaluate(straight_truth(), NOTHING)


def test_truth_of_another_origin_or_place_on_the_body_is_named():
    yaw, stamps = np.linspace(0.0, np.pi, 20), np.arange(20.0)
    poses = np.array([pose_from(rot_z(y), np.array([10.0 * k, 0.0, 0.0])) for k, y in enumerate(yaw)])
    elsewhere, beside, other = poses.copy(), poses @ pose_from(np.eye(3), np.array([4.0, 0.0, 1.0])), poses.copy()
    elsewhere[:, :3, 3] += 500.0, 20.0, 3.0
    other[:, 1, 3] += 30.0 * np.sin(stamps)
    assert "500.00, 20.00, 3.00 m" in (constant_offset((stamps, poses), (stamps, elsewhere)) or "")
    assert "4.00, 0.00, 1.00 m" in (constant_offset((stamps, poses), (stamps, beside)) or "")
    odometry = np.linalg.inv(pose_from(rot_z(2.0), np.array([900.0, -70.0, 2.0]))) @ poses
    assert "off by one transform" in (constant_offset((stamps, poses), (stamps, odometry)) or "")
    assert constant_offset((stamps, poses), (stamps, other)) is None
