import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel_cases import clouds, parallel_parts

from coview_kernels import polar_bin, reference, station_bins

SIZES = st.sampled_from([(1, 1), (1, 2), (3, 4), (20, 60), (20, 61), (7, 360)])


def assert_same(grid, expected):
    np.testing.assert_array_equal(grid.count, expected.count)
    np.testing.assert_array_equal(grid.max_height, expected.max_height)
    # sums of float64, in another order
    np.testing.assert_allclose(grid.mean_height, expected.mean_height, rtol=1e-6, atol=1e-6)
    for ours, theirs in zip(grid, expected, strict=True):
        assert ours.dtype == theirs.dtype
        assert ours.shape == theirs.shape


@given(clouds(), SIZES, st.sampled_from([5.0, 50.0]), st.sampled_from([(0, 0, 0), (2.5, -7.5, 1.0), (0.1, 0.2, 0.3)]))
def test_polar_bin_agrees_with_numpy(points, size, r_max, centre):
    grid, dropped = polar_bin(points, centre, *size, r_max)
    expected, expected_dropped = reference.polar_bin(points, np.array(centre, dtype=float), *size, r_max)
    assert_same(grid, expected)
    assert dropped == expected_dropped == np.count_nonzero(~np.isfinite(points).all(axis=1))


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_result_does_not_depend_on_the_number_of_threads(threads):
    points = np.random.default_rng(9).normal(0, 20, (30_000, 3)).astype(np.float32)
    points[::100, 2] = np.nan
    rings = 30 + threads  # bins of a size that no test has prepared with another number
    with parallel_parts(threads):
        for n in (30_000, 5_000, 30_000):
            found, dropped = polar_bin(points[:n], np.ones(3), rings, 60, 50.0)
            expected, expected_dropped = reference.polar_bin(points[:n], np.ones(3), rings, 60, 50.0)
            assert_same(found, expected)
            assert dropped == expected_dropped


@given(clouds(max_points=120), st.sampled_from([(3, 4), (20, 60)]))
def test_polar_bin_agrees_with_its_definition_away_from_edges(points, size):
    rings, sectors = size
    count = np.zeros(size, dtype=int)
    highest, total = np.zeros(size), np.zeros(size)
    clear = []
    for x, y, z in points[np.isfinite(points).all(axis=1)].astype(float):
        ring = math.hypot(x, y) / (50.0 / rings)
        sector = math.atan2(y, x) % (2 * math.pi) / (2 * math.pi / sectors)
        if abs(z) > 1e30 or ring >= rings or min(abs(ring - round(ring)), abs(sector - round(sector))) < 1e-5:
            continue
        clear.append((x, y, z))
        bin_ = (int(ring), int(sector) % sectors)
        highest[bin_] = z if count[bin_] == 0 else max(z, highest[bin_])
        count[bin_] += 1
        total[bin_] += z
    grid, _ = polar_bin(np.array(clear, dtype=np.float32).reshape(-1, 3), (0, 0, 0), *size, 50.0)
    np.testing.assert_array_equal(grid.count, count)
    np.testing.assert_allclose(grid.max_height, highest, rtol=1e-6)
    np.testing.assert_allclose(grid.mean_height, total / np.maximum(count, 1), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("implementation", [polar_bin, reference.polar_bin])
def test_edge_points_belong_to_the_outer_ring_and_counter_clockwise_sector(implementation):
    def where(x, y):
        grid, _ = implementation(np.array([[x, y, 1.0]], dtype=np.float32), np.zeros(3), 5, 4, 10.0)
        found = np.argwhere(grid.count)
        return tuple(int(v) for v in found[0]) if len(found) else None

    assert where(0.0, 0.0) == (0, 0)
    assert where(-0.0, -0.0) == (0, 0)
    assert where(2.0, 0.0) == (1, 0)
    assert where(2.0, -0.0) == (1, 0)
    assert where(0.0, 4.0) == (2, 1)
    assert where(-6.0, 0.0) == (3, 2)
    assert where(-6.0, -0.0) == (3, 2)
    assert where(0.0, -8.0) == (4, 3)
    assert where(np.nextafter(np.float32(10), np.float32(0)), 0.0) == (4, 0)
    assert where(10.0, 0.0) is None
    assert where(1.0, -1e-30) == (0, 3)


@pytest.mark.parametrize("sectors", [3, 8, 60, 64, 361])
def test_kernel_and_numpy_agree_on_sector_edges(sectors):
    angle = np.arange(sectors) * 2 * np.pi / sectors
    radius = np.linspace(0.1, 49.9, 40)
    on = np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)
    points = np.concatenate([np.c_[(on * np.float32(r)), np.zeros(sectors)] for r in radius]).astype(np.float32)
    grid, _ = polar_bin(points, (0, 0, 0), 20, sectors, 50.0)
    assert_same(grid, reference.polar_bin(points, np.zeros(3), 20, sectors, 50.0)[0])
    assert grid.count.sum() == len(points)


