"""What odometry is learnt from: registrations that agree with it at once, others once another one has followed."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.config import TrackingConfig
from coview_stream.geometry.transforms import exp_so3, pose_from
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.calibration.estimator import CalibrationEstimator
from coview_stream.localization.frame import OdometryCorrection
from coview_stream.localization.tracking.motion import OdometryTracker

SEEN = np.diag(np.square([0.002, 0.002, 0.002, 0.01, 0.01, 0.01]))
STRAIGHT = np.eye(3)


def at(x):
    return pose_from(STRAIGHT, [x, 0.0, 0.0])


class Ride:
    """Odometry that measures a metre where the robot drives ``scale``."""

    def __init__(self, scale):
        self.scale, self.estimator = scale, CalibrationEstimator()
        self.tracker = OdometryTracker(TrackingConfig(), self.estimator)
        self.correction = OdometryCorrection()

    def drive(self, to):
        T_odom_body = self.correction.correct(at(to / self.scale), self.estimator.calibration)
        self.tracker.add_pose(T_odom_body)
        self.tracker.set_keyframe(T_odom_body)

    def learn(self, to, confirmed=True):
        learn = self.tracker.learn if confirmed else self.tracker.learn_once_confirmed
        learn(at(to), SEEN)


def test_registration_that_odometry_contradicts_teaches_nothing_before_another_one():
    ride = Ride(1.3)
    ride.drive(0.0)
    ride.learn(0.0)
    ride.drive(6.0)
    known, drift = ride.estimator.calibration, ride.tracker.drift
    ride.learn(6.0, confirmed=False)
    assert ride.estimator.calibration == known
    assert ride.tracker.drift == drift
    ride.drive(12.0)
    ride.learn(12.0)
    assert ride.estimator.calibration.scale > known.scale
    assert ride.tracker.drift.position > drift.position


def test_contradicted_registration_that_is_forgotten_teaches_nothing():
    ride = Ride(1.3)
    ride.drive(0.0)
    ride.learn(0.0)
    ride.drive(6.0)
    known = ride.estimator.calibration.scale
    ride.learn(6.0, confirmed=False)
    ride.tracker.forget_registration()
    ride.drive(12.0)
    ride.learn(12.0)
    assert ride.estimator.calibration.scale == known


def test_contradictions_in_a_row_outvote_odometry():
    ride = Ride(1.05)
    for k in range(12):
        ride.drive(6.0 * k)
        ride.learn(6.0 * k, confirmed=False)
    assert ride.estimator.calibration.scale == pytest.approx(0.05, abs=0.015)


def test_tilt_is_that_of_the_cloud_whatever_is_known_already():
    lean = exp_so3(np.radians([0.0, 2.0, 0.0]))
    for known in (0.0, -1.0, -2.0):
        estimator = CalibrationEstimator()
        estimator.restore(Calibration(pitch=np.radians(known)))
        for _ in range(20):
            estimator.measure_attitude(pose_from(lean.T, np.zeros(3)), np.eye(4), np.radians(0.05) ** 2)
        assert np.degrees(estimator.calibration.pitch) == pytest.approx(-2.0, abs=0.15), known
