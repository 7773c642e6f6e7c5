"""Filters: outliers, voxels, normals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coview_stream.clouds.filters import estimate_normals, remove_outliers, voxel_grid
from coview_stream.errors import ConfigError, DependencyError
from coview_stream.sim.casting import open3d

RNG = np.random.default_rng(4)


def test_outliers_are_removed_and_plane_is_kept():
    plane = np.column_stack([RNG.uniform(0, 20, (4000, 2)), RNG.normal(0, 0.02, 4000)])
    stray = RNG.uniform([0, 0, 10], [20, 20, 60], (20, 3))
    points = np.concatenate([plane, stray]).astype(np.float32)
    kept, mask = remove_outliers(points)
    np.testing.assert_array_equal(kept, points[mask])
    assert kept.dtype == np.float32
    assert not mask[4000:].any()
    assert mask[:4000].mean() > 0.99


@pytest.mark.parametrize("count", [0, 1, 20, 30])
def test_too_few_points_for_outliers_and_points_that_are_all_as_far_apart_are_kept(count):
    kept, mask = remove_outliers(np.zeros((count, 3), np.float32))
    assert len(kept) == count
    assert mask.all()


@given(st.integers(0, 2**31), st.floats(0.05, 5.0), st.integers(1, 300))
def test_voxel_centroids_match_numpy_grouping(seed, voxel, count):
    points = np.random.default_rng(seed).normal(0, 10, (count, 3)).astype(np.float32)
    groups = {}
    for point in points.astype(np.float64):
        groups.setdefault(tuple(np.floor(point / voxel).astype(int)), []).append(point)
    expected = [np.mean(groups[key], axis=0) for key in sorted(groups)]
    np.testing.assert_allclose(voxel_grid(points, voxel), expected, atol=1e-5)


def test_voxel_grid_of_no_points_and_of_too_many_cells():
    assert voxel_grid(np.zeros((0, 3), np.float32), 0.5).shape == (0, 3)
    with pytest.raises(ConfigError, match="too small"):
        voxel_grid(np.array([[0, 0, 0], [1e7, 1e7, 1e7]], np.float32), 1e-3)


def test_normals_of_a_tilted_plane_point_up():
    xy = RNG.uniform(0, 10, (2000, 2))
    points = np.column_stack([xy, 0.5 * xy[:, 0]]).astype(np.float32)
    expected = np.array([-0.5, 0.0, 1.0]) / np.sqrt(1.25)
    for radius in (None, 1.5):
        normals, planarity = estimate_normals(points, radius=radius)
        assert normals.dtype == planarity.dtype == np.float32
        np.testing.assert_allclose(normals, np.tile(expected, (2000, 1)), atol=1e-3)
        assert planarity.min() > 0.999


def test_planarity_tells_a_surface_from_a_crown():
    crown = RNG.normal(0, 1, (4000, 3)).astype(np.float32)
    rough = np.column_stack([RNG.uniform(0, 20, (8000, 2)), RNG.normal(0, 0.03, 8000)]).astype(np.float32)
    inside = np.linalg.norm(crown, axis=1) < 1.0
    scattered, flat = (estimate_normals(points, radius=1.0)[1] for points in (crown, rough))
    assert np.median(scattered[inside]) < 0.5
    assert np.median(flat) > 0.95


def test_isolated_points_have_a_vertical_normal():
    normals, planarity = estimate_normals(np.array([[0, 0, 0], [50, 0, 0]], np.float32), radius=1.0)
    np.testing.assert_array_equal(normals, [[0, 0, 1], [0, 0, 1]])
    np.testing.assert_array_equal(planarity, [0, 0])
    normals, planarity = estimate_normals(np.zeros((0, 3), np.float32))
    assert (normals.shape, planarity.shape) == ((0, 3), (0,))


def test_filters_agree_with_open3d():
    """Normals to 1e-6, planarity to 1e-6, and the same outliers, on surfaces, a crown and stray points."""
    try:
        o3d = open3d()
    except DependencyError as error:
        pytest.skip(str(error))
    rough = np.column_stack([RNG.uniform(0, 20, (3000, 2)), RNG.normal(0, 0.03, 3000)])
    points = np.concatenate([rough, RNG.normal(5, 1, (1500, 3)), RNG.uniform(0, 60, (60, 3))]).astype(np.float32)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
    inliers = cloud.remove_statistical_outlier(20, 2.0)[1]
    np.testing.assert_array_equal(np.flatnonzero(remove_outliers(points)[1]), sorted(inliers))
    for radius in (None, 1.5):
        nearest = o3d.geometry.KDTreeSearchParamKNN(20)
        search = nearest if radius is None else o3d.geometry.KDTreeSearchParamHybrid(radius=radius, max_nn=20)
        cloud.estimate_covariances(search)
        cloud.estimate_normals(search)
        theirs, covariances = np.asarray(cloud.normals), np.asarray(cloud.covariances)
        normals, planarity = estimate_normals(points, radius=radius)
        values = np.linalg.eigvalsh(covariances)
        told = planarity > 0.01  # where all directions are alike, any is a normal
        assert told.mean() > 0.95
        np.testing.assert_allclose(np.abs(np.einsum("ij,ij->i", normals, theirs))[told], 1.0, atol=1e-6)
        shares = values[:, 0] / np.maximum(values.sum(axis=1), 1e-30)
        np.testing.assert_allclose(planarity[told], np.clip(1.0 - 3.0 * shares, 0.0, 1.0)[told], atol=1e-6)
