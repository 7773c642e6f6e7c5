"""Evidence of a slip: scans decide between where odometry leads and where they were registered, view by view."""

import numpy as np
import pytest
from any_risk import NEVER, with_risk
from courtyard import courtyard, local_map
from trackers import observed, on_the_way, refused

from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import boxplus, inverse, pose_from, rot_z, transform
from coview_stream.localization.registration.clouds import LocalMap
from coview_stream.localization.tracking.monitor import RejectionReason
from coview_stream.localization.tracking.place_evidence import PlaceEvidence
from coview_stream.localization.tracking.pose_graph import Estimate
from coview_stream.localization.tracking.slip import DisplacementCheck, Dispute, matters, off_by, share_on_map

AWAY = pose_from(rot_z(np.radians(4.0)), [1.2, -0.5, 0.0])


@pytest.fixture
def scan(world_map, world_drive):
    """A frame whose odometry frame is the body's, gravity aligned, and where the body is."""
    truth = world_drive.T_map_body[4].copy()
    return observed(world_drive.clouds[4], pose_from(truth[:3, :3], np.zeros(3))), truth


RISK = 1e-4


class Told:
    """A place whose log-likelihood ratios are told, by how far along x a pose is: the nearest of them.

    What fits beside odometry's place has moved with log-odds ``moved``.
    """

    def __init__(self, moved=-np.inf, **ratios):
        self.told = {float(name[1:]): ratio for name, ratio in ratios.items()}
        self.moved = moved

    def log_odds_of_moved(self, *_):
        return self.moved

    def ratios(self, scan, T_map_odom):
        x = (T_map_odom @ scan.T_odom_body)[:, 0, 3]
        return np.array([self.told[min(self.told, key=lambda at: abs(at - each))] for each in x])


def at(metres):
    return pose_from(np.eye(3), [metres, 0.0, 0.0])


def settled(dispute, scan, seen, travelled, slipped=1.0):
    """Metres along x of the place that must be right; odometry leads to 0."""
    winner = dispute.settle(scan, at(0.0), [at(x) for x in seen], travelled, RISK, slipped)
    return None if winner is None else float(winner[0, 3])


class Unmoved(PlaceEvidence):
    """A place where nothing moves."""

    def log_odds_of_moved(self, *_):
        return -np.inf


def test_place_that_explains_the_scan_wins_and_the_other_way_round_loses(world_map, scan):
    (seen, truth), place = scan, Unmoved(world_map)
    away, T_body_odom = truth @ AWAY, inverse(seen.T_odom_body)
    here, other = place.ratios(seen, np.stack([away @ T_body_odom, truth @ T_body_odom]))
    ratio = other - here
    assert ratio > 10.0
    for risk, slipped in ((1e-4, True), (1.01 * np.exp(-ratio), True), (0.99 * np.exp(-ratio), False)):
        winner = Dispute(place, 1.0).settle(seen, away, [truth], 0.0, risk, 1.0)
        assert (winner is not None) == slipped
        if slipped:
            np.testing.assert_allclose(winner, truth, atol=1e-9)
        assert Dispute(place, 1.0).settle(seen, truth, [away], 0.0, risk, 1.0) is None


def test_place_must_be_better_than_all_others(scan):
    for beside, expected in ((-5.0, 1.0), (9.0, None)):
        dispute = Dispute(Told(x0=-8.0, x1=10.0, x2=beside), 1.0)
        assert settled(dispute, scan[0], [1.0, 2.0], 0.0) == expected


def test_views_add_up_and_frames_of_one_view_do_not(scan):
    dispute = Dispute(Told(x0=0.0, x1=4.0), 1.0)
    assert [settled(dispute, scan[0], [1.0], metres) for metres in (0.0, 0.2, 0.5, 0.99)] == [None] * 4
    assert [settled(dispute, scan[0], [1.0], metres) for metres in (1.0, 1.5, 2.1)] == [None, None, 1.0]
    dispute.clear()
    assert settled(dispute, scan[0], [1.0], 2.2) is None


