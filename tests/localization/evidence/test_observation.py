"""Observations: shares of a scan that the map explains at a pose, looked up and counted by hand."""

from dataclasses import replace

import numpy as np
import pytest
import small_world
from trackers import observed

from coview_kernels import Move
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import inverse, pose_from, rot_z
from coview_stream.localization.evidence.observation import ObservedScan, RangeImage, ScanPart, Share, surroundings
from coview_stream.localization.registration.clouds import prepare_scan

ODOM = pose_from(rot_z(-0.7), [12.0, 40.0, 3.0])  # map <- odometry
CONFIG = LocalizerConfig().registration


@pytest.fixture(scope="module")
def scan(world_drive):
    """A frame of the small world, with odometry in a frame of its own."""
    return observed(world_drive.clouds[0], inverse(ODOM) @ world_drive.T_map_body[0], voxels=False)


@pytest.fixture(scope="module")
def truth(scan):
    return scan.poses(ODOM[None])


def beside(truth, count=60):
    rng = np.random.default_rng(2)
    return truth + np.column_stack([rng.uniform(-12, 12, (count, 2)), np.zeros(count), rng.uniform(-3, 3, count)])


def test_shares_are_shares(world_map, scan, truth):
    for part in (scan.few, scan.many):
        for move in Move:
            view = part.look_up(world_map.field, beside(truth), move)
            assert view.poses.shape == (60, 4)
            assert view.shares.shape == (60, len(Share))
            assert ((view.shares >= 0) & (view.shares <= 1)).all()
            assert ((view.parts >= 0) & (view.parts <= 1)).all()
            assert (view.shares[:, Share.ON] <= view.shares[:, Share.NEAR]).all()
            explained = view.shares[:, Share.NEAR] + view.shares[:, Share.EDGE]
            assert (explained <= view.shares[:, Share.COVERED] + 1e-6).all()
            assert (view.shares[:, Share.GROUND] <= view.shares[:, Share.COVERED_GROUND]).all()


@pytest.mark.parametrize("away", [300.0, 5e4])
def test_nothing_is_covered_off_the_map(world_map, scan, truth, away):
    for move in Move:
        view = scan.few.look_up(world_map.field, truth + np.array([away, -away, 0.0, 0.0]), move)
        assert not view.shares.any()
        assert not view.scores.any()
        assert view.evidence(0).inside == 0.0


def test_shares_are_those_counted_by_hand(world_map, scan, truth):
    """Half-metre cells of the map's structure, written out, and the level ground."""
    part = scan.many
    (shares,) = part.look_up(world_map.field, truth, Move.NONE).shares
    x, y, z, yaw = truth[0]
    T = pose_from(rot_z(yaw), [x, y, z])
    placed, low, free = (
        points @ T[:3, :3].T + T[:3, 3] for points in (part.points.structure, part.points.low, part.points.free)
    )
    cloud = np.asarray(world_map.points, dtype=np.float64)
    filled = set(map(tuple, np.floor(cloud[cloud[:, 2] > 0.5] / 0.5).astype(int)))
    on = np.array([tuple(cell) in filled for cell in np.floor(placed / 0.5).astype(int)])
    assert shares[Share.ON] == pytest.approx(on.mean(), abs=0.12)
    passed = np.array([tuple(cell) in filled for cell in np.floor(free / 0.5).astype(int)])
    assert shares[Share.PASSED] == pytest.approx(passed.mean(), abs=0.02)
    inside = (np.abs(low[:, :2]) < 33.0).all(axis=1)
    assert shares[Share.COVERED_GROUND] == pytest.approx(inside.mean(), abs=0.1)
    level = inside & (np.abs(low[:, 2]) < 0.15)  # the small world's ground is a plane at zero
    assert shares[Share.GROUND] == pytest.approx(level.mean(), abs=0.1)


def test_few_and_many_points_say_the_same(world_map, scan, truth):
    poses = np.concatenate([truth, beside(truth)])
    few, many = (part.look_up(world_map.field, poses, Move.NONE).shares for part in (scan.few, scan.many))
    assert np.abs(few - many).mean() < 0.04
    assert len(scan.few.points.structure) < len(scan.many.points.structure)


def test_pose_is_moved_to_the_best_near_it(world_map, scan, truth):
    off = truth + np.array([[1.5, -1.0, 0.0, np.radians(4.0)]])
    moved = scan.few.look_up(world_map.field, off, Move.FAR)
    stayed = scan.few.look_up(world_map.field, off, Move.NONE)
    np.testing.assert_allclose(stayed.poses, off, atol=1e-4)
    assert np.abs(moved.poses - truth)[0, :2].max() < 0.4
    assert moved.shares[0, Share.NEAR] > stayed.shares[0, Share.NEAR] + 0.1


def test_poses_and_transforms_are_inverse(scan):
    rng = np.random.default_rng(0)
    T = np.array([pose_from(rot_z(rng.uniform(-3, 3)), rng.uniform(-50, 50, 3)) for _ in range(20)])
    poses = scan.poses(T)
    np.testing.assert_allclose(scan.transforms(poses), T, atol=1e-9)
    np.testing.assert_allclose(poses[:, :3], T[:, :3, :3] @ scan.body + T[:, :3, 3])


def test_part_takes_no_more_points_than_asked_for_and_knows_how_many_each_stands_for():
    rng = np.random.default_rng(0)
    kinds = tuple(rng.uniform(-9, 9, (count, 3)).astype(np.float32) for count in (1000, 30, 0))
    part = ScanPart.of(kinds, (100, 100, 100))
    assert [len(p) for p in (part.points.structure, part.points.low, part.points.free)] == [100, 30, 0]
    assert part.weights == (10.0, 1.0, 0.0)


