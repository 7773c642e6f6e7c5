"""Evidence of a slip: the scan decides between where odometry leads and where it was registered."""

from __future__ import annotations

import numpy as np
import pytest
from trackers import on_the_way, refused

from coview_stream.geometry.transforms import inverse, pose_from, rot_z
from coview_stream.localization.registration.prepare_scan import prepare_scan
from coview_stream.localization.registration.register import ScanInput
from coview_stream.localization.tracking import tracker
from coview_stream.localization.tracking.monitor import RejectionReason
from coview_stream.localization.tracking.place_evidence import PlaceEvidence
from coview_stream.localization.tracking.slip import has_slipped, matters, off_by

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
    return ScanInput(prepare_scan(points, level[:3, 3], config.registration), cloud, level), truth


def test_place_that_explains_the_scan_wins_and_the_other_way_round_loses(world_map, scan):
    (seen, truth), place = scan, PlaceEvidence(world_map)
    away, T_body_odom = truth @ AWAY, inverse(seen.T_odom_body)
    ratio = place.gain(seen, away @ T_body_odom, truth @ T_body_odom)
    assert ratio > 10.0
    for risk, slipped in ((1e-4, True), (1.01 * np.exp(-ratio), True), (0.99 * np.exp(-ratio), False)):
        assert has_slipped(place, seen, away, truth, risk) == slipped
        assert not has_slipped(place, seen, truth, away, risk)
    assert place.gain(seen, truth @ T_body_odom, truth @ T_body_odom) == 0.0


def test_places_within_half_of_the_alert_limit_need_no_decision():
    here = np.eye(4)
    assert off_by(here, pose_from(rot_z(np.radians(2.0)), [0.3, 0.4, 0.0])) == pytest.approx((0.5, 2.0))
    assert not matters(0.4, 1.0)
    assert matters(0.6, 0.0)
    assert matters(0.0, 2.0)


def test_registration_that_is_off_odometry_and_not_worth_it_moves_nothing(world_map, slow_drive, monkeypatch):
    clouds, truth = slow_drive.clouds, slow_drive.T_map_body
    monkeypatch.setattr(tracker, "has_slipped", lambda *_: False)
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
    monkeypatch.setattr(tracker, "has_slipped", lambda *_: False)
    ride = on_the_way(world_map, slow_drive)
    ride.slips(pose_from(np.eye(3), [0.9, -0.6, 0.1]), truth[7])
    refused(ride, clouds[8], truth[8])
    monkeypatch.setattr(ride.tracker._graph, "innovation", lambda *_: 1.0)
    assert refused(ride, clouds[9], truth[9], newest_only=True).cause is RejectionReason.ODOMETRY
    monkeypatch.setattr(tracker, "has_slipped", lambda *_: True)
    assert ride.update(clouds[10], truth[10], newest_only=True).cause is RejectionReason.ODOMETRY
    assert ride.error(truth[10])[0] < 0.1
