"""Updates of a tracker: which registrations are believed, what they do to the belief, and the others' verdicts."""

from dataclasses import replace

import numpy as np
import pytest
from se3 import exp_se3
from small_world import pose_error, scan
from trackers import (
    OFF,
    T_MAP_ODOM,
    Ride,
    add_frame,
    garbage,
    match_and_update,
    on_the_way,
    refused,
    registration,
    ride_of,
)

from coview_stream.config import AcceptanceConfig, LocalizerConfig, TrackingConfig
from coview_stream.geometry.transforms import exp_so3, inverse, pose_from, rot_z
from coview_stream.localization.calibration.estimator import CalibrationEstimator
from coview_stream.localization.registration.clouds import LocalMaps
from coview_stream.localization.registration.register import registration_covariance, swap_rotation_translation
from coview_stream.localization.tracking.monitor import RejectionReason
from coview_stream.localization.tracking.shared_error import SharedErrorModel
from coview_stream.localization.tracking.tracker import Tracker

RULE = AcceptanceConfig()
WIDE = LocalizerConfig(tracking=TrackingConfig(window=20.0, min_points=30_000))  # all scans so far are one


def test_good_registration_is_accepted(world_map, world_drive):
    cloud, truth = world_drive.clouds[4], world_drive.T_map_body[4]
    ride = ride_of(world_map, world_drive)
    before = ride.tracker.predicted_covariance()
    assert ride.error(truth)[0] == pytest.approx(0.25)
    verdict = ride.update(cloud, truth)
    assert verdict.cause is RejectionReason.VERIFIED
    assert verdict.verified
    assert verdict.reason == "verified"
    assert verdict.score == verdict.evidence.score > 0.8
    assert 0.0 < verdict.innovation < RULE.max_innovation
    ride.assert_right(truth, 0.05)
    after = ride.tracker.predicted_covariance()
    assert np.diag(after)[3:].max() < 0.1 * np.diag(before)[3:].min()
    floor = np.diag(registration_covariance(1e14 * np.eye(6), ride.tracker.config.registration))
    assert (np.diag(after) > 0.9 * floor).all()
    shared = SharedErrorModel(ride.tracker.config.registration).covariance  # without a registration: the least
    assert (np.diag(swap_rotation_translation(ride.tracker.reported_covariance()) - shared) > 0.0).all()


def test_error_is_within_reported_covariance(world_map, slow_drive):
    """Odometry lies by 5 %, in both ways, and is corrected once a metre."""
    for scale in (0.95, 1.05):
        ride = ride_of(world_map, slow_drive, frame=0)
        T, off = ride.odometry(slow_drive.T_map_body[0]), []
        for k in range(1, len(slow_drive.clouds)):
            step = inverse(slow_drive.T_map_body[k - 1]) @ slow_drive.T_map_body[k]
            step[:3, 3] *= scale
            T = T @ step
            add_frame(ride.tracker, slow_drive.clouds[k], T)
            if ride.tracker.needs_registration():
                assert match_and_update(ride.tracker, slow_drive.clouds[k], T).verified
                gap = (ride.tracker.T_map_odom @ T)[:2, 3] - slow_drive.T_map_body[k][:2, 3]
                C = ride.tracker.reported_covariance()[:2, :2]
                off.append(gap @ np.linalg.solve(C, gap))
        assert len(off) > 6
        assert np.sqrt(max(off)) < 3.5
        assert pose_error(ride.tracker.T_map_odom @ T, slow_drive.T_map_body[-1])[0] < 0.1


def test_prefetch_map_sorts_a_crop(world_map, world_drive):
    """On a frame that registers nothing: both together would take too long."""
    truth = world_drive.T_map_body[4]
    ride = ride_of(world_map, world_drive)
    around = ride.tracker.local_maps.around
    assert "grid" not in vars(around(truth[:3, 3]))
    ride.tracker.prefetch_map(ride.odometry(truth))
    assert "grid" in vars(around(truth[:3, 3]))


def test_registration_corrects_and_teaches_nothing_unless_it_is_believed(world_map, world_drive):
    """Its weight after the ones before is for the monitor to decide."""
    cloud, truth = world_drive.clouds[4], world_drive.T_map_body[4]
    ride, fresh = (ride_of(world_map, world_drive) for _ in range(2))
    ride.see(cloud, truth)
    match = ride.tracker.match_to_map(cloud, ride.odometry(truth))
    assert match.verdict.verified
    ride.tracker.update(match, ride.odometry(truth), False)
    assert ride.error(truth)[0] == pytest.approx(0.25)
    assert not ride.tracker.looks_displaced(ride.odometry(truth))  # no frame to look at
    assert ride.update(cloud, truth).ratio == pytest.approx(fresh.update(cloud, truth).ratio, abs=0.3)


