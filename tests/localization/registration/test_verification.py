"""Verification: a right pose scores high, a wrong one low, and little structure proves nothing."""

from __future__ import annotations

import numpy as np
import pytest
import small_world
from courtyard import local_map, parts, plane

import coview_kernels as kernels
from coview_stream.config import RegistrationConfig
from coview_stream.geometry.transforms import pose_from, rot_z, transform
from coview_stream.localization.registration import local_map as local_map_module
from coview_stream.localization.registration import verification
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.registration.prepare_scan import RegistrationCloud, prepare_scan
from coview_stream.localization.registration.verification import RangeImage, free_space, verify

CONFIG = RegistrationConfig()


@pytest.fixture(autouse=True)
def every_map_point(monkeypatch):
    """Count every map point, not every third."""
    monkeypatch.setattr(local_map_module, "_SAMPLE_EVERY", 1)


@pytest.fixture(scope="module")
def seen(world_map, world_drive):
    """Evidence for the third frame at a pose off by ``dx, dy, dyaw`` (metres, degrees), as a function."""
    T, cloud = world_drive.T_map_body[2], world_drive.clouds[2]
    zero = pose_from(np.eye(3), -world_map.origin)
    maps = LocalMaps(world_map, CONFIG.source_range)
    source = prepare_scan(small_world.in_map(world_drive, 3), T[:3, 3], CONFIG)

    def evidence(dx=0.0, dy=0.0, degrees=0.0):
        about = pose_from(np.eye(3), T[:3, 3] + [dx, dy, 0]) @ pose_from(rot_z(np.radians(degrees)), -0 * T[:3, 3])
        wrong = zero @ about @ pose_from(np.eye(3), -T[:3, 3])
        T_body = wrong @ T
        target = maps.around(T_body[:3, 3])
        return verify(source, wrong, RangeImage.of(cloud), T_body, target, world_map.survey)

    return evidence


def surveyed(half):
    """Survey of a square around the origin."""
    return kernels.Raster(np.ones((1, 1), np.uint8), np.full(2, -half), 2 * half)


def test_true_pose_scores_high(seen):
    right = seen()
    assert right.score > 0.7
    assert right.near > 0.9
    assert right.ground > 0.9
    assert right.free_space > 0.9
    assert right.inside > 0.9


@pytest.mark.parametrize(
    "offset", [(3, 0, 0), (-2, -2, 0), (0, 5, 0), (0, 0, 15), (0, 0, 180), (0, 0, -90), (9, 7, 40)]
)
def test_wrong_pose_scores_low(seen, offset):
    assert seen(*offset).score < 0.6 * seen().score


def test_all_evidence_is_between_zero_and_one(seen):
    for offset in ((0, 0, 0), (4, 4, 90), (25, 0, 0)):
        found = seen(*offset)
        assert all(0.0 <= value <= 1.0 for value in vars(found).values())
        assert 0.0 <= found.score <= 1.0


def test_outside_the_map_is_not_inside(seen):
    assert seen(45, 0, 0).inside < 0.6 < seen().inside


def fan(distance, half_degrees=30.0):
    """Returns at equal range, ahead, 0.5 degrees apart, and the ground 1.5 m below the sensor."""
    a, e = (
        np.radians(v.ravel()) for v in np.meshgrid(np.arange(-half_degrees, half_degrees, 0.5), np.arange(-5, 10, 0.5))
    )
    rays = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    turn = np.radians(np.arange(0.0, 360.0))
    ground = np.column_stack([5 * np.cos(turn), 5 * np.sin(turn), np.full_like(turn, -1.5)])
    return np.concatenate([distance * rays, ground]).astype(np.float32)


WALL = parts(plane([10, -2, 1], [0, 4, 0], [0, 0, 1.5]))[0]
BODY = pose_from(np.eye(3), [0, 0, 1.5])


def test_rays_ending_at_the_wall_hit_it():
    met, passed = free_space(RangeImage.of(fan(10.2)), BODY, WALL)
    assert passed == 0
    assert met > 0.9 * len(WALL)


