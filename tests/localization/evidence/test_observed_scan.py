"""Observations: shares of a scan that the map explains at a pose, counted by looking up, and counted by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import inverse, pose_from, rot_z
from coview_stream.localization.evidence.observed_scan import ObservedScan, ScanPart, Share, surroundings
from coview_stream.localization.registration.prepare_scan import prepare_scan
from coview_stream.localization.registration.register import ScanInput

ODOM = pose_from(rot_z(-0.7), [12.0, 40.0, 3.0])  # map <- odometry


@pytest.fixture(scope="module")
def scan(world_drive):
    """A frame of the small world, with odometry in a frame of its own."""
    T = inverse(ODOM) @ world_drive.T_map_body[0]
    cloud = world_drive.clouds[0]
    points = (cloud @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    return ScanInput(prepare_scan(points, T[:3, 3], LocalizerConfig().registration), cloud, T)


@pytest.fixture(scope="module")
def seen(scan):
    return ObservedScan.of(scan)


@pytest.fixture(scope="module")
def truth(seen):
    return seen.poses(ODOM[None])


def beside(truth, count=60):
    rng = np.random.default_rng(2)
    return truth + np.column_stack([rng.uniform(-12, 12, (count, 2)), np.zeros(count), rng.uniform(-3, 3, count)])


def test_shares_are_shares(world_map, seen, truth):
    for part in (seen.few, seen.many):
        for move in ("far", "near", "no"):
            poses, shares, scores = part.look_up(world_map.field, beside(truth), move)
            assert poses.shape == (60, 4)
            assert shares.shape == (60, len(Share))
            assert ((shares >= 0) & (shares <= 1)).all()
            assert ((scores >= 0) & (scores <= 1)).all()
            assert (shares[:, Share.ON] <= shares[:, Share.NEAR]).all()
            assert (shares[:, Share.NEAR] + shares[:, Share.EDGE] <= shares[:, Share.COVERED] + 1e-6).all()
            assert (shares[:, Share.GROUND] <= shares[:, Share.COVERED_GROUND]).all()


def test_right_place_explains_nearly_all(world_map, seen, truth):
    _, shares, scores = seen.many.look_up(world_map.field, truth, "near")
    (row,) = shares
    assert row[Share.NEAR] > 0.9
    assert row[Share.ON] > 0.5
    assert row[Share.COVERED] > 0.9
    assert row[Share.GROUND] > 0.8 * row[Share.COVERED_GROUND]
    assert row[Share.PASSED] < 0.02
    assert scores[0] > 0.8
    _, others, _ = seen.many.look_up(world_map.field, beside(truth), "no")
    assert np.median(others[:, Share.NEAR]) < 0.6
    assert others[:, Share.PASSED].mean() > 2 * row[Share.PASSED]


@pytest.mark.parametrize("away", [300.0, 5e4])
def test_nothing_is_covered_off_the_map(world_map, seen, truth, away):
    for move in ("far", "near", "no"):
        _, shares, scores = seen.few.look_up(world_map.field, truth + np.array([away, -away, 0.0, 0.0]), move)
        assert not shares.any()
        assert not scores.any()


def test_shares_are_those_counted_by_hand(world_map, seen, truth):
    """Half-metre cells of the map's structure, written out: what is on one, and what lies on level ground."""
    part = seen.many
    _, shares, _ = part.look_up(world_map.field, truth, "no")
    x, y, z, yaw = truth[0]
    T = pose_from(rot_z(yaw), [x, y, z])
    placed, low, free = (
        points @ T[:3, :3].T + T[:3, 3] for points in (part.points.structure, part.points.low, part.points.free)
    )
    cloud = np.asarray(world_map.points, dtype=np.float64)
    filled = set(map(tuple, np.floor(cloud[cloud[:, 2] > 0.5] / 0.5).astype(int)))
    on = np.array([tuple(cell) in filled for cell in np.floor(placed / 0.5).astype(int)])
    assert shares[0, Share.ON] == pytest.approx(on.mean(), abs=0.12)
    passed = np.array([tuple(cell) in filled for cell in np.floor(free / 0.5).astype(int)])
    assert shares[0, Share.PASSED] == pytest.approx(passed.mean(), abs=0.02)
    inside = (np.abs(low[:, :2]) < 33.0).all(axis=1)
    assert shares[0, Share.COVERED_GROUND] == pytest.approx(inside.mean(), abs=0.1)
    level = inside & (np.abs(low[:, 2]) < 0.15)  # the small world's ground is a plane at zero
    assert shares[0, Share.GROUND] == pytest.approx(level.mean(), abs=0.1)


def test_few_and_many_points_say_the_same(world_map, seen, truth):
    poses = np.concatenate([truth, beside(truth)])
    some, all_ = (part.look_up(world_map.field, poses, "no")[1] for part in (seen.few, seen.many))
    assert np.abs(some - all_).mean() < 0.04
    assert len(seen.few.points.structure) < len(seen.many.points.structure)


def test_pose_is_moved_to_the_best_near_it(world_map, seen, truth):
    off = truth + np.array([[1.5, -1.0, 0.0, np.radians(4.0)]])
    moved, shares, _ = seen.few.look_up(world_map.field, off, "far")
    stayed, before, _ = seen.few.look_up(world_map.field, off, "no")
    np.testing.assert_allclose(stayed, off, atol=1e-4)
    assert np.abs(moved - truth)[0, :2].max() < 0.4
    assert shares[0, Share.NEAR] > before[0, Share.NEAR] + 0.1


def test_poses_and_transforms_are_inverse(seen):
    rng = np.random.default_rng(0)
    T = np.array([pose_from(rot_z(rng.uniform(-3, 3)), rng.uniform(-50, 50, 3)) for _ in range(20)])
    poses = seen.poses(T)
    np.testing.assert_allclose(seen.transforms(poses), T, atol=1e-9)
    np.testing.assert_allclose(poses[:, :3], T[:, :3, :3] @ seen.body + T[:, :3, 3])


def test_part_takes_no_more_points_than_asked_for_and_knows_what_each_stands_for():
    rng = np.random.default_rng(0)
    kinds = tuple(rng.uniform(-9, 9, (count, 3)).astype(np.float32) for count in (1000, 30, 0))
    part = ScanPart.of(kinds, (100, 100, 100))
    assert [len(p) for p in (part.points.structure, part.points.low, part.points.free)] == [100, 30, 0]
    assert part.every == (10.0, 1.0, 0.0)


def test_empty_scan_observes_nothing(world_map, truth):
    nothing = np.empty((0, 3), dtype=np.float32)
    _, shares, scores = ScanPart.of((nothing,) * 3, (9, 9, 9)).look_up(world_map.field, truth, "no")
    assert not shares.any()
    assert scores.tolist() == [0.0]


def test_scans_from_one_place_see_the_surroundings_of_one_and_those_from_afar_of_several(scan):
    seen = ObservedScan.of(scan)
    away = scan.T_odom_body.copy()
    away[0, 3] += 500.0
    moved = replace(scan.cloud, points=scan.cloud.points + np.float32([500.0, 0.0, 0.0]))
    other = ObservedScan.of(ScanInput(moved, scan.frame, away))
    assert surroundings([seen, seen]) == 1.0
    assert surroundings([seen, other]) == pytest.approx(2.0, abs=0.1)
    assert surroundings([seen, other, other]) == pytest.approx(2.0, abs=0.1)
