"""Tracking: when a registration is due, which ones are believed, and what the localizer does about doubt."""

from __future__ import annotations

import numpy as np
import pytest
from small_world import pose_error

from coview_stream.config import AcceptanceConfig, LocalizerConfig, RegistrationConfig, TrackingConfig
from coview_stream.fix import State
from coview_stream.geometry import exp_se3, inverse, pose_from, rot_z
from coview_stream.localizer import Localizer
from coview_stream.pose.registration import LocalMap, LocalMaps, Prior, Registration, Source, register
from coview_stream.tracking import Tracker

T_MAP_ODOM = pose_from(rot_z(1.9), [7.0, -3.0, 0.4])
TURN = TrackingConfig().turn
DISTANCE = TrackingConfig().distance


def registration(T_map_odom):
    return Registration(T_map_odom, 1e4 * np.eye(6), 0.05, 2000, 20, True)


def tracker_of(world_map, T_map_odom=T_MAP_ODOM, **acceptance):
    config = LocalizerConfig(acceptance=AcceptanceConfig(**acceptance))
    tracker = Tracker(world_map, config, LocalMaps(world_map, 50.0))
    tracker.start(registration(T_map_odom), 0.0)
    return tracker


def garbage(seed=1):
    return np.random.default_rng(seed).uniform([-20, -20, -1.5], [20, 20, 6], (6000, 3)).astype(np.float32)


# ---- when a registration is due


@pytest.fixture
def still(world_map, world_drive):
    """A started tracker that has seen one frame, and the means to show it more."""
    tracker = tracker_of(world_map)
    cloud = world_drive.clouds[0]

    def see(x=0.0, yaw=0.0):
        tracker.observe(cloud, pose_from(rot_z(yaw), [x, 0.0, 0.0]))
        return tracker.due()

    see()
    return tracker, see


def test_standing_still_nothing_is_due(still):
    _, see = still
    assert not any(see() for _ in range(5))


def test_turning_on_the_spot_makes_a_registration_due(still):
    _, see = still
    assert [see(yaw=TURN * k) for k in (0.4, 0.8, 1.2)] == [False, False, True]


def test_turning_to_and_fro_adds_up(still):
    _, see = still
    assert [see(yaw=TURN * k) for k in (0.4, 0.0, 0.4)] == [False, False, True]


def test_driving_makes_a_registration_due(still):
    _, see = still
    assert [see(x=DISTANCE * k) for k in (0.4, 0.8, 1.1)] == [False, False, True]


def test_an_update_is_not_due_again_at_once(still, world_drive):
    tracker, see = still
    assert see(x=1.1 * DISTANCE, yaw=1.1 * TURN)
    tracker.update(world_drive.clouds[0], pose_from(rot_z(1.1 * TURN), [1.1 * DISTANCE, 0.0, 0.0]))
    assert not tracker.due()
    assert not see(x=1.1 * DISTANCE, yaw=1.1 * TURN)


def test_what_odometry_does_is_believed_less_and_less(still):
    tracker, see = still
    before = np.diag(tracker.predicted_covariance())
    see(yaw=0.5)
    turned = np.diag(tracker.predicted_covariance())
    see(x=5.0, yaw=0.5)
    driven = np.diag(tracker.predicted_covariance())
    np.testing.assert_allclose(turned[[0, 1, 3, 4, 5]], before[[0, 1, 3, 4, 5]])
    assert turned[2] > before[2]  # a turn in yaw alone
    assert (driven > turned).all()


def test_the_window_is_the_last_metres_more_for_few_points_less_for_many(world_map):
    def window(points, frames=8, **settings):
        config = LocalizerConfig(tracking=TrackingConfig(**settings))
        tracker = Tracker(world_map, config, LocalMaps(world_map, 50.0))
        for k in range(frames):
            tracker.observe(None, pose_from(np.eye(3), [0.5 * k, 0, 0]), np.full((points, 3), k, np.float32))
        return sorted({int(k) for k in tracker._window()[:, 0]})

    assert window(1000) == [3, 4, 5, 6, 7]  # 2 m
    assert window(300) == list(range(8))[-9:]  # 2,500 points need more
    assert window(20_000) == [5, 6, 7]  # 50,000 are plenty


