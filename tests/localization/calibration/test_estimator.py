"""Calibration: tilt, scale and turn that are estimated from registrations, and what they correct."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.config.mount import Mount
from coview_stream.geometry.transforms import exp_so3, inverse, pose_from, rot_z
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.calibration.estimator import CalibrationEstimator
from coview_stream.localization.frame import OdometryCorrection

NOISE = np.array([0.02**2, np.radians(0.1) ** 2])  # along the way, of the heading


def truth_of(steps, metres, rng):
    """True poses of a body that leans with the ground and turns as it drives."""
    poses, heading, position = [], 0.3, np.array([5.0, -3.0, 1.0])
    for _ in range(steps):
        lean = exp_so3(np.array([*np.radians(rng.normal(0, 2, 2)), 0.0]))
        poses.append(pose_from(rot_z(heading) @ lean, position.copy()))
        heading += rng.normal(0, 0.2)
        position += rot_z(heading) @ np.array([metres, 0.0, 0.0])
    return poses


def drive(tilt=(0.0, 0.0), scale=1.0, turn=0.0, steps=40, metres=2.0, seed=0):
    """Register a robot along its way, with its sensor turned by ``tilt`` degrees; return the estimator, and its errors.

    ``scale`` and ``turn`` (degrees per metre) are odometry's: what the estimator should find is their inverse.
    """
    rng = np.random.default_rng(seed)
    estimator, correction = CalibrationEstimator(), OdometryCorrection()
    E = exp_so3(np.array([*np.radians(tilt), 0.0]))  # what levels the clouds
    before = None
    poses = truth_of(steps, metres, rng)
    raw = pose_from(poses[0][:3, :3], np.zeros(3))
    for k, truth in enumerate(poses):
        if k:
            moved = truth[:3, 3] - poses[k - 1][:3, 3]
            yaw = np.radians(turn) * metres * k
            raw = pose_from(rot_z(yaw) @ truth[:3, :3], raw[:3, 3] + scale * rot_z(yaw) @ moved)
        T_odom = correction.correct(raw, estimator.calibration)
        seen = pose_from(truth[:3, :3] @ E @ estimator.calibration.R_body_cloud.T, truth[:3, 3])
        seen[:3, :3] = seen[:3, :3] @ exp_so3(np.radians(rng.normal(0, 0.05, 3)))
        seen[:3, 3] += rng.normal(0, 0.01, 3)
        if before is not None:
            T_seen, T_before = before
            estimator.measure_motion(T_seen, seen, inverse(T_before) @ T_odom, NOISE)
        estimator.measure_attitude(seen @ estimator.calibration.T_body_cloud, T_odom, np.radians(0.05) ** 2)
        before = seen, T_odom
    return estimator.calibration


def test_sensor_and_odometry_that_are_right_are_left_alone():
    found = drive()
    assert abs(np.degrees([found.roll, found.pitch])).max() < 0.1
    assert abs(found.scale) < 0.003
    assert abs(np.degrees(found.turn)) < 0.01
    assert found.describe() == []


@pytest.mark.parametrize("tilt", [(0.0, -3.0), (2.0, 0.0), (-7.0, 9.0), (1.0, 1.0)])
def test_tilt_of_the_sensor_is_found(tilt):
    found = drive(tilt)
    np.testing.assert_allclose(np.degrees([found.roll, found.pitch]), tilt, atol=0.2)
    assert np.degrees(found.sigma_tilt) < 0.3
    clauses = [clause for clause in found.describe() if "sensor leans" in clause]
    assert len(clauses) == 1


@pytest.mark.parametrize("scale", [0.9, 0.95, 1.05, 1.1])
def test_scale_and_turn_of_odometry_are_found(scale):
    found = drive(scale=scale, turn=0.1)
    assert np.degrees(found.turn) == pytest.approx(-0.1, abs=0.03)
    assert (1.0 + found.scale) * scale == pytest.approx(1.0, abs=0.005)
    assert any("too short" in c if scale < 1 else "too long" in c for c in found.describe())


def test_lean_is_told_as_the_mount_that_silences_it():
    leaning = Calibration(pitch=np.radians(2.9))
    assert leaning.describe() == ["sensor leans 2.9 deg in pitch: corrected; set --mount=0,2.9,0 to silence this"]
    assert "--mount=180,2.9,0 " in leaning.describe(Mount(roll=np.pi))[0]
    assert leaning.to_json()["says"] == leaning.describe()


def test_what_was_known_before_is_a_prior_and_no_more():
    before = drive((0.0, 3.0))
    assert np.degrees(before.doubted().sigma_tilt) == pytest.approx(1.0)
    estimator = CalibrationEstimator()
    estimator.learn(before.doubted())
    assert np.degrees(estimator.calibration.pitch) == pytest.approx(3.0, abs=0.7)
    known = Calibration(0.0, np.radians(4.0), 0.05, 0.0, np.radians(0.2), 0.002, np.radians(0.005))
    estimator.learn(known)
    assert estimator.calibration.pitch == pytest.approx(known.pitch, rel=0.02)
    assert estimator.calibration.scale == pytest.approx(known.scale, rel=0.02)


def test_sensor_that_cannot_lean_does_not():
    estimator = CalibrationEstimator(sensor_leans=False)
    estimator.learn(Calibration(pitch=0.1, sigma_tilt=1e-3))
    leaning = pose_from(exp_so3(np.radians([0.0, 3.0, 0.0])), np.zeros(3))
    for _ in range(20):
        estimator.measure_attitude(leaning, np.eye(4), 1e-6)
        estimator.measure_motion(np.eye(4), pose_from(np.eye(3), [2.1, 0, 0]), pose_from(np.eye(3), [2.0, 0, 0]), NOISE)
    assert (estimator.calibration.roll, estimator.calibration.pitch) == (0.0, 0.0)
    assert estimator.calibration.sigma_tilt < np.radians(0.01)
    assert estimator.calibration.scale > 0.02  # the rest is learnt all the same


def test_one_slip_does_not_become_a_scale():
    estimator = CalibrationEstimator()
    step = pose_from(np.eye(3), [1.0, 0.0, 0.0])
    T = np.eye(4)
    for k in range(20):
        moved = pose_from(np.eye(3), [1.0 if k != 10 else 1.6, 0.0, 0.0])
        estimator.measure_motion(T, T @ moved, step, NOISE)
        assert abs(estimator.calibration.scale) < 0.015
        T = T @ moved


def test_small_lean_is_odometrys_gravity_rather_than_the_sensor():
    """Odometry's gravity is good to a quarter of a degree: what is no more than that is not corrected."""
    estimator = CalibrationEstimator()
    lean = pose_from(exp_so3(np.radians([0.2, 0.0, 0.0])), np.zeros(3))
    estimator.measure_attitude(lean, np.eye(4), np.radians(0.05) ** 2)
    assert abs(np.degrees(estimator.calibration.roll)) < 0.05


