"""Odometry that contradicts the lidar: slips, steps of another place, wheels that stand while the robot is carried."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_world import pose_error
from trackers import garbage, on_the_way, refused, ride_of

from coview_stream.config import AcceptanceConfig, LocalizerConfig, TrackingConfig
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.localization.tracking.monitor import RejectionReason

RULE = AcceptanceConfig()
SIDEWAYS = pose_from(np.eye(3), [0.0, 0.6, 0.0])


# ---- odometry that slips


@pytest.mark.slow
@pytest.mark.parametrize(
    "slip",
    [
        SIDEWAYS,
        pose_from(np.eye(3), [-0.75, 0.0, 0.0]),  # along the way 0.6 m may take another view to be sure of
        pose_from(np.eye(3), [0.9, -0.6, 0.1]),
        pose_from(rot_z(np.radians(6.0)), [0.1, 0.0, 0.0]),
    ],
)
def test_odometry_slip_is_detected_and_corrected(world_map, slow_drive, slip):
    ride, k = on_the_way(world_map, slow_drive), 8
    clouds, truth = slow_drive.clouds, slow_drive.T_map_body
    drift = ride.tracker.odometry.drift
    metres, degrees = pose_error(slip, np.eye(4))
    ride.slips(slip, truth[k - 1])
    verdict = ride.update(clouds[k], truth[k])
    assert verdict.cause is RejectionReason.ODOMETRY
    assert not verdict.verified
    assert verdict.innovation > RULE.max_innovation
    told = [float(word) for word in verdict.reason.split() if word[0].isdigit()]
    # by the new way's end a wrong heading is a wrong place, too
    assert told[0] == pytest.approx(metres, abs=0.03 + 0.2 * np.radians(degrees))
    assert told[1] == pytest.approx(degrees, abs=0.2)
    assert verdict.score > 0.8
    assert ride.error(truth[k])[0] < 0.03
    # it was hardly drift: far outside what drift allows, it counts as a step at the edge of that
    assert ride.tracker.odometry.drift.position < 2.5 * drift.position
    assert ride.update(clouds[k + 1], truth[k + 1]).cause is RejectionReason.VERIFIED
    assert ride.tracker.odometry.drift.position < 2.5 * drift.position  # nor does the step across it tell of any
    metres, degrees = ride.error(truth[k + 1])
    assert metres < 0.03
    assert degrees < 0.2


def test_random_points_are_not_taken_for_a_slip(world_map, slow_drive, elsewhere):
    """Garbage and another world may register anywhere within reach: that is no slip."""
    ride = on_the_way(world_map, slow_drive)
    for cloud in (garbage(), *elsewhere.clouds):
        assert refused(ride, cloud, slow_drive.T_map_body[8], newest_only=True).cause is not RejectionReason.ODOMETRY


def test_plausible_drift_is_not_a_slip(world_map, slow_drive):
    """How far odometry may be off depends on how far it has driven, and on how it has been so far."""
    small = pose_from(np.eye(3), [0.0, 0.06, 0.0])
    causes = []
    for trusted in (0.002, 0.1):
        config = LocalizerConfig(tracking=replace(TrackingConfig(), position_drift=trusted, drift_prior=1000.0))
        ride = on_the_way(world_map, slow_drive, config)
        ride.slips(small, slow_drive.T_map_body[7])
        causes.append(ride.update(slow_drive.clouds[8], slow_drive.T_map_body[8]).cause)
    assert causes == [RejectionReason.ODOMETRY, RejectionReason.VERIFIED]


def test_slip_of_the_heading_alone_is_followed_at_once(world_map, slow_drive):
    """What has been moved since the survey does not turn about the robot: the pose is not withheld."""
    config = LocalizerConfig(tracking=replace(TrackingConfig(), yaw_drift=np.radians(0.01), drift_prior=1000.0))
    ride = on_the_way(world_map, slow_drive, config)
    ride.slips(pose_from(rot_z(np.radians(1.2)), np.zeros(3)), slow_drive.T_map_body[7])
    verdict = ride.update(slow_drive.clouds[8], slow_drive.T_map_body[8])
    assert verdict.verified
    assert verdict.innovation > RULE.max_innovation
    metres, degrees = ride.error(slow_drive.T_map_body[8])
    assert metres < 0.03
    assert degrees < 0.2


def test_step_in_height_is_not_followed(world_map, slow_drive):
    """No wheel slips upwards: a step of 0.3 m along the ground is followed."""
    errors = []
    for step in ([0.0, 0.3, 0.0], [0.0, 0.0, 0.3]):
        ride = on_the_way(world_map, slow_drive)
        ride.slips(pose_from(np.eye(3), step), slow_drive.T_map_body[7])
        verdict = ride.update(slow_drive.clouds[8], slow_drive.T_map_body[8])
        assert verdict.cause is RejectionReason.ODOMETRY
        errors.append(ride.error(slow_drive.T_map_body[8])[0])
    assert errors[0] < 0.03
    assert errors[1] > 0.25


def test_displaced_frame_is_detected_only_after_a_good_one(world_map, slow_drive):
    clouds, truth = slow_drive.clouds, slow_drive.T_map_body
    away = pose_from(np.eye(3), [6.0, 3.0, 0.0])
    ride = ride_of(world_map, slow_drive, frame=0)
    ride.see(clouds[1], truth[1])
    assert not ride.tracker.looks_displaced(ride.odometry(truth[1] @ away))  # nothing to compare with
    ride = on_the_way(world_map, slow_drive)
    ride.see(clouds[8], truth[8])
    assert not ride.tracker.looks_displaced(ride.odometry(truth[8]))
    ride.slips(away, truth[8])
    ride.see(clouds[9], truth[9])
    assert ride.tracker.looks_displaced(ride.odometry(truth[9]))
    ride.tracker.forget_scans()
    assert not ride.tracker.looks_displaced(ride.odometry(truth[9]))  # no frame to look at


# ---- standing still


def stood(world_map, slow_drive, looks, standing_still):
    """Variances of the belief after looking again and again at the same thing."""
    ride = on_the_way(world_map, slow_drive, frames=3)
    for _ in range(looks):
        assert ride.update(slow_drive.clouds[3], slow_drive.T_map_body[3], standing_still=standing_still).verified
    return np.diag(ride.tracker.predicted_covariance())


@pytest.mark.slow
def test_repeated_registrations_while_standing_do_not_shrink_covariance(world_map, slow_drive):
    some, many = (stood(world_map, slow_drive, looks, standing_still=True) for looks in (5, 40))
    np.testing.assert_allclose(many, some, rtol=0.15)
    assert (
        stood(world_map, slow_drive, 40, standing_still=False) < 0.5 * some
    ).sum() >= 2  # or it could not be seen here


def test_standing_still_uses_only_scans_since_last_registration(world_map, slow_drive):
    """It may have been carried meanwhile: the frames before the last look are of another place."""
    wide = LocalizerConfig(tracking=TrackingConfig(window=20.0, min_points=30_000))
    ride = on_the_way(world_map, slow_drive, wide, 4)
    for k in (1, 2):
        ride.see(garbage(k), slow_drive.T_map_body[4])
    verdict = ride.update(garbage(3), slow_drive.T_map_body[4], standing_still=True)
    assert not verdict.verified
    assert verdict.ratio < -5.0
    moving = on_the_way(world_map, slow_drive, wide, 4)
    for k in (1, 2):
        moving.see(garbage(k), slow_drive.T_map_body[4])
    assert moving.update(garbage(3), slow_drive.T_map_body[4]).score > verdict.score