def test_what_is_learned_at_one_registration_is_presumed_at_the_next(world_map, world_drive):
    """Where everything was as the map has it, it is again, and more certain to be the place."""
    cloud, truth = world_drive.clouds[4], world_drive.T_map_body[4]
    ride = ride_of(world_map, world_drive)
    first, second = ride.update(cloud, truth), ride.update(cloud, truth)
    assert second.ratio > first.ratio + 0.5
    T = ride.odometry(truth)
    ride.tracker.start(registration(truth @ inverse(T)), T, ride.tracker.odometry.travelled)
    assert ride.update(cloud, truth).ratio == pytest.approx(first.ratio, abs=1.0)


def test_garbage_and_another_world_are_rejected_by_structure_and_taken_for_no_slip(world_map, slow_drive, elsewhere):
    """They may register anywhere within reach."""
    ride, truth = on_the_way(world_map, slow_drive), slow_drive.T_map_body[8]
    for cloud in (garbage(), *elsewhere.clouds):
        verdict = refused(ride, cloud, truth, newest_only=True)
        assert verdict.cause in (RejectionReason.GROUND, RejectionReason.FITNESS, RejectionReason.FREE_SPACE)
        assert verdict.ratio < -5.0
        assert "usual here" in verdict.reason or "rays pass" in verdict.reason or "ground" in verdict.reason


def test_buildings_that_are_gone_are_no_reason_to_doubt_the_place_where_others_stand(world_map, world_drive, scene):
    """The nearest have been torn down: it is worth less, and still beyond doubt."""
    truth = world_drive.T_map_body[4]
    near = sorted(scene, key=lambda box: np.hypot(*(box.centre - truth[:2, 3])))
    ratios, doubts = [], []
    for gone in (0, 6, 12):
        ride = ride_of(world_map, world_drive)
        assert ride.update(world_drive.clouds[4], truth).verified
        verdict = ride.update(scan(near[gone:], truth), truth, newest_only=True)
        assert verdict.verified
        ratios.append(verdict.ratio)
        doubts.append(ride.tracker.protection_level().doubt)
    assert ratios == sorted(ratios, reverse=True)
    assert ratios[0] - 5.0 > ratios[-1] > 5.0
    assert 1.0 <= doubts[0] < 1.05 < doubts[-1]  # it widens the protection level


def test_off_map_frame_is_not_compared(world_map, world_drive):
    far = pose_from(np.eye(3), [5000.0, 0.0, 1.7])
    ride = Ride.begin(world_map, None, world_drive.clouds[4], far)
    verdict = refused(ride, world_drive.clouds[4], far)
    assert verdict.cause is RejectionReason.OFF_MAP
    assert "empty" in verdict.reason


@pytest.mark.parametrize("limit", [2.0, 0.5])
def test_pose_tilted_beyond_limit_is_rejected(world_map, world_drive, limit):
    """The odometry leans against gravity by 3 degrees: the registration is good, but cannot be true."""
    tilt, truth = np.radians(3.0), world_drive.T_map_body[4]
    leaning = exp_se3(np.array([0.0, tilt, 0.0, 0.0, 0.0, 0.0]))
    robot = pose_from(np.eye(3), truth[:3, 3])
    config = LocalizerConfig(acceptance=AcceptanceConfig(max_tilt=limit * tilt))
    ride = Ride.begin(
        world_map, config, world_drive.clouds[4], truth, off=robot @ OFF @ inverse(robot), T_map_odom=robot @ leaning
    )
    if limit > 1:
        assert ride.update(world_drive.clouds[4], truth).verified
        assert ride.error(truth)[0] < 0.1
    else:
        verdict = refused(ride, world_drive.clouds[4], truth)
        assert verdict.cause is RejectionReason.TILT
        assert "leans 3 degrees" in verdict.reason


def test_rejected_frames_do_not_affect_the_next(world_map, slow_drive):
    """Though the window would reach back over all of it."""
    ride = ride_of(world_map, slow_drive, WIDE, 0)
    clouds, truth = slow_drive.clouds, slow_drive.T_map_body
    for k in range(1, 4):
        assert ride.update(clouds[k], truth[k]).verified
    ride.see(garbage(2), truth[4])
    refused(ride, garbage(3), truth[5])
    ride.see(clouds[6], truth[6])
    verdict = ride.update(clouds[7], truth[7])
    assert verdict.verified
    assert verdict.score > 0.9
    assert ride.error(truth[7])[0] < 0.05


def test_newest_only_uses_the_newest_frame(world_map, slow_drive):
    cloud, truth, scores = slow_drive.clouds[1], slow_drive.T_map_body[1], []
    for newest_only in (True, False):
        ride = ride_of(world_map, slow_drive, WIDE, 0)
        for seed in range(3):
            ride.see(garbage(seed), truth)
        scores.append(ride.update(cloud, truth, newest_only=newest_only).score)
    assert scores[0] > 0.9
    assert scores[1] < 0.8


