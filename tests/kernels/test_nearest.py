import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel_cases import clouds, poses

from coview_kernels import PointGrid, nearest, reference


def brute(points, queries, radius):
    """Distances (N,), inf where none is below the radius."""
    gaps = np.linalg.norm(queries[:, None].astype(float) - points[None].astype(float), axis=2)
    found = np.where(gaps < radius, gaps, np.inf).min(axis=1, initial=np.inf)
    return np.where(np.isfinite(queries).all(axis=1), found, np.inf)


def assert_answers(points, queries, distance, index, expected):
    """Distances to 1e-12 of themselves: both sides work in float64, and either of two equally near points is right."""
    np.testing.assert_allclose(distance, expected, rtol=1e-12, atol=1e-9)
    found = np.isfinite(distance)
    assert (index[~found] == len(points)).all()
    gaps = np.linalg.norm(queries[found].astype(float) - points[index[found]].astype(float), axis=1)
    np.testing.assert_allclose(gaps, distance[found], rtol=1e-9, atol=1e-9)


def finite(points):
    return points[np.isfinite(points).all(axis=1)]


@given(clouds(), clouds(), poses(), st.sampled_from([0.3, 2.5, 9.0, 200.0]))
def test_kernel_agrees_with_numpy(cloud, queries, T, radius):
    grid = PointGrid(finite(cloud))
    distance, index = nearest(grid, queries, radius)
    expected, _ = reference.nearest(grid.tree, queries, radius)
    assert_answers(grid.points, queries, distance, index, expected)
    moved, partner = nearest(grid, queries, radius, T)
    expected, _ = reference.nearest(grid.tree, queries, radius, T)
    np.testing.assert_allclose(moved, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(partner == len(grid.points), np.isinf(moved))


@given(clouds(120), clouds(60), st.sampled_from([0.5, 4.0, 100.0]))
def test_kernel_and_numpy_agree_with_brute_force(cloud, queries, radius):
    cloud = finite(cloud)
    cloud = cloud[np.abs(cloud).max(axis=1, initial=0) < 1e6]
    grid = PointGrid(cloud)
    expected = brute(cloud, queries, radius)
    for answer in (nearest(grid, queries, radius), reference.nearest(grid.tree, queries, radius)):
        assert_answers(cloud, queries, *answer, expected)


@pytest.mark.parametrize("stretch", [[1, 1, 1], [1, 1, 1000], [3000, 3000, 1], [1e6, 1, 1e6], [0, 0, 1], [0, 0, 0]])
def test_wide_high_and_flat_clouds(stretch):
    """Wide ones get larger cells, high ones a topmost layer that holds the rest, flat ones a single row."""
    rng = np.random.default_rng(1)
    cloud = (rng.uniform(-5, 5, (4000, 3)) * stretch).astype(np.float32)
    grid = PointGrid(cloud)
    step = 0.3 * np.maximum(np.array(stretch) / 10.0, 0.3)
    near = (cloud[::7] + rng.normal(0, 1, (len(cloud[::7]), 3)) * step).astype(np.float32)
    far = (1e4 * rng.normal(size=(40, 3)) * np.maximum(stretch, 1)).astype(np.float32)
    queries = np.concatenate([cloud[::9], near, far])
    for radius in (0.1, 3.0, 1e7):
        expected, _ = reference.nearest(grid.tree, queries, radius)
        assert_answers(cloud, queries, *nearest(grid, queries, radius), expected)


def test_radius_is_exclusive_and_ties_give_any_point():
    grid = PointGrid(np.array([[0, 0, 0], [2, 0, 0], [2, 0, 0]], np.float32))
    distance, index = nearest(grid, [[1, 0, 0], [2, 0, 0], [-1, 0, 0]], 1.0)
    np.testing.assert_array_equal(distance, [np.inf, 0.0, np.inf])
    np.testing.assert_array_equal(index == 3, [True, False, True])
    assert index[1] in (1, 2)
    assert nearest(grid, [[1, 0, 0]], 1.001)[0] == 1.0


def test_empty_cloud_or_queries():
    empty = PointGrid(np.empty((0, 3)))
    distance, index = nearest(empty, np.ones((2, 3)), 5.0)
    np.testing.assert_array_equal(distance, np.inf)
    np.testing.assert_array_equal(index, 0)
    distance, index = nearest(PointGrid(np.ones((4, 3))), np.empty((0, 3)), 5.0)
    assert distance.shape == index.shape == (0,)
    assert (distance.dtype, index.dtype) == (np.float64, np.int64)


def test_errors_name_the_argument():
    cloud = np.zeros((2, 3))
    with pytest.raises(ValueError, match="points"):
        PointGrid(np.zeros((2, 2)))
    with pytest.raises(ValueError, match="points"):
        PointGrid(np.array([[0, 0, np.nan]]))
    grid = PointGrid(cloud)
    with pytest.raises(ValueError, match="queries"):
        nearest(grid, np.zeros(3), 1.0)
    for radius in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="radius"):
            nearest(grid, cloud, radius)
    with pytest.raises(ValueError, match="T"):
        nearest(grid, cloud, 1.0, np.full((4, 4), np.nan))
