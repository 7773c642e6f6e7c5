"""Calibration: tilt, scale and turn that are estimated from registrations, and what they correct."""

import numpy as np
import pytest
from se3 import exp_se3

from coview_stream.geometry.transforms import exp_so3, inverse, pose_from, rot_z
from coview_stream.localization.calibration.calibration import LEVEL, Calibration
from coview_stream.localization.calibration.estimator import SIZE, CalibrationBelief, CalibrationEstimator
from coview_stream.localization.frame import OdometryCorrection

NOISE = np.diag([0.02**2, 0.02**2, np.radians(0.1) ** 2])  # along the way, across, of the heading


@pytest.mark.parametrize("scale", [0.9, 1.1])
def test_scale_and_turn_of_odometry_are_estimated(scale):
    """A straight way of two metres a step, along which odometry turns by 0.1 degrees per metre."""
    estimator, correction, raw, before = CalibrationEstimator(), OdometryCorrection(), np.eye(4), None
    for _ in range(40):
        T_odom = correction.correct(raw, estimator.calibration)
        if before is not None:
            truth = pose_from(np.eye(3), [2.0, 0.0, 0.0])
            estimator.measure_motion(np.eye(4), truth, inverse(before) @ T_odom, NOISE)
        before, raw = T_odom, raw @ pose_from(rot_z(np.radians(0.2)), [2.0 * scale, 0.0, 0.0])
    assert (1.0 + estimator.calibration.scale) * scale == pytest.approx(1.0, abs=0.005)
    assert np.degrees(estimator.calibration.turn) == pytest.approx(-0.1, abs=0.03)


@pytest.mark.parametrize(
    ("correction", "clause"),
    [
        ({"scale": 0.05}, "odometry measures 5.0% too short"),
        ({"scale": -0.05}, "odometry measures 5.0% too long"),
        ({"turn": np.radians(-0.1)}, "odometry turns 0.10 deg per metre too far left"),
        ({"ground": 0.25}, "0.25 m above the survey's"),
        ({"changed": -1.6}, "the ground here lies 1.6 m below the survey's (dug): heights follow odometry"),
    ],
)
def test_only_noticeable_corrections_are_reported(correction, clause):
    assert clause in Calibration(**correction).describe()[0]
    assert Calibration(**{name: 0.1 * value for name, value in correction.items()}).describe() == []


def test_known_calibration_is_a_prior_and_no_more():
    before = Calibration(pitch=np.radians(3.0), sigma_tilt=np.radians(0.2)).doubted()
    assert np.degrees(before.sigma_tilt) == pytest.approx(1.0)
    estimator = CalibrationEstimator()
    estimator.learn(before)
    assert np.degrees(estimator.calibration.pitch) == pytest.approx(3.0, abs=0.7)
    known = Calibration(0.0, np.radians(4.0), 0.05, 0.0, np.radians(0.2), 0.002, np.radians(0.005))
    estimator.learn(known)
    assert estimator.calibration.pitch == pytest.approx(known.pitch, rel=0.02)
    assert estimator.calibration.scale == pytest.approx(known.scale, rel=0.02)


def test_lean_that_was_measured_on_changed_ground_is_forgotten_and_the_rest_stays():
    estimator = CalibrationEstimator()
    fresh = estimator.calibration
    leaning = pose_from(exp_so3(np.radians([0.0, 2.0, 0.0])), np.zeros(3))
    for _ in range(10):
        estimator.measure_attitude(leaning, np.eye(4), 1e-6)
        estimator.measure_motion(np.eye(4), pose_from(np.eye(3), [2.1, 0, 0]), pose_from(np.eye(3), [2.0, 0, 0]), NOISE)
    scale = estimator.calibration.scale
    assert np.degrees(estimator.calibration.pitch) > 1.5
    estimator.forget_tilt()
    assert (estimator.calibration.roll, estimator.calibration.pitch) == (0.0, 0.0)
    assert estimator.calibration.sigma_tilt == pytest.approx(fresh.sigma_tilt, rel=0.01)
    assert estimator.calibration.scale == scale > 0.01


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
    for T in (exp_se3(rng.normal(0.0, 0.5, 6)) for _ in range(10)):
        corrected = correction.correct(T, Calibration(scale=0.05, turn=0.02))
        np.testing.assert_allclose(corrected[2, :3], T[2, :3], atol=1e-12)
        np.testing.assert_allclose(OdometryCorrection().correct(T, Calibration()), T, atol=1e-12)


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
        estimator.measure_frames(motion, step, np.full(6, 1e-5), np.array([*np.radians([0.2] * 3), 0.02, 0.02, 0.02]))
    assert before > np.radians(3.0)
    assert abs(estimator.calibration.pitch) < np.radians(0.5)


def test_measurement_that_may_be_wrong_moves_the_belief_as_much_less():
    H, R, gap = np.eye(1, SIZE), np.array([[np.radians(0.5) ** 2]]), np.radians([1.0])
    moved = []
    for right in (1.0, 0.25):
        belief = CalibrationBelief(sensor_leans=True)
        belief.update(gap, H, R, right)
        moved.append(belief.x[0])
    assert moved[1] == pytest.approx(0.25 * moved[0], rel=0.05)


def test_lean_that_a_leading_place_has_told_costs_its_probability():
    estimator = CalibrationEstimator()
    assert estimator.lean_prior == 0.0
    T = pose_from(exp_so3(np.radians([0.0, 4.0, 0.0])), np.zeros(3))
    estimator.suppose_attitude(T, np.eye(4), np.radians(0.3) ** 2, 0.99)
    spread = np.hypot(CalibrationEstimator().calibration.sigma_tilt, LEVEL)
    lean = estimator.calibration.leans_from(Calibration())
    assert estimator.lean_prior == pytest.approx(2 * np.log(LEVEL / spread) - 0.5 * (lean / spread) ** 2)
    assert lean > np.radians(1.0)
    estimator.forget_leader()
    assert estimator.lean_prior == 0.0
    assert estimator.calibration == CalibrationEstimator().calibration
