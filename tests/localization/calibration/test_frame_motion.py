"""Motion from frame to frame: what two scans of one place say of the sensor's tilt and of odometry."""

import numpy as np
import pytest
from small_world import boxes, scan

from coview_stream.config import LocalizerConfig, TrackingConfig
from coview_stream.geometry.transforms import exp_so3, pose_from, rot_z
from coview_stream.localization.calibration.estimator import CalibrationEstimator
from coview_stream.localization.calibration.frame_motion import FrameMotion
from coview_stream.localization.frame import OdometryCorrection
from coview_stream.localization.tracking.motion import Drift

DRIFT = Drift.of(TrackingConfig()).variances
STEPS = [pose_from(rot_z(0.1 * k), [4.0 * k - 12.0, -12.0 + 0.5 * k, 1.7]) for k in range(6)]


def compare(odometry, lean=(0.0, 0.0), poses=STEPS, lowest=-np.inf):
    """Feed a robot's frames, its sensor leaning by ``lean`` degrees; return the estimator and the mended odometry.

    Points below ``lowest`` metres, of the body, are not seen.
    """
    scene, R = boxes(3), exp_so3(np.radians([*lean, 0.0]))
    motion, estimator = FrameMotion(LocalizerConfig().registration, 2.0), CalibrationEstimator()
    mended, correction = [], OdometryCorrection()
    for k, (T_map_body, T) in enumerate(zip(poses, odometry, strict=True)):
        cloud = scan(scene, T_map_body, k)[::3]
        cloud = cloud[cloud[:, 2] > lowest]
        T_odom_body = correction.correct(T, estimator.calibration)
        assert motion.is_due(T_odom_body)
        T_odom_body = motion.refine((cloud @ R.T).astype(np.float32), T_odom_body, estimator, DRIFT)
        mended.append(correction.move_to(T_odom_body))
    return estimator, mended


def error(mended, poses=STEPS):
    """Return metres by which the last pose is off, seen from the first."""
    a, b = (np.linalg.inv(each[0]) @ each[-1] for each in (mended, poses))
    return float(np.linalg.norm((a - b)[:3, 3]))


def test_sensor_and_odometry_that_are_right_are_left_alone():
    estimator, mended = compare(STEPS)
    found = estimator.calibration
    assert abs(np.degrees([found.roll, found.pitch])).max() < 0.2
    assert abs(found.scale) < 0.005
    assert error(mended) < 0.2  # of 20 m


@pytest.mark.parametrize("pitch", [-4.0, 3.0, 8.0])
def test_pitch_of_the_sensor_is_seen_before_any_place_is_known(pitch):
    estimator, _ = compare(STEPS, (0.0, pitch))
    assert np.degrees(estimator.calibration.pitch) == pytest.approx(-pitch, abs=0.6)


def test_scale_of_odometry_is_seen_and_its_motion_mended():
    odometry = [pose_from(T[:3, :3], 0.93 * T[:3, 3]) for T in STEPS]
    estimator, mended = compare(odometry)
    assert 0.93 * (1.0 + estimator.calibration.scale) == pytest.approx(1.0, abs=0.02)
    assert error(mended) < 0.5 * error(odometry)


def test_heading_that_drifts_is_mended():
    rng = np.random.default_rng(0)
    turns = np.cumsum(np.radians(rng.normal(0.5, 1.0, len(STEPS))))
    odometry = [pose_from(rot_z(turn) @ T[:3, :3], T[:3, 3]) for turn, T in zip(turns, STEPS, strict=True)]
    _, mended = compare(odometry)

    def heading(poses):
        turned = poses[0][:3, :3].T @ poses[-1][:3, :3] @ (STEPS[0][:3, :3].T @ STEPS[-1][:3, :3]).T
        return abs(np.degrees(np.arctan2(turned[1, 0], turned[0, 0])))

    assert heading(mended) < 0.6 * heading(odometry)


def test_walls_alone_do_not_show_a_climb():
    """The height between two frames is open where no ground is in sight: a wrong start is no lean of the sensor."""
    climbing = [pose_from(T[:3, :3], T[:3, 3] + [0.0, 0.0, 0.3 * k]) for k, T in enumerate(STEPS)]
    with_ground, walls = (compare(climbing, lowest=lowest)[0].calibration for lowest in (-np.inf, -1.2))
    assert abs(np.degrees(walls.pitch)) < 0.5 * abs(np.degrees(with_ground.pitch))
    assert walls.sigma_tilt > 1.2 * with_ground.sigma_tilt


def test_frames_that_have_nothing_to_do_with_each_other_change_little():
    """A registration that fails may come to anything: odometry is believed."""
    away = [*STEPS[:3], *(pose_from(rot_z(2.0), [10.0 - 3 * k, 14.0, 1.7]) for k in range(3))]
    estimator, mended = compare(STEPS, poses=away)
    assert abs(estimator.calibration.scale) < 0.02
    assert error(mended) < 1.0


def test_empty_frames_do_no_harm():
    motion, estimator = FrameMotion(LocalizerConfig().registration, 2.0), CalibrationEstimator()
    nothing = np.empty((0, 3), dtype=np.float32)
    for T in STEPS:
        np.testing.assert_array_equal(motion.refine(nothing, T, estimator, DRIFT), T)


@pytest.mark.slow
def test_poses_stay_rigid_over_a_hundred_keyframes():
    """Each is measured from the last; a long search would end by an error of 1e-3 otherwise."""
    scene, back_and_forth = boxes(3), [STEPS[2], STEPS[3]]
    clouds = [scan(scene, T, k)[::3].astype(np.float32) for k, T in enumerate(back_and_forth)]
    motion, estimator = FrameMotion(LocalizerConfig().registration, 2.0), CalibrationEstimator()
    for k in range(100):
        T = motion.refine(clouds[k % len(clouds)], back_and_forth[k % len(clouds)], estimator, DRIFT)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