def test_building_that_moved_is_one_event_in_however_many_views_and_only_clouds_show_a_slip(scan):
    for slipped, expected in ((0.01, [None] * 20), (1e4, [1.0] * 20)):
        dispute = Dispute(Told(x0=2.0, x1=12.0, moved=-9.0), 1.0)
        assert [settled(dispute, scan[0], [1.0], float(view), slipped) for view in range(20)] == expected
    dispute = Dispute(Told(x0=2.0, x1=12.0), 1.0)  # a place where nothing moves
    assert settled(dispute, scan[0], [1.0], 0.0, 0.01) is None
    assert settled(dispute, scan[0], [1.0], 1.0, 0.01) == 1.0


def test_place_that_is_not_registered_again_is_weighed_all_the_same(scan):
    """And one that is seen later begins like where odometry leads."""
    dispute = Dispute(Told(x0=0.0, x1=5.0, x2=5.0), 1.0)
    assert settled(dispute, scan[0], [1.0], 0.0) is None
    assert settled(dispute, scan[0], [], 1.0) == 1.0
    dispute.clear()
    assert settled(dispute, scan[0], [1.0], 0.0) is None
    assert settled(dispute, scan[0], [2.0], 1.0) is None  # they are 5 apart
    assert settled(dispute, scan[0], [], 2.0) is None
    assert settled(dispute, scan[0], [1.02], 3.0) is None


def test_places_that_come_near_each_other_contradict_each_other_no_more(scan):
    dispute = Dispute(Told(x0=-8.0, x1=5.0, x2=4.0), 1.0)
    assert settled(dispute, scan[0], [1.0, 1.6], 0.0) is None  # 1.6 is told like 2
    assert settled(dispute, scan[0], [1.0, 1.55], 0.5) is None
    assert settled(dispute, scan[0], [1.15, 1.6], 0.8) == pytest.approx(1.15)


def test_places_within_half_of_the_alert_limit_need_no_decision():
    here = np.eye(4)
    assert off_by(here, pose_from(rot_z(np.radians(2.0)), [0.3, 0.4, 0.0])) == pytest.approx((0.5, 2.0))
    assert not matters(0.4, 1.0)
    assert matters(0.6, 0.0)
    assert matters(0.0, 2.0)


SLIP = pose_from(np.eye(3), [0.9, -0.6, 0.1])


def test_registration_that_is_off_odometry_and_not_worth_it_moves_nothing(world_map, slow_drive):
    clouds, truth = slow_drive.clouds, slow_drive.T_map_body
    ride = on_the_way(world_map, slow_drive, LocalizerConfig(acceptance=NEVER))
    ride.slips(SLIP, truth[7])
    verdict = refused(ride, clouds[8], truth[8])
    assert verdict.cause is RejectionReason.ODOMETRY
    assert "may have been moved" in verdict.reason
    assert ride.error(truth[8])[0] > 1.0
    ride.slips(inverse(SLIP), truth[8])  # so it had not slipped
    assert ride.update(clouds[9], truth[9]).cause is RejectionReason.VERIFIED
    assert ride.error(truth[9])[0] < 0.05


def test_doubt_that_makes_the_belief_wide_lets_no_such_registration_in(world_map, slow_drive, monkeypatch):
    clouds, truth, rule = slow_drive.clouds, slow_drive.T_map_body, with_risk(NEVER.risk)
    ride = on_the_way(world_map, slow_drive, LocalizerConfig(acceptance=rule))
    ride.slips(SLIP, truth[7])
    refused(ride, clouds[8], truth[8])
    monkeypatch.setattr(Estimate, "innovation", lambda *_: 1.0)
    assert refused(ride, clouds[9], truth[9], newest_only=True).cause is RejectionReason.ODOMETRY
    object.__setattr__(rule, "risk", RISK)  # now the scans settle it
    assert ride.update(clouds[10], truth[10], newest_only=True).cause is RejectionReason.ODOMETRY
    assert ride.error(truth[10])[0] < 0.1