def test_empty_scan_observes_nothing(world_map, truth):
    nothing = np.empty((0, 3), dtype=np.float32)
    view = ScanPart.of((nothing,) * 3, (9, 9, 9)).look_up(world_map.field, truth, Move.NONE)
    assert not view.shares.any()
    assert view.scores.tolist() == [0.0]


def test_scans_from_one_place_see_the_surroundings_of_one_and_those_from_afar_of_several(scan, world_drive):
    away = scan.T_odom_body.copy()
    away[0, 3] += 500.0
    moved = replace(scan.cloud, points=scan.cloud.points + np.float32([500.0, 0.0, 0.0]))
    other = ObservedScan.of(moved, world_drive.clouds[0], away)
    assert surroundings([scan, scan]) == 1.0
    assert surroundings([scan, other]) == pytest.approx(2.0, abs=0.1)
    assert surroundings([scan, other, other]) == pytest.approx(2.0, abs=0.1)


@pytest.fixture(scope="module")
def evidence(world_map, world_drive):
    """Evidence for the third frame at a pose off by ``dx, dy, degrees``, as a function."""
    T, zero = world_drive.T_map_body[2], pose_from(np.eye(3), -world_map.origin)
    cloud = prepare_scan(small_world.in_map(world_drive, 3), T[:3, 3], CONFIG)
    scan = ObservedScan.of(cloud, world_drive.clouds[2], T)

    def at(dx=0.0, dy=0.0, degrees=0.0):
        moved = pose_from(rot_z(np.radians(degrees)), T[:3, 3] + [dx, dy, 0]) @ pose_from(np.eye(3), -T[:3, 3])
        return scan.evidence(world_map.field, zero @ moved)

    return at


@pytest.mark.parametrize(
    "offset", [(3, 0, 0), (-2, -2, 0), (0, 5, 0), (0, 0, 15), (0, 0, 180), (0, 0, -90), (9, 7, 40)]
)
def test_wrong_pose_scores_low(evidence, offset):
    assert evidence(*offset).score < 0.6 * evidence().score


def test_little_structure_scores_zero(world_map, scan):
    cloud = scan.cloud
    rows = np.concatenate([np.flatnonzero(cloud.high)[:50], np.flatnonzero(~cloud.high)])
    bare = replace(cloud, points=cloud.points[rows], above=cloud.above[rows], height=cloud.height[rows])
    sparse = ObservedScan.of(bare, np.empty((0, 3), np.float32), scan.T_odom_body).evidence(world_map.field, ODOM)
    assert sparse.ground > 0.8
    assert sparse.near == sparse.covered == sparse.score == 0.0


def fan(distance, repeat=1):
    """Returns at equal range within 30 degrees of the heading, 0.5 degrees apart, and the ground 1.5 m below."""
    a, e = (np.radians(v.ravel()) for v in np.meshgrid(np.arange(-30, 30, 0.5), np.arange(-5, 10, 0.5)))
    rays = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    turn = np.radians(np.arange(0.0, 360.0))
    ground = np.column_stack([5 * np.cos(turn), 5 * np.sin(turn), np.full_like(turn, -1.5)])
    return np.repeat(np.concatenate([distance * rays, ground]), repeat, axis=0).astype(np.float32)


def test_rays_pass_through_the_space_before_their_returns_and_no_other():
    points = RangeImage.of(fan(20.0)).passed_points()
    ahead = points[np.abs(np.arctan2(points[:, 1], points[:, 0])) < np.radians(32.0)]
    assert len(ahead) == len(points) > 50
    ranges = np.linalg.norm(points, axis=1)
    assert 1.0 < ranges.min() < 6.0
    assert 16.0 < ranges.max() < 20.0
    assert points[:, 2].min() > -1.5 + 0.8  # well above the ground
    assert len(RangeImage.of(np.empty((0, 3), np.float32)).passed_points()) == 0


def test_rays_below_the_ground_that_was_dug_away_contradict_nothing():
    points = RangeImage.of(fan(20.0)).passed_points(dug=2.0)
    assert len(points) > 10
    assert points[:, 2].min() > -1.5 + 2.8


def test_ground_that_was_dug_is_not_held_against_a_place(world_map, scan, truth):
    dug = ObservedScan.of(replace(scan.cloud, changed=0.75), np.empty((0, 3), np.float32), scan.T_odom_body)
    whole, part = (each.look_up(world_map.field, truth, Move.NONE).shares[0] for each in (scan.many, dug.many))
    for column in (Share.GROUND, Share.COVERED_GROUND):
        assert part[column] == pytest.approx(0.25 * whole[column], rel=1e-5)


def test_single_returns_say_nothing_about_a_direction():
    axis = np.radians(np.arange(1.0, 360.0, 2.0))
    alone = np.column_stack([20 * np.cos(axis), 20 * np.sin(axis), np.ones_like(axis)]).astype(np.float32)
    assert len(RangeImage.of(alone).passed_points()) == 0
    assert len(RangeImage.of(np.repeat(alone, 2, axis=0)).passed_points()) > 10


@pytest.mark.parametrize("count", [20_000, 32_769, 150_001])
def test_rays_of_a_frame_make_the_same_range_image(count):
    cloud = np.random.default_rng(1).normal(0.0, 15.0, (count, 3)).astype(np.float32)
    rays = RangeImage.rays(cloud)
    assert len(rays) <= 32_768
    whole, thinned = RangeImage.of(cloud), RangeImage.of(np.ascontiguousarray(rays))
    np.testing.assert_array_equal(whole.nearest, thinned.nearest)
    assert whole.floor == thinned.floor
