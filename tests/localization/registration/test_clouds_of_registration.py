"""Sources: thin, near, repeatable, and told apart by their height above the ground."""

from dataclasses import replace

import numpy as np
import pytest

from coview_stream.config import RegistrationConfig
from coview_stream.descriptors.coview import EYE
from coview_stream.localization.registration.clouds import RegistrationCloud, height_above_lowest, prepare_scan, thinned


def ground(slope=0.0, half=30.0, z=5.0):
    xy = np.stack(np.meshgrid(*[np.arange(-half, half, 0.5)] * 2), axis=-1).reshape(-1, 2)
    return np.column_stack([xy, z + slope * xy[:, 0]]).astype(np.float32)


def wall(z=5.0):
    y, h = np.meshgrid(np.arange(-8, 8, 0.4), np.arange(0, 6, 0.4))
    return np.column_stack([np.full(y.size, 10.2), y.ravel(), z + h.ravel()]).astype(np.float32)


def test_walls_are_above_ground_and_ground_is_not():
    points = np.concatenate([ground(), wall()])
    height = height_above_lowest(points)
    np.testing.assert_allclose(height[: len(ground())], 0.0, atol=1e-5)
    np.testing.assert_allclose(height[len(ground()) :], wall()[:, 2] - 5.0, atol=1e-5)
    source = prepare_scan(points, np.array([0.0, 0.0, 7.0]), RegistrationConfig(source_points=50_000))
    np.testing.assert_array_equal(source.above, source.height > 0.5)
    assert source.above.sum() > 200
    assert np.abs(source.points[source.above][:, 0] - 10.2).max() < 0.3


def test_facade_without_ground_uses_neighbouring_ground():
    floating = wall()[wall()[:, 2] > 7.0]
    height = height_above_lowest(np.concatenate([floating, ground()]))
    np.testing.assert_allclose(height[: len(floating)], floating[:, 2] - 5.0, atol=1e-5)


def test_foot_of_a_wall_is_no_ground_for_a_sensor_that_sees_none():
    position = np.array([0.0, 0.0, 6.5])
    seen = wall()[wall()[:, 2] > 6.9]  # by a hemisphere that looks up
    source = prepare_scan(seen, position, RegistrationConfig())
    assert source.above.all()
    np.testing.assert_allclose(source.height, source.points[:, 2] - 6.5 + EYE, atol=1e-5)
    both = prepare_scan(np.concatenate([seen, ground()]), position, RegistrationConfig(source_points=50_000))
    assert not both.above[both.points[:, 2] < 5.3].any()


def test_range_and_count_are_limited_deterministically():
    points = ground(half=60.0)
    settings = RegistrationConfig(source_range=20.0, source_points=700, source_voxel=0.5)
    position = np.array([10.0, -5.0, 6.0])
    one, two = (prepare_scan(points, position, settings) for _ in range(2))
    assert len(one.points) == len(one.above) == len(one.height) == 700
    np.testing.assert_array_equal(one.points, two.points)
    assert np.linalg.norm(one.points - position, axis=1).max() < 20.0 + 0.5
    # a fair choice: from all sides
    assert np.abs(np.median(one.points - position, axis=0)[:2]).max() < 2.0


def test_registration_without_ground_tells_less_of_height_and_tilt():
    cloud = RegistrationCloud(ground(), np.zeros(0, bool), np.zeros(0, np.float32))
    np.testing.assert_array_equal(cloud.doubted(np.eye(6)), np.eye(6))
    none, half = (np.diag(replace(cloud, changed=share).doubted(np.zeros((6, 6)))) for share in (1.0, 0.5))
    np.testing.assert_allclose(half, none / 8.0)
    assert (none > 0.0).tolist() == [True, True, False, False, False, True]


def test_one_point_per_voxel():
    source = prepare_scan(np.repeat(ground(half=5.0), 4, axis=0), np.zeros(3), RegistrationConfig(source_voxel=1.0))
    assert len(np.unique(np.floor(source.points / 1.0), axis=0)) == len(source.points)


@pytest.mark.parametrize("points", [np.empty((0, 3), np.float32), np.full((1, 3), 900, np.float32)])
def test_no_near_points_give_empty_registration_cloud(points):
    source = prepare_scan(points, np.zeros(3), RegistrationConfig())
    assert source.points.shape == (0, 3)
    assert len(source.above) == len(source.height) == 0


def test_thinned_scan_gives_the_same_registration_cloud():
    rng = np.random.default_rng(3)
    points, position = rng.uniform(-80, 80, (60_000, 3)).astype(np.float32), np.array([3.0, -4.0, 1.0])
    points[:, 2] *= 0.05
    config = RegistrationConfig(source_points=800)
    thin = thinned(points, position, config)
    assert len(thin) < 0.6 * len(points)
    a, b = (prepare_scan(each, position, config) for each in (points, thin))
    np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_array_equal(a.height, b.height)
