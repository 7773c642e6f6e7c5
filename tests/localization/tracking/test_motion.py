"""Drift of odometry: its covariance, its estimate from registrations, and the registrations that teach it."""

import numpy as np
import pytest

from coview_stream.config import TrackingConfig
from coview_stream.geometry.transforms import exp_so3, pose_from, rot_z
from coview_stream.geometry.validation import check_covariance
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.calibration.estimator import CalibrationEstimator
from coview_stream.localization.frame import OdometryCorrection
from coview_stream.localization.tracking.motion import Drift, DriftEstimator, OdometryTracker

CONFIG = TrackingConfig(
    position_drift=0.015,
    height_drift=0.01,
    tilt_drift=np.radians(0.05),
    yaw_drift=np.radians(0.15),
    turn_drift=0.02,
    drift_prior=10.0,
)
NOISE = np.square([3e-4, 3e-4, 2e-4, 0.004, 0.004, 0.002])
RATES = Drift(position=0.1, height=0.05, tilt=0.01, yaw=0.02, turn=0.05)


def test_noise_is_a_random_walk_over_metres_and_radians():
    sigma = np.sqrt(np.diag(RATES.covariance(4.0, 0.6)))
    np.testing.assert_allclose(sigma, [0.02, 0.02, np.hypot(0.04, 0.03), 0.2, 0.2, 0.1])
    np.testing.assert_allclose(
        np.sqrt(np.diag(RATES.reported(4.0, 0.6))), [0.2, 0.2, 0.1, 0.02, 0.02, np.hypot(0.04, 0.03)]
    )


def test_noise_of_standing_still_is_a_valid_covariance():
    check_covariance(Drift.of(CONFIG).covariance(0.0, 0.0), "still")


def driven(true: Drift, metres=100.0, step=1.0, turned=0.0, seed=0, config=CONFIG, noise=NOISE):
    """An estimator that was shown a drive with odometry of these rates."""
    estimator, rng = DriftEstimator(config), np.random.default_rng(seed)
    for _ in range(round(metres / step)):
        gap = rng.normal(0.0, np.sqrt(true.variances(step, turned) + noise))
        estimator.add(gap, noise, step, turned)
    return estimator


@pytest.mark.parametrize("factor", [0.3, 1.0, 5.0])
def test_noise_rates_are_estimated(factor):
    """Registrations must be able to show them: where odometry is good, they have to be."""
    nominal = Drift.of(CONFIG)
    true = Drift(*(factor * rate for rate in vars(nominal).values()))
    noise = NOISE * min(1.0, factor**2)
    estimate = [list(vars(driven(true, seed=seed, noise=noise).drift).values()) for seed in range(10)]
    np.testing.assert_allclose(np.mean(estimate, axis=0), list(vars(true).values()), rtol=0.2)


def test_registration_noise_is_hardly_taken_for_odometry_noise():
    """Clipped at zero, what is left of it adds up a little."""
    perfect, nominal = Drift(0.0, 0.0, 0.0, 0.0, 0.0), Drift.of(CONFIG)
    for scale in (0.1, 1.0, 10.0):
        sigma = np.sqrt(scale * NOISE)
        estimate = driven(perfect, 200.0, noise=scale * NOISE).drift
        assert estimate.tilt < max(0.9 * sigma[0], 0.35 * nominal.tilt)
        assert estimate.yaw < max(0.9 * sigma[2], 0.35 * nominal.yaw)
        assert estimate.position < max(0.9 * sigma[3], 0.35 * nominal.position)


def test_each_noise_rate_is_estimated_independently():
    true = Drift(position=0.1, height=0.001, tilt=1e-4, yaw=0.01, turn=0.0)
    estimate = driven(true, 200.0).drift
    assert estimate.position == pytest.approx(0.1, rel=0.3)
    assert estimate.yaw == pytest.approx(0.01, rel=0.3)
    assert estimate.height < 0.35 * CONFIG.height_drift
    assert estimate.tilt < 0.5 * CONFIG.tilt_drift