@st.composite
def rasters(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = draw(st.tuples(st.integers(1, 30), st.integers(1, 30)))
    count = rng.integers(0, 4, shape).astype(np.int32) * (rng.random(shape) < draw(st.sampled_from([0.1, 0.9])))
    top = rng.normal(100, 5, shape).astype(np.float32)
    stations = draw(st.integers(0, 5))
    at = rng.integers(0, shape[0], stations), rng.integers(0, shape[1], stations)
    return top, count.astype(np.int32), *at, rng.normal(95, 2, stations)


@given(rasters(), st.sampled_from([(1, 1), (4, 6), (20, 60)]), st.sampled_from([0.5, 1.0, 2.3]))
def test_station_bins_agrees_with_numpy(raster, size, cell):
    top, count, rows, cols, ground = raster
    rows, cols, ground = rows.astype(np.int32), cols.astype(np.int32), ground.astype(np.float32)
    arguments = (top, count, cell, rows, cols, ground, *size, 8.0, top - 1)
    assert_same(station_bins(*arguments), reference.station_bins(*arguments))
    assert station_bins(*arguments[:-1]).mean_height is None


@given(rasters())
def test_station_bins_are_polar_bins_of_cell_centres(raster):
    top, count, rows, cols, ground = raster
    grid = station_bins(top, count, 0.5, rows, cols, ground, 5, 8, 6.0, top)
    assert grid.count.shape == (len(rows), 5, 8)
    row, col = np.nonzero(count)
    for m in range(len(rows)):
        centres = np.stack([(col - cols[m]) * 0.5, (row - rows[m]) * 0.5, top[row, col]], axis=1)
        points = np.repeat(centres, count[row, col], axis=0).astype(np.float32)
        expected, _ = polar_bin(points, (0, 0, np.float32(ground[m])), 5, 8, 6.0)
        np.testing.assert_array_equal(grid.count[m], expected.count)
        np.testing.assert_array_equal(grid.max_height[m], expected.max_height)
        np.testing.assert_allclose(grid.mean_height[m], expected.mean_height, atol=2e-5)  # of float32 offsets


def test_values_of_empty_raster_cells_are_ignored():
    count = np.array([[1, 0, 0]], dtype=np.int32)
    junk = np.array([[2.0, np.nan, 1e30]], dtype=np.float32)
    grid = station_bins(junk, count, 1.0, [0], [1], [1.0], 3, 4, 6.0)
    assert grid.count.sum() == 1
    assert grid.max_height.max() == 1.0


def test_errors_name_the_argument():
    cloud, raster = np.zeros((1, 3)), np.zeros((4, 5))
    with pytest.raises(ValueError, match="centre"):
        polar_bin(cloud, (0, np.nan, 0), 20, 60, 50.0)
    with pytest.raises(ValueError, match="r_max"):
        polar_bin(cloud, (0, 0, 0), 20, 60, 0.0)
    for rings, sectors in ((0, 60), (2, 60_000)):
        with pytest.raises(ValueError, match="rings"):
            polar_bin(cloud, (0, 0, 0), rings, sectors, 50.0)
    with pytest.raises(ValueError, match="raster_count"):
        station_bins(raster, raster[:2], 1.0, [0], [0], [0], 2, 4, 5.0)
    with pytest.raises(ValueError, match="inside the raster"):
        station_bins(raster, raster, 1.0, [4], [0], [0], 2, 4, 5.0)
    with pytest.raises(ValueError, match="cell"):
        station_bins(raster, raster, 0.0, [0], [0], [0], 2, 4, 5.0)
