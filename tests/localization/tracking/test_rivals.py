"""Rivals of a tracked place: the right place is found from beside it, and hardly any from the right one."""

from __future__ import annotations

import numpy as np
import pytest
from small_world import pose_error

from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import inverse, pose_from, rot_z
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.registration.prepare_scan import prepare_scan, voxelized
from coview_stream.localization.registration.register import register
from coview_stream.localization.tracking.map_matching import _beside, find_rivals, rings
from coview_stream.localization.tracking.place_evidence import PlaceEvidence
from coview_stream.localization.tracking.slip import matters, off_by

CONFIG = LocalizerConfig()
T_MAP_ODOM = pose_from(rot_z(1.3), [-4.0, 11.0, 0.6])


@pytest.fixture(scope="module")
def scan(world_drive):
    truth = world_drive.T_map_body[4]
    T = inverse(T_MAP_ODOM) @ truth
    points = voxelized(world_drive.clouds[4], T, CONFIG.keyframe)
    return ObservedScan.of(prepare_scan(points, T[:3, 3], CONFIG.registration), world_drive.clouds[4], T), truth


def rivals(world_map, scan, off, count=1):
    """Rivals of a pose that is off the truth by a motion of the body, and what is known of the place."""
    seen, truth = scan
    place, target = PlaceEvidence(world_map), LocalMaps(world_map, 50.0).around(truth[:3, 3])
    T = truth @ off @ inverse(seen.T_odom_body)
    return find_rivals(place, seen, T, target, CONFIG.registration, count), T, place


@pytest.mark.parametrize(
    ("off", "count"),
    [
        ([3.2, 0.0, 0.0], 1),
        ([0.0, -3.3, 0.0], 1),
        ([-2.3, -2.3, 0.0], 1),
        ([2.4, -2.1, 0.0], 1),
        ([0.5, 3.1, 4.0], 3),
        ([-3.1, 0.0, -4.0], 3),
        ([2.2, 2.2, -4.0], 3),
    ],
)
def test_right_place_is_the_best_rival_of_one_beside_it(world_map, scan, off, count):
    """From where registration alone does not come there."""
    x, y, degrees = off
    found, T, place = rivals(world_map, scan, pose_from(rot_z(np.radians(degrees)), [x, y, 0.0]), count)
    alone = register(
        scan[0].cloud, T, LocalMaps(world_map, 50.0).around(scan[1][:3, 3]), CONFIG.registration, (1.0, 0.5)
    )
    assert alone is None or pose_error(alone.T_map_source @ scan[0].T_odom_body, scan[1])[0] > 0.5
    metres, turn = pose_error(found[0].T_map_odom @ scan[0].T_odom_body, scan[1])
    assert metres < 0.05
    assert turn < 0.3
    assert found[0].ratio > place.observe(scan[0], T).ratio + 5.0


@pytest.mark.parametrize("count", [1, 3])
def test_right_place_has_no_rival_that_comes_near_it(world_map, scan, count):
    found, T, place = rivals(world_map, scan, np.eye(4), count)
    assert len(found) <= count
    for rival in found:
        assert rival.ratio < place.observe(scan[0], T).ratio - 3.0


def test_rivals_are_apart_and_the_most_probable_first(world_map, scan):
    found, T, _ = rivals(world_map, scan, pose_from(np.eye(3), [1.5, 1.5, 0.0]), 3)
    ratios = [rival.ratio for rival in found]
    assert ratios == sorted(ratios, reverse=True)
    poses = [each @ scan[0].T_odom_body for each in (T, *(rival.T_map_odom for rival in found))]
    for k, one in enumerate(poses):
        assert all(matters(*off_by(one, other)) for other in poses[:k])


def test_rings_reach_as_far_as_odometry_slips():
    pose = np.array([5.0, -3.0, 1.0, 0.4])
    straight, turned = rings(pose, (0.0,)), rings(pose, (-0.1, 0.0, 0.1))
    assert len(turned) == 3 * len(straight)
    off = np.linalg.norm(straight[:, :2] - pose[:2], axis=1)
    assert 0.5 < off.min() < 1.0
    assert off.max() > 3.0
    assert (straight[:, 2:] == pose[2:]).all()
    rng = np.random.default_rng(3)
    for slip in rng.uniform(-2.5, 2.5, (200, 2)):  # no slip is far from all
        if np.linalg.norm(slip) > 0.5:
            assert np.linalg.norm(straight[:, :2] - pose[:2] - slip, axis=1).min() < 0.75


@pytest.mark.parametrize(
    ("moved", "beside"), [((0.0, 0.0, 2.0), False), ((0.8, 0.0, 0.0), True), ((0.1, 0.1, -0.7), False)]
)
def test_pose_above_or_below_is_no_rival(moved, beside):
    """Wheels slip along the ground."""
    assert _beside(pose_from(np.eye(3), moved), np.eye(4)) == beside