def test_corrected_odometry_keeps_its_gravity():
    correction, rng = OdometryCorrection(), np.random.default_rng(1)
    for T in truth_of(10, 3.0, rng):
        corrected = correction.correct(T, Calibration(scale=0.05, turn=0.02))
        np.testing.assert_allclose(corrected[2, :3], T[2, :3], atol=1e-12)
        np.testing.assert_allclose(OdometryCorrection().correct(T, Calibration()), T, atol=1e-12)


def test_ground_above_the_surveys_is_told():
    assert Calibration(ground=0.05).describe() == []
    assert "0.25 m above the survey's" in Calibration(ground=0.25).describe()[0]
    assert Calibration(ground=0.25).to_json()["ground_offset_m"] == 0.25


@pytest.mark.parametrize("probability", [0.1, 0.5, 0.9, 0.999])
def test_place_that_leads_tells_the_lean_as_far_as_it_is_probable(probability):
    lean = exp_so3(np.radians([0.0, 3.0, 0.0]))
    estimator, sure = CalibrationEstimator(), CalibrationEstimator()
    for _ in range(5):  # the same scans, looked at again, tell nothing new
        estimator.suppose_attitude(pose_from(lean, np.zeros(3)), np.eye(4), np.radians(1.0) ** 2, probability)
    sure.measure_attitude(pose_from(lean, np.zeros(3)), np.eye(4), np.radians(1.0) ** 2)
    assert abs(sure.calibration.pitch) > np.radians(1.5)
    assert estimator.calibration.pitch == pytest.approx(probability * sure.calibration.pitch, rel=1e-6)


def test_known_place_does_away_with_what_was_supposed():
    wrong, right = (pose_from(exp_so3(np.radians([0.0, pitch, 0.0])), np.zeros(3)) for pitch in (-6.0, 2.0))
    supposed, fresh = CalibrationEstimator(), CalibrationEstimator()
    supposed.suppose_attitude(wrong, np.eye(4), np.radians(1.0) ** 2, 0.9)
    for estimator in (supposed, fresh):
        estimator.measure_attitude(right, np.eye(4), np.radians(0.5) ** 2)
    assert supposed.calibration == fresh.calibration


def test_motion_from_frame_to_frame_refutes_a_supposed_lean():
    """Of a robot that drives straight ahead on flat ground, and whose sensor stands straight."""
    wrong = pose_from(exp_so3(np.radians([0.0, 6.0, 0.0])), np.zeros(3))
    estimator = CalibrationEstimator()
    estimator.suppose_attitude(wrong, np.eye(4), np.radians(1.0) ** 2, 0.9)
    before = abs(estimator.calibration.pitch)
    step = pose_from(np.eye(3), [2.0, 0.0, 0.0])
    for _ in range(8):
        level = pose_from(estimator.calibration.R_body_cloud, np.zeros(3))
        motion = level @ step @ np.linalg.inv(level)
        estimator.measure_frames(motion, step, np.full(6, 1e-5), 0.02, np.radians(0.2))
    assert before > np.radians(3.0)
    assert abs(estimator.calibration.pitch) < np.radians(0.5)