T_MAP_ODOM = pose_from(rot_z(0.7), [2.0, -1.0, 0.4])
ELSEWHERE = boxplus(T_MAP_ODOM, np.array([0.0, 0.0, 1.0, 4.3, -3.7, 0.0]))
HERE = np.array([0.0, 0.0, 1.7])


@pytest.fixture(scope="module")
def target() -> LocalMap:
    return local_map(*courtyard())


def yard(seed=0, noise=0.02):
    """A frame of the courtyard in the odometry frame."""
    points, rng = courtyard()[0], np.random.default_rng(seed)
    some = points[rng.permutation(len(points))[:4000]] + rng.normal(0.0, noise, (4000, 3))
    return transform(np.linalg.inv(T_MAP_ODOM), some).astype(np.float32)


def test_ground_and_far_points_are_ignored(target):
    """Both are as one likes; the points between are where the map has them."""
    frame = yard()
    height = transform(T_MAP_ODOM, frame)[:, 2]
    ground = frame[height < 0.1] + np.float32([0.0, 0.0, 0.3])
    far = frame[height > 1.5] + np.float32([200.0, 0.0, 0.0])
    mixed = np.concatenate([frame[height > 1.5], ground, far])
    assert share_on_map(mixed, HERE, T_MAP_ODOM, target) > 0.98


def test_too_few_points_give_no_share(target):
    frame = yard()
    assert share_on_map(frame[:0], HERE, T_MAP_ODOM, target) is None
    assert share_on_map(frame[:50], HERE, T_MAP_ODOM, target) is None
    flat = frame[transform(T_MAP_ODOM, frame)[:, 2] < 0.1]
    assert len(flat) > 500
    assert share_on_map(flat, HERE, T_MAP_ODOM, target) is None
    check = used_to(target)
    usual = check.usual
    check.learn(flat, HERE, T_MAP_ODOM, target)
    assert check.usual == usual
    assert not check.is_displaced(flat, HERE, ELSEWHERE, target)


def used_to(target, frames=5):
    """A check that has seen the yard a few times."""
    check = DisplacementCheck()
    for k in range(frames):
        check.learn(yard(100 + k), HERE, T_MAP_ODOM, target)
    return check


def test_displaced_frame_is_detected_and_not_learned(target):
    check = used_to(target)
    usual = check.usual
    assert not any(check.is_displaced(yard(k), HERE, T_MAP_ODOM, target) for k in range(5))
    assert all(check.is_displaced(yard(k), HERE, ELSEWHERE, target) for k in range(5, 30))
    assert check.usual == usual
    assert not check.is_displaced(yard(40), HERE, T_MAP_ODOM, target)


def cluttered(share, seed):
    """A frame a share of which is not on the map: parked cars, people, leaves."""
    frame, rng = yard(seed), np.random.default_rng(seed)
    height = transform(T_MAP_ODOM, frame)[:, 2]
    stray = (rng.random(len(frame)) < share) & (height > 0.5)
    frame[stray] = rng.uniform([-12.0, -12.0, 8.0], [12.0, 12.0, 20.0], (int(stray.sum()), 3))
    return frame


def test_slow_change_updates_baseline_and_sudden_change_is_detected(target):
    check, alarms = DisplacementCheck(), []
    for k, share in enumerate(np.linspace(0.0, 0.6, 40)):
        frame = cluttered(share, k)
        alarms.append(check.is_displaced(frame, HERE, T_MAP_ODOM, target))
        check.learn(frame, HERE, T_MAP_ODOM, target)
    assert not any(alarms)
    assert check.usual < 0.6
    assert used_to(target).is_displaced(cluttered(0.6, 9), HERE, T_MAP_ODOM, target)


def test_one_badly_fitting_frame_does_not_become_the_baseline(target):
    """The registration may have been believed by a hair."""
    check = used_to(target)
    before = check.usual
    check.learn(cluttered(0.6, 1), HERE, T_MAP_ODOM, target)
    assert before - 0.3 < check.usual < before
    assert check.is_displaced(cluttered(0.6, 2), HERE, T_MAP_ODOM, target)