def test_restart_carries_nothing_over(world_map, slow_drive, world_drive):
    ride = on_the_way(world_map, slow_drive)
    usual = ride.tracker.predicted_covariance()
    T = ride.odometry(world_drive.T_map_body[8])
    ride.tracker.start(registration(world_drive.T_map_body[8] @ OFF @ inverse(T)), T, ride.tracker.odometry.travelled)
    assert (np.diag(ride.tracker.predicted_covariance()) > 10 * np.diag(usual)).all()
    verdict = ride.update(world_drive.clouds[8], world_drive.T_map_body[8])
    assert verdict.verified
    assert ride.error(world_drive.T_map_body[8])[0] < 0.03


def test_place_that_moves_while_the_calibration_changes_is_the_registered_clouds(world_map, world_drive):
    """A second slip confirms the first, from which the calibration learns: the second cloud stays where it lies."""
    config, calibration = LocalizerConfig(), CalibrationEstimator()
    local_maps = LocalMaps(world_map, config.registration.source_range)
    ride = Ride(Tracker(world_map, config, local_maps, calibration), inverse(T_MAP_ODOM))
    lean = pose_from(exp_so3(np.radians([2.0, 0.0, 0.0])), np.zeros(3))
    for k in (4, 5):
        cloud, T_odom_body = world_drive.clouds[k], ride.odometry(world_drive.T_map_body[k])
        ride.see(cloud, world_drive.T_map_body[k])
        if k == 4:
            ride.tracker.start(registration(T_MAP_ODOM), T_odom_body, 0.0)
        match = ride.tracker.match_to_map(cloud, T_odom_body)
        before = calibration.calibration
        T_map_body = match.T_map_body @ lean
        ride.tracker.update(replace(match, T_map_body=T_map_body, moves_place=True), T_odom_body, believed=True)
    after = calibration.calibration
    assert abs(after.roll - before.roll) > np.radians(1.0)
    np.testing.assert_allclose(
        ride.tracker.T_map_odom @ T_odom_body @ after.T_body_cloud, T_map_body @ before.T_body_cloud, atol=1e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "slip",
    [
        pose_from(np.eye(3), [0.0, 0.6, 0.0]),
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
    verdict = ride.update(clouds[k], truth[k], slipped=1e3)  # by the clouds
    assert verdict.cause is RejectionReason.ODOMETRY
    assert not verdict.verified
    assert verdict.innovation > RULE.max_innovation
    numbers = [float(word) for word in verdict.reason.split() if word[0].isdigit()]
    # by the new way's end a wrong heading is a wrong place, too
    assert numbers[0] == pytest.approx(metres, abs=0.03 + 0.2 * np.radians(degrees))
    assert numbers[1] == pytest.approx(degrees, abs=0.2)
    assert verdict.score > 0.8
    assert ride.error(truth[k])[0] < 0.03
    # it was hardly drift: far outside what drift allows, it counts as a step at the edge of that
    assert ride.tracker.odometry.drift.position < 2.5 * drift.position
    assert ride.update(clouds[k + 1], truth[k + 1]).cause is RejectionReason.VERIFIED
    assert ride.tracker.odometry.drift.position < 2.5 * drift.position  # nor does the step across it tell of any
    ride.assert_right(truth[k + 1], 0.03)


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


def test_small_slip_of_the_heading_is_followed_at_once(world_map, slow_drive):
    """Either heading may be right."""
    config = LocalizerConfig(tracking=replace(TrackingConfig(), yaw_drift=np.radians(0.01), drift_prior=1000.0))
    ride = on_the_way(world_map, slow_drive, config)
    ride.slips(pose_from(rot_z(np.radians(1.2)), np.zeros(3)), slow_drive.T_map_body[7])
    verdict = ride.update(slow_drive.clouds[8], slow_drive.T_map_body[8])
    assert verdict.verified
    assert verdict.innovation > RULE.max_innovation
    ride.assert_right(slow_drive.T_map_body[8], 0.03)


def test_step_in_height_is_not_followed(world_map, slow_drive):
    """No wheel slips upwards: a step of 0.3 m along the ground is followed."""
    errors = []
    for step in ([0.0, 0.3, 0.0], [0.0, 0.0, 0.3]):
        ride = on_the_way(world_map, slow_drive)
        ride.slips(pose_from(np.eye(3), step), slow_drive.T_map_body[7])
        verdict = ride.update(slow_drive.clouds[8], slow_drive.T_map_body[8])
        # the registration of a step in height ends at either of two heights: at odometry's, it is verified
        assert verdict.cause is RejectionReason.ODOMETRY or step[2]
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
    there, near = slow_drive.T_map_body[4], []
    for standing_still in (True, False):
        ride = on_the_way(world_map, slow_drive, WIDE, 4)
        for k in (1, 2, 3):
            ride.see(garbage(k), there)
        match = ride.tracker.match_to_map(garbage(3), ride.odometry(there), standing_still=standing_still)
        assert not match.verdict.verified
        near.append(match.scan.evidence(world_map.field, inverse(ride.T_odom_map)).near)
    assert match.verdict.ratio < -5.0
    assert near[0] < near[1]