# ---- which registrations are believed


def updated(world_map, world_drive, T_map_odom=T_MAP_ODOM, start=None, cloud=None, **acceptance):
    """Started 0.25 m off; the tracker, and its errors (metres) before and after one update."""
    T_start = start if start is not None else pose_from(np.eye(3), [0.2, -0.15, 0.0]) @ T_map_odom
    tracker = tracker_of(world_map, T_start, **acceptance)
    T = inverse(T_map_odom) @ world_drive.T_map_body[4]
    cloud = world_drive.clouds[4] if cloud is None else cloud
    tracker.observe(cloud, T)
    evidence = tracker.update(cloud, T)
    error = pose_error(tracker.T_map_odom @ T, world_drive.T_map_body[4])[0]
    return tracker, T_start, evidence, error


def test_a_good_registration_is_believed(world_map, world_drive):
    tracker, _, evidence, error = updated(world_map, world_drive)
    assert evidence.score > 0.8
    assert error < 0.05
    before = tracker_of(world_map).predicted_covariance()
    assert np.diag(tracker.predicted_covariance())[3:].max() < 0.1 * np.diag(before)[3:].min()


@pytest.mark.parametrize("rule", ["keep_score", "inside", "keep_ground"])
def test_a_doubtful_registration_is_not_believed(world_map, world_drive, rule):
    """The same registration as above, only that its evidence is held to a higher standard."""
    tracker, T_start, evidence, error = updated(world_map, world_drive, **{rule: 1.0})
    assert 0.8 < min(evidence.score, evidence.inside, evidence.ground) < 1.0
    np.testing.assert_array_equal(tracker.T_map_odom, T_start)
    assert error > 0.2
    assert (np.diag(tracker.predicted_covariance()) >= np.diag(tracker_of(world_map).covariance)).all()
    assert not tracker.due()


def test_the_map_is_cropped_before_it_is_needed(world_map, world_drive, monkeypatch):
    """On a frame that registers nothing: both together would take too long."""
    tracker, cloud = tracker_of(world_map), world_drive.clouds[4]
    T = inverse(T_MAP_ODOM) @ world_drive.T_map_body[4]
    tracker.look_around(T)
    monkeypatch.setattr(type(world_map), "crop", None)
    monkeypatch.setattr("coview_stream.pose.registration.edge_raster", None)
    tracker.observe(cloud, T)
    assert tracker.update(cloud, T).score > 0.8


def test_garbage_does_not_move_the_pose(world_map, world_drive):
    tracker, T_start, evidence, _ = updated(world_map, world_drive, cloud=garbage())
    assert evidence.score < AcceptanceConfig().keep_score
    np.testing.assert_array_equal(tracker.T_map_odom, T_start)


@pytest.mark.parametrize("limit", [2.0, 0.5])
def test_a_pose_that_leans_more_than_the_limit_is_not_believed(world_map, world_drive, limit):
    """The odometry leans against gravity by 3 degrees: the registration is good, but cannot be true."""
    tilt = np.radians(3.0)
    leaning = exp_se3(np.array([0.0, tilt, 0.0, 0.0, 0.0, 0.0]))
    robot = pose_from(np.eye(3), world_drive.T_map_body[4][:3, 3])
    start = robot @ pose_from(np.eye(3), [0.2, -0.15, 0.0]) @ leaning
    tracker, _, _, error = updated(
        world_map,
        world_drive,
        robot @ leaning,
        start,
        most_tilt=limit * tilt,
        keep_score=0.01,
        inside=0.01,
        keep_ground=0.01,
    )
    if limit > 1:
        assert error < 0.1
    else:
        np.testing.assert_array_equal(tracker.T_map_odom, start)


# ---- what a prior weighs