def test_noise_starts_at_configured_rates():
    assert DriftEstimator(CONFIG).drift == Drift.of(CONFIG)
    bad = Drift(*(10 * rate for rate in vars(Drift.of(CONFIG)).values()))
    after = [driven(bad, metres).drift.yaw / CONFIG.yaw_drift for metres in (1.0, 10.0, 100.0)]
    assert after[0] < 5.0
    assert after[0] < after[2]
    assert after[2] == pytest.approx(10.0, rel=0.4)


def test_old_observations_are_forgotten():
    estimator = driven(Drift(*(5 * rate for rate in vars(Drift.of(CONFIG)).values())))
    assert estimator.drift.position > 3 * CONFIG.position_drift
    rng = np.random.default_rng(1)
    for _ in range(200):
        estimator.add(rng.normal(0.0, np.sqrt(NOISE)), NOISE, 1.0, 0.0)
    assert estimator.drift.position < 0.7 * CONFIG.position_drift


def test_one_slip_does_not_inflate_odometry_noise():
    estimator = driven(Drift.of(CONFIG))
    before = estimator.drift.position
    estimator.add(np.array([0.0, 0.0, 0.0, 3.0, 0.0, 0.0]), NOISE, 1.0, 0.0)  # 200 sigma
    assert before < estimator.drift.position < 1.5 * before


def test_turning_on_the_spot_updates_yaw_noise_only():
    estimator, rng = DriftEstimator(CONFIG), np.random.default_rng(2)
    for _ in range(60):
        gap = rng.normal(0.0, np.sqrt(NOISE))
        gap[2] += rng.normal(0.0, 0.06 * 0.5)
        estimator.add(gap, NOISE, 0.0, 0.5)
    assert estimator.drift.turn == pytest.approx(0.06, rel=0.3)
    assert estimator.drift.position == pytest.approx(CONFIG.position_drift, rel=0.2)


SEEN = np.diag(np.square([0.002, 0.002, 0.002, 0.01, 0.01, 0.01]))


def at(x):
    return pose_from(np.eye(3), [x, 0.0, 0.0])


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


def test_jump_after_the_pose_was_forgotten_is_not_driven():
    ride = Ride(1.0)
    for x in (0.0, 2.0):
        ride.drive(x)
    ride.tracker.forget_pose()
    ride.drive(500.0)
    ride.drive(501.0)
    assert ride.tracker.travelled == pytest.approx(3.0)


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


def learned_in_a_bend(turn, metres, wrong, slips, frames):
    """Return the calibration after so many equal steps; odometry is 1.5 times too long in the steps ``wrong``.

    The registrations ``slips`` are learned as those of wheels that slip.
    """
    estimator, T_map_body, odometry = CalibrationEstimator(), np.eye(4), np.eye(4)
    tracker, correction = OdometryTracker(TrackingConfig(), estimator), OdometryCorrection()
    for k in range(frames):
        T_odom_body = correction.correct(odometry, estimator.calibration)
        tracker.add_pose(T_odom_body)
        tracker.set_keyframe(T_odom_body)
        tracker.learn(T_map_body, SEEN, slips=k in slips)
        T_map_body = T_map_body @ pose_from(rot_z(turn), [metres, 0.0, 0.0])
        odometry = odometry @ pose_from(rot_z(turn), [metres * (1.5 if k in wrong else 1.0), 0.0, 0.0])
    return estimator.calibration


def test_motion_of_wheels_that_slip_shows_nothing():
    """In a bend odometry that is out of scale looks like a lever arm."""
    for slips in (range(10, 14), range(10, 24)):  # for a while, and for good
        found = learned_in_a_bend(0.15, 1.0, wrong=slips[:-1], slips=slips, frames=24)
        assert abs(found.scale) < 0.005
        assert np.hypot(found.lever_x, found.lever_y) < 0.01


def test_tilt_is_that_of_the_cloud_whatever_is_known_already():
    lean = exp_so3(np.radians([0.0, 2.0, 0.0]))
    for known in (0.0, -1.0, -2.0):
        estimator = CalibrationEstimator()
        estimator.learn(Calibration(pitch=np.radians(known), sigma_tilt=np.radians(2.0)))
        for _ in range(20):
            estimator.measure_attitude(pose_from(lean.T, np.zeros(3)), np.eye(4), np.radians(0.05) ** 2)
        assert np.degrees(estimator.calibration.pitch) == pytest.approx(-2.0, abs=0.15), known
