"""Between registrations: when the next is needed, what it will use, and how the covariance grows meanwhile."""

import numpy as np
import pytest
from trackers import Ride, match_and_update, registration, tracker_of

from coview_stream.config import LocalizerConfig, TrackingConfig
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.localization.calibration.calibration import RawScan
from coview_stream.localization.calibration.estimator import CalibrationEstimator
from coview_stream.localization.tracking.motion import ScanBuffer

NOTHING = np.zeros((20, 3), np.float32)
GOOD = {"position_drift": 1e-3, "yaw_drift": 1e-4, "turn_drift": 1e-3}
"""Odometry that is never unsure before a metre is over."""


def steps_until_due(world_map, poses, patience=1.0, **settings):
    """How many of the poses it takes after the first; a registration is never due at the first."""
    tracker = tracker_of(world_map, LocalizerConfig(tracking=TrackingConfig(**{**GOOD, **settings})))
    for k, T in enumerate(poses):
        tracker.add_scan(RawScan(NOTHING, T))
        if tracker.needs_registration(patience):
            return k
    return None


def straight(step, count=200):
    return [pose_from(np.eye(3), [step * k, 0.0, 0.0]) for k in range(count)]


def turning(angles):
    return [pose_from(rot_z(angle), np.zeros(3)) for angle in angles]


def test_no_registration_is_needed_while_standing(world_map):
    assert steps_until_due(world_map, [np.eye(4)] * 20, position_drift=5.0, yaw_drift=1.0) is None


@pytest.mark.parametrize(("patience", "metres"), [(1.0, 1.5), (3.0, 4.5)])
def test_registration_is_needed_after_distance_and_later_when_deferred(world_map, patience, metres):
    steps = steps_until_due(world_map, straight(0.02, 300), patience, distance=1.5)
    assert 0.02 * steps == pytest.approx(metres, abs=0.021)


def test_back_and_forth_driving_adds_up(world_map):
    shuttle = [pose_from(np.eye(3), [0.4 * (k % 2), 0.0, 0.0]) for k in range(9)]
    assert steps_until_due(world_map, shuttle, distance=1.5) == 4


def test_turning_needs_registration_and_back_and_forth_adds_up(world_map):
    turn = TrackingConfig().turn
    assert steps_until_due(world_map, turning(turn * np.array([0.0, 0.4, 0.8, 1.2]))) == 3
    assert steps_until_due(world_map, turning(turn * np.array([0.0, 0.4, 0.0, 0.4]))) == 3
    assert steps_until_due(world_map, turning(turn * np.array([0.0, 0.9, 0.9, 0.9]))) is None


@pytest.mark.parametrize(
    ("bad", "metres"),
    [
        ({"position_drift": 0.04}, 0.75**2),
        ({"yaw_drift": np.radians(0.2) / 0.75}, 0.75**2),
        ({"position_drift": 0.4}, 0.3),
        ({"yaw_drift": 0.4}, 0.3),
        ({"position_drift": 0.01}, 1.0),
    ],
)
def test_noisy_odometry_needs_registration_earlier_but_not_at_once(world_map, bad, metres):
    settings = {"distance": 1.0, **bad}
    steps = steps_until_due(world_map, straight(0.01), **settings)
    assert 0.01 * steps == pytest.approx(metres, abs=0.0101)
    late = steps_until_due(world_map, straight(0.05), 3.0, **settings)
    if metres == 0.75**2:
        assert 0.05 * late == pytest.approx(3.0, abs=0.0501)  # 9 x 0.56 m would be later than the thrice 1 m
    else:
        assert 0.05 * late == pytest.approx(3 * metres, abs=0.0501)


def test_no_registration_is_needed_right_after_an_update_or_a_rejection(world_map, world_drive):
    clouds, truth = world_drive.clouds, world_drive.T_map_body
    ride = Ride.begin(world_map, None, clouds[0], truth[0])
    ride.see(clouds[1], truth[1])
    assert ride.tracker.needs_registration()
    match_and_update(ride.tracker, clouds[1], ride.odometry(truth[1]))
    assert not ride.tracker.needs_registration()
    ride.see(clouds[1], truth[1])
    assert not ride.tracker.needs_registration()
    assert not ride.update(NOTHING, truth[2]).verified
    assert not ride.tracker.needs_registration()
    ride.see(clouds[3], truth[3])
    assert ride.tracker.needs_registration()


def scan_buffer(points, frames, step, **settings):
    """A buffer of frames ``step`` metres apart, each of so many points at its own number."""
    buffer = ScanBuffer(TrackingConfig(**settings), CalibrationEstimator())
    for k in range(frames):
        buffer.add(RawScan(np.full((points, 3), k, np.float32), np.eye(4)), step * k)
    return buffer


@pytest.mark.parametrize(
    ("points", "metres", "first"),
    [
        (1000, 2.0, 3),
        (300, 2.0, 0),  # 2,500 points need more
        (20_000, 2.0, 5),  # 50,000 are plenty
        (3000, 0.01, 7),
        (1000, 0.01, 5),
    ],
)
def test_scan_buffer_window_adapts_to_point_count(points, metres, first):
    window = scan_buffer(points, 8, 0.5, min_points=2500, max_points=50_000, window=metres).window()
    assert sorted({int(k) for k in window[:, 0]}) == list(range(first, 8))


def test_scan_buffer_drops_old_frames():
    """A robot that never gets its points together, on a robot that runs for weeks."""
    assert len(scan_buffer(10, 300, 0.01, min_points=10**6).window()) <= 400


@pytest.fixture
def started(world_map):
    """A tracker at the odometry's origin, and how unsure it is after driving to a pose."""
    tracker = tracker_of(world_map)

    def covariance(*poses):
        for T in poses:
            tracker.add_scan(RawScan(NOTHING, T))
        return tracker.predicted_covariance()

    covariance(np.eye(4))
    tracker.start(registration(np.eye(4)), np.eye(4), 0.0)
    return tracker, covariance


def test_covariance_grows_with_metres_and_radians(started):
    tracker, covariance = started
    before = np.diag(covariance())
    turned = np.diag(covariance(pose_from(rot_z(0.5), np.zeros(3))))
    drift = tracker.odometry.drift
    np.testing.assert_allclose(turned - before, drift.variances(0.0, 0.5), rtol=1e-3, atol=1e-6)
    assert turned[2] > before[2]
    driven = np.diag(covariance(pose_from(rot_z(0.5), [5.0, 0.0, 0.0])))
    grown = (driven - before)[[0, 1, 2, 3]]
    np.testing.assert_allclose(grown, drift.variances(5.0, 0.5)[:4], rtol=1e-3)


def test_late_fix_has_larger_covariance(world_map):
    sigmas = []
    for found_at in (3.0, 0.0):
        tracker = tracker_of(world_map)
        for x in (0.0, 3.0):
            tracker.add_scan(RawScan(NOTHING, pose_from(np.eye(3), [x, 0.0, 0.0])))
        tracker.start(registration(np.eye(4)), pose_from(np.eye(3), [3.0, 0.0, 0.0]), found_at)
        sigmas.append(np.diag(tracker.predicted_covariance()))
    expected = tracker.odometry.drift.variances(3.0, 0.0)
    np.testing.assert_allclose(sigmas[1] - sigmas[0], expected, rtol=0.01)