def test_where_the_map_says_nothing_the_prior_comes_through_as_it_was(world_map):
    """On a bare floor heading and place have no measurement: their covariance is the prior's, not 64 times it."""
    side = np.arange(-15, 15, 0.25)
    floor = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    points = np.column_stack([floor, np.zeros(len(floor))]).astype(np.float32)
    target = LocalMap(points, np.tile(np.float32([0, 0, 1]), (len(points), 1)))
    scan = Source(points[::7], np.zeros(len(points[::7]), bool), points[::7, 2])
    config = RegistrationConfig()
    sigma = np.array([0.01, 0.01, 0.02, 0.2, 0.3, 0.1])
    prior = Prior(np.eye(4), np.diag(sigma**-2))
    alone = register(scan, np.eye(4), target, config, (0.4,), centre=np.zeros(3))
    found = register(scan, np.eye(4), target, config, (0.4,), prior, np.zeros(3))
    posterior = np.sqrt(np.diag(tracker_of(world_map)._posterior(found)))
    np.testing.assert_allclose(posterior[2:5], sigma[2:5], rtol=0.01)
    added = found.information - alone.information
    np.testing.assert_allclose(added, prior.information * config.inflation**2, rtol=0.01, atol=1.0)


# ---- doubt and loss


def follow(localizer, drive, frames):
    return [localizer.step(drive.clouds[k], drive.T_odom_body[k], 0.5 * k) for k in frames]


def test_while_the_newest_registration_is_doubtful_there_is_no_pose(world_map, world_drive):
    localizer = Localizer(world_map)
    assert follow(localizer, world_drive, range(5))[-1].state is State.TRACKING
    doubtful = localizer.step(garbage(), world_drive.T_odom_body[5], 2.5)
    assert doubtful.state is State.AMBIGUOUS
    assert doubtful.T_map_body is None
    assert doubtful.T_map_odom is None
    assert doubtful.covariance is None
    assert doubtful.confidence == 0.0
    assert doubtful.evidence.score < localizer.config.acceptance.keep_score
    assert "evidence gone" in doubtful.evidence.reason
    known = localizer.step(world_drive.clouds[6], world_drive.T_odom_body[6], 3.0)
    assert known.state is State.TRACKING
    assert pose_error(known.T_map_body, world_drive.T_map_body[6])[0] < 0.08


def test_doubt_is_looked_into_without_driving_on(world_map, world_drive):
    """A covered sensor takes the pose away at once; uncovered again it is back at once, and nothing was lost."""
    localizer = Localizer(world_map)
    follow(localizer, world_drive, range(5))
    covered = [localizer.step(garbage(k), world_drive.T_odom_body[5], 3.0 + k) for k in range(6)]
    assert [fix.state for fix in covered] == [State.AMBIGUOUS] * 6
    assert [fix.T_map_body for fix in covered] == [None] * 6
    assert covered[-1].evidence.stamp == 8.0
    again = localizer.step(world_drive.clouds[5], world_drive.T_odom_body[5], 9.0)
    assert again.state is State.TRACKING
    assert pose_error(again.T_map_body, world_drive.T_map_body[5])[0] < 0.08


def test_after_a_loss_the_search_starts_from_nothing(world_map, world_drive):
    """The robot is carried back and its odometry starts anew, far off: nothing from before may be mixed in."""
    localizer = Localizer(world_map)
    assert follow(localizer, world_drive, range(5))[-1].state is State.TRACKING
    anew = world_drive.seen_from(pose_from(rot_z(-2.0), [443_000.4, 5_900_000.8, -60.0]))
    patience, confirmations = localizer.config.acceptance.patience, localizer.config.acceptance.confirmations
    lost = follow(localizer, anew, range(patience))[-1]
    assert lost.state is State.LOST
    assert lost.T_map_body is None
    found = follow(localizer, anew, range(patience, patience + confirmations))
    assert [fix.state for fix in found] == [State.LOST] * (confirmations - 1) + [State.TRACKING]
    assert min(fix.evidence.score for fix in found) > 0.9
    newest = anew.T_map_body[patience + confirmations - 1]
    assert pose_error(found[-1].T_map_body, newest)[0] < 0.08


def test_in_a_hurry_registrations_are_three_times_as_far_apart(world_map):
    config = LocalizerConfig()
    tracker = Tracker(world_map, config, LocalMaps(world_map, 50.0))
    cloud = np.zeros((20, 3), np.float32)
    due = []
    for k in range(8):
        tracker.observe(cloud, pose_from(np.eye(3), [0.5 * k * DISTANCE, 0.0, 0.0]))
        due.append((tracker.due(), tracker.due(3.0)))
    assert [d for d, _ in due].index(True) == 2
    assert [d for _, d in due].index(True) == 6
