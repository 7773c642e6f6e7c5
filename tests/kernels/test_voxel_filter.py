import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel_cases import clouds, poses

from coview_kernels import reference, transform_unique, voxel_filter


def assert_filtered(points, T, *limits):
    """Compare the kernel with its twin; return the points kept and the rows dropped."""
    moved, dropped = transform_unique(points, T, *limits)
    expected, expected_dropped = reference.transform_unique(points, T, *limits)
    np.testing.assert_array_equal(moved, expected)
    assert moved.dtype == np.float32
    assert dropped == expected_dropped
    return moved, dropped


@given(
    clouds(),
    poses(),
    st.sampled_from([-1.0, 0.0, 0.1, 0.5, 2.5]),
    st.sampled_from([0.0, 5.0]),
    st.sampled_from([0.0, 30.0, np.inf]),
    st.sampled_from([(0.0, 0.0, 0.0), (7.5, -20.0, 3.1)]),
)
def test_transform_unique_agrees_with_numpy(points, T, voxel, r_min, r_max, centre):
    assert_filtered(points, T, voxel, r_min, r_max, centre)


@given(clouds(max_points=60), poses(), st.sampled_from([0.5, 2.5]))
def test_first_point_of_each_voxel_is_kept(points, T, voxel):
    seen, kept = set(), []
    for point in points:
        if not np.isfinite(point).all():
            continue
        moved = (T[:3, 0] * point[0] + T[:3, 1] * point[1] + T[:3, 2] * point[2] + T[:3, 3]).astype(np.float32)
        cell = tuple(np.floor(moved.astype(np.float64) * (1.0 / voxel)))
        if np.isfinite(moved).all() and cell not in seen:
            seen.add(cell)
            kept.append(moved)
    moved, _ = transform_unique(points, T, voxel)
    np.testing.assert_array_equal(moved, np.array(kept, dtype=np.float32).reshape(-1, 3))


def test_rows_that_are_not_finite_are_dropped_and_counted():
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


def test_voxel_indices_beyond_64_bits():
    points = np.array([[1e7, 0, 0], [1e7, 0, 0], [0, 0, 0]], dtype=np.float32)
    moved, _ = transform_unique(points, np.eye(4), 0.001)
    np.testing.assert_array_equal(moved, points[[0, 2]])


@pytest.mark.slow
def test_transform_unique_of_two_million_points():
    points = np.random.default_rng(1).normal(0, 40, (2_000_000, 3)).astype(np.float32)
    points[::1000] = np.nan
    T = np.eye(4)
    T[:3, 3] = [1.0, -2.0, 0.5]
    assert assert_filtered(points, T, 0.5, 1.0, 90.0)[1] == 2000


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
def test_errors_name_the_argument(arguments, name):
    with pytest.raises(ValueError, match=name):
        transform_unique(*arguments)


@pytest.mark.parametrize("spread", [0.1, 3.0, 400.0])
def test_hash_table_grows_with_the_volume_of_the_cloud(spread, monkeypatch):
    """From few cubes of 4 x 4 x 4 voxels to one for each point."""
    monkeypatch.setattr(voxel_filter, "_pass", None)
    points = np.random.default_rng(9).normal(0, spread, (20_000, 3)).astype(np.float32)
    for n in (1, 20_000, 63, 64, 65):
        assert_filtered(points[:n], np.eye(4), 0.1)


def test_farthest_voxels_within_reach():
    """16 bits an axis, around the voxel of the sensor."""
    least, most = -(1 << 15), (1 << 15) - 1
    corners = np.array(np.meshgrid(*[[least, -1, 0, most]] * 3), dtype=float).reshape(3, -1).T
    points = np.concatenate([corners + 0.25, corners + 0.75]).astype(np.float32)
    T = np.eye(4)
    for sensor in (0.0, 1000.0):
        T[:3, 3] = sensor
        assert len(assert_filtered(points, T, 1.0)[0]) == 64
        for step in (least - 1, most + 1):
            assert_filtered(np.append(points, np.full((1, 3), step, np.float32), axis=0), T, 1.0)


def test_table_is_cleared_when_the_call_number_overflows(monkeypatch):
    monkeypatch.setattr(voxel_filter, "_MAX_CALLS", 4)
    monkeypatch.setattr(voxel_filter, "_pass", None)
    rng = np.random.default_rng(6)
    for _ in range(10):
        assert_filtered(rng.normal(0.0, 15.0, (3_000, 3)).astype(np.float32), np.eye(4), 0.5)


def test_points_out_of_reach_are_filtered_in_numpy():
    T = np.eye(4)
    T[0, 3] = 1e6  # the sensor may be anywhere, its points are what must be near it
    near = np.array([[1, 0, 0], [1, 0, 0], [70, 0, 0]], dtype=np.float32)
    far = np.array([[1e6, 0, 0], [1e6, 0, 0], [-1e30, 0, 0], [0, 0, 0]], dtype=np.float32)
    for points in (near, far, near):
        assert_filtered(points, T, 0.5)
