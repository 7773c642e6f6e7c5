"""Evidence of a slip: scans decide between where odometry leads and where they were registered, view by view."""

from __future__ import annotations

import numpy as np
import pytest
from trackers import on_the_way, refused

from coview_stream.geometry.transforms import inverse, pose_from, rot_z
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.registration.prepare_scan import prepare_scan
from coview_stream.localization.tracking.monitor import RejectionReason
from coview_stream.localization.tracking.place_evidence import PlaceEvidence
from coview_stream.localization.tracking.pose_graph import Estimate
from coview_stream.localization.tracking.slip import Dispute, matters, off_by

AWAY = pose_from(rot_z(np.radians(4.0)), [1.2, -0.5, 0.0])


@pytest.fixture
def scan(world_map, world_drive):
    """A frame whose odometry frame is the body's, and where the body is."""
    from coview_stream.config import LocalizerConfig
    from coview_stream.localization.registration.prepare_scan import voxelized

    config, cloud, truth = LocalizerConfig(), world_drive.clouds[4], world_drive.T_map_body[4].copy()
    level = truth.copy()
    level[:3, 3] = 0.0  # gravity aligned
    points = voxelized(cloud, level, config.keyframe)
    return ObservedScan.of(prepare_scan(points, level[:3, 3], config.registration), cloud, level), truth


RISK = 1e-4


class Told:
    """A place whose log-likelihood ratios are told, by how far along x a pose is: the nearest of them."""

    def __init__(self, **ratios):
        self.told = {float(name[1:]): ratio for name, ratio in ratios.items()}

    def ratios(self, scan, T_map_odom):
        x = (T_map_odom @ scan.T_odom_body)[:, 0, 3]
        return np.array([self.told[min(self.told, key=lambda at: abs(at - each))] for each in x])


def at(metres):
    return pose_from(np.eye(3), [metres, 0.0, 0.0])


def settled(dispute, scan, seen, travelled):
    """Metres along x of the place that must be right; odometry leads to 0."""
    found = dispute.settle(scan, at(0.0), [at(x) for x in seen], travelled, RISK)
    return None if found is None else float(found[0, 3])


def test_place_that_explains_the_scan_wins_and_the_other_way_round_loses(world_map, scan):
    (seen, truth), place = scan, PlaceEvidence(world_map)
    away, T_body_odom = truth @ AWAY, inverse(seen.T_odom_body)
    here, other = place.ratios(seen, np.stack([away @ T_body_odom, truth @ T_body_odom]))
    ratio = other - here
    assert ratio > 10.0
    for risk, slipped in ((1e-4, True), (1.01 * np.exp(-ratio), True), (0.99 * np.exp(-ratio), False)):
        found = Dispute(place, 1.0).settle(seen, away, [truth], 0.0, risk)
        assert (found is not None) == slipped
        if slipped:
            np.testing.assert_allclose(found, truth, atol=1e-9)
        assert Dispute(place, 1.0).settle(seen, truth, [away], 0.0, risk) is None


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


def test_registration_that_is_off_odometry_and_not_worth_it_moves_nothing(world_map, slow_drive, monkeypatch):
    clouds, truth = slow_drive.clouds, slow_drive.T_map_body
    monkeypatch.setattr(Dispute, "settle", lambda *_: None)
    ride = on_the_way(world_map, slow_drive)
    ride.slips(pose_from(np.eye(3), [0.9, -0.6, 0.1]), truth[7])
    verdict = refused(ride, clouds[8], truth[8])
    assert verdict.cause is RejectionReason.ODOMETRY
    assert "may have been moved" in verdict.reason
    off = ride.error(truth[8])[0]
    assert off > 1.0
    ride.slips(inverse(pose_from(np.eye(3), [0.9, -0.6, 0.1])), truth[8])  # so it had not slipped
    assert ride.update(clouds[9], truth[9]).cause is RejectionReason.VERIFIED
    assert ride.error(truth[9])[0] < 0.05


def test_doubt_that_makes_the_belief_wide_lets_no_such_registration_in(world_map, slow_drive, monkeypatch):
    clouds, truth = slow_drive.clouds, slow_drive.T_map_body
    monkeypatch.setattr(Dispute, "settle", lambda *_: None)
    ride = on_the_way(world_map, slow_drive)
    ride.slips(pose_from(np.eye(3), [0.9, -0.6, 0.1]), truth[7])
    refused(ride, clouds[8], truth[8])
    monkeypatch.setattr(Estimate, "innovation", lambda *_: 1.0)
    assert refused(ride, clouds[9], truth[9], newest_only=True).cause is RejectionReason.ODOMETRY
    monkeypatch.setattr(Dispute, "settle", lambda *_: truth[10])
    assert ride.update(clouds[10], truth[10], newest_only=True).cause is RejectionReason.ODOMETRY
    assert ride.error(truth[10])[0] < 0.1