def test_rays_ending_behind_the_wall_pass_through_it():
    met, passed = free_space(RangeImage.of(fan(25.0)), BODY, WALL)
    assert met == 0
    assert passed > 0.5 * len(WALL)


def test_wall_behind_returns_is_occluded():
    assert free_space(RangeImage.of(fan(4.0)), BODY, WALL) == (0, 0)


def test_directions_without_rays_give_no_evidence():
    assert free_space(RangeImage.of(fan(25.0)), pose_from(rot_z(np.pi), [0, 0, 1.5]), WALL) == (0, 0)
    assert free_space(RangeImage.of(fan(25.0)), pose_from(np.eye(3), [-40, 0, 1.5]), WALL) == (0, 0)


def test_free_space_uses_robot_heading():
    """Body x ahead: a robot that looks along +y meets a wall that stands at +y."""
    turned = transform(pose_from(rot_z(np.pi / 2), [0, 0, 0]), WALL)
    met, passed = free_space(RangeImage.of(fan(10.2)), pose_from(rot_z(np.pi / 2), [0, 0, 1.5]), turned)
    assert met > 0
    assert passed == 0
    assert free_space(RangeImage.of(fan(10.2)), pose_from(rot_z(-np.pi / 2), [0, 0, 1.5]), turned) == (0, 0)


def test_little_structure_scores_low():
    field = parts(plane([-20, -20, 0], [40, 0, 0], [0, 40, 0], 0.5), plane([5, 0, 0], [0, 1, 0], [0, 0, 2], 0.5))
    target = local_map(*field)
    height = field[0][:, 2].copy()
    source = RegistrationCloud(field[0], height > 0.5, height)
    sparse = verify(source, np.eye(4), RangeImage.of(fan(25.0)), BODY, target, surveyed(40.0))
    assert sparse.ground > 0.99
    assert sparse.near == 0.0
    assert sparse.score == 0.0


def test_points_outside_surveyed_cells_are_ignored(seen):
    target = local_map(*parts(plane([-20, -20, 0], [40, 0, 0], [0, 40, 0]), plane([9, -9, 0], [0, 18, 0], [0, 0, 4])))
    elsewhere = target.points + np.array([300, 0, 0], np.float32)
    points = np.concatenate([target.points, elsewhere])
    height = np.tile(target.points[:, 2], 2)
    source = RegistrationCloud(points, height > 0.5, height)
    found = verify(source, np.eye(4), RangeImage.of(fan(25.0, 5.0)), BODY, target, surveyed(40.0))
    assert found.near == 1.0
    assert found.ground > 0.99
    assert found.inside == 0.5


def test_dense_frame_is_verified_by_a_sample(monkeypatch):
    cloud = np.repeat(fan(10.2), 9, axis=0)
    whole = free_space(RangeImage.of(cloud), BODY, WALL)
    monkeypatch.setattr(verification, "_MAX_RAYS", len(fan(10.2)) * 3)
    part = RangeImage.of(cloud)
    assert 0.2 * len(cloud) < part.hits.sum() < 0.4 * len(cloud)
    assert free_space(part, BODY, WALL) == whole


def test_empty_frame_has_no_rays():
    assert free_space(RangeImage.of(np.empty((0, 3), np.float32)), BODY, WALL) == (0, 0)


@pytest.mark.parametrize("count", [20_000, 32_769, 150_001])
def test_rays_of_a_frame_make_the_same_range_image(count):
    cloud = np.random.default_rng(1).normal(0.0, 15.0, (count, 3)).astype(np.float32)
    rays = RangeImage.rays(cloud)
    assert len(rays) <= 32_768
    of_all, of_rays = RangeImage.of(cloud), RangeImage.of(np.ascontiguousarray(rays))
    for name in ("nearest", "farthest", "hits"):
        np.testing.assert_array_equal(getattr(of_all, name), getattr(of_rays, name))
    assert of_all.floor == of_rays.floor
