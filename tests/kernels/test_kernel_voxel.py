from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel_cases import clouds, poses

from coview_kernels import reference, transform_unique


@given(
    clouds(),
    poses(),
    st.sampled_from([-1.0, 0.0, 0.1, 0.5, 2.5]),
    st.sampled_from([0.0, 5.0]),
    st.sampled_from([0.0, 30.0, np.inf]),
)
def test_agrees_with_numpy(points, T, voxel, r_min, r_max):
    moved, dropped = transform_unique(points, T, voxel, r_min, r_max)
    expected, expected_dropped = reference.transform_unique(points, T, voxel, r_min, r_max)
    np.testing.assert_array_equal(moved, expected)
    assert dropped == expected_dropped
    assert moved.dtype == np.float32


@given(clouds(max_points=60), poses(), st.sampled_from([0.5, 2.5]))
def test_keeps_the_first_point_of_each_voxel(points, T, voxel):
    seen, kept = set(), []
    for point in points:
        if not np.isfinite(point).all():
            continue
        moved = (T[:3, 0] * point[0] + T[:3, 1] * point[1] + T[:3, 2] * point[2] + T[:3, 3]).astype(
            np.float32
        )
        cell = tuple(np.floor(moved.astype(np.float64) * (1.0 / voxel)))
        if np.isfinite(moved).all() and cell not in seen:
            seen.add(cell)
            kept.append(moved)
    moved, _ = transform_unique(points, T, voxel)
    np.testing.assert_array_equal(moved, np.array(kept, dtype=np.float32).reshape(-1, 3))


def test_counts_rows_that_are_not_finite():
    points = np.array([[np.nan, 0, 0], [1, 1, 1], [0, np.inf, 0], [2, -np.inf, np.nan]], dtype=np.float32)
    moved, dropped = transform_unique(points, np.eye(4), 1.0)
    assert dropped == 3
    np.testing.assert_array_equal(moved, [[1, 1, 1]])


def test_range_is_measured_in_the_source_frame_and_half_open():
    points = np.array([[1, 0, 0], [3, 0, 0], [5, 0, 0]], dtype=np.float32)
    T = np.eye(4)
    T[0, 3] = 100.0
    moved, _ = transform_unique(points, T, 0.0, r_min=1.0, r_max=5.0)
    np.testing.assert_array_equal(moved[:, 0], [101, 103])


def test_voxels_out_of_the_packed_range_agree_too():
    points = np.array([[1e7, 0, 0], [1e7, 0, 0], [0, 0, 0]], dtype=np.float32)
    moved, _ = transform_unique(points, np.eye(4), 0.001)
    np.testing.assert_array_equal(moved, points[[0, 2]])


def test_two_million_points():
    points = np.random.default_rng(1).normal(0, 40, (2_000_000, 3)).astype(np.float32)
    points[::1000] = np.nan
    T = np.eye(4)
    T[:3, 3] = [1.0, -2.0, 0.5]
    moved, dropped = transform_unique(points, T, 0.5, 1.0, 90.0)
    expected, expected_dropped = reference.transform_unique(points, T, 0.5, 1.0, 90.0)
    np.testing.assert_array_equal(moved, expected)
    assert dropped == expected_dropped == 2000


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ((np.zeros((3, 2)), np.eye(4), 1.0), "points"),
        ((np.zeros((3, 3)), np.eye(3), 1.0), "T"),
        ((np.zeros((3, 3)), np.full((4, 4), np.nan), 1.0), "T"),
        ((np.zeros((3, 3)), np.eye(4), np.nan), "voxel"),
        ((np.zeros((3, 3)), np.eye(4), 1.0, -1.0), "r_min"),
    ],
)
def test_bad_arguments_are_named(arguments, name):
    with pytest.raises(ValueError, match=name):
        transform_unique(*arguments)
