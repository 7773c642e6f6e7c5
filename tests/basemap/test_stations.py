"""Rasters and stations: every number in its cell, every station at its cell's centre."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.basemap.stations import aligned_corner, describe_stations, find_stations, rasterise
from coview_stream.config import DescriptorConfig


def test_raster_cells_hold_max_height_and_voxel_count():
    points = np.array(
        [[0.1, 0.1, 1.0], [0.2, 0.2, 1.1], [0.3, 0.1, 4.0], [0.9, 0.1, -2.0], [0.1, 1.6, 0.3]], np.float32
    )
    raster = rasterise(points, np.array([0.0, 0.0]), cell=0.5, voxel=0.5, margin=1)
    assert raster.top.shape == (5, 3)
    # row along y, column along x; 1.0 and 1.1 share a voxel
    assert raster.count.tolist() == [[2, 1, 0], [0, 0, 0], [0, 0, 0], [1, 0, 0], [0, 0, 0]]
    assert raster.top[0, 0] == 4.0
    assert raster.top[0, 1] == -2.0
    assert raster.top[3, 0] == np.float32(0.3)
    assert raster.top[2, 2] == 0.0


def test_raster_counts_voxels_not_points():
    points = np.random.default_rng(0).uniform(-10, 10, (3000, 3)).astype(np.float32)
    corner = aligned_corner(points, 2.0, 0.5)
    one = rasterise(points, corner, 0.5, 0.5)
    two = rasterise(np.concatenate([points, points]), corner, 0.5, 0.5)
    np.testing.assert_array_equal(one.count, two.count)
    np.testing.assert_array_equal(one.top, two.top)


@pytest.mark.parametrize("low", [-7.3, -6.0, 0.0, 3.999, 1001.2])
@pytest.mark.parametrize(("block", "cell"), [(2.0, 0.5), (1.0, 0.5), (3.0, 0.5)])
def test_station_centres_are_cell_centres_of_an_aligned_raster(low, block, cell):
    points = np.array([[low, low + 0.7, 0.0], [low + 9, low + 9, 1.0]], np.float32)
    corner = aligned_corner(points, block, cell)
    assert (corner <= points[:, :2].min(axis=0)).all()
    centres = (np.floor(points[:, :2].astype(float) / block) + 0.5) * block
    away = (centres - corner) / cell - 0.5
    np.testing.assert_allclose(away, np.round(away), atol=1e-6)
    margin = int(np.ceil(block / cell))
    raster = rasterise(points, corner, cell, 0.5, margin)
    rows, columns = raster.cells_of(centres)
    assert (rows >= 0).all()
    assert (columns >= 0).all()
    assert rows.max() < raster.top.shape[0]
    assert columns.max() < raster.top.shape[1]
    np.testing.assert_allclose(corner + cell * (np.column_stack([columns, rows]) + 0.5), centres, atol=1e-4)


def sloping_ground(seed=3, half=11.0, count=9000):
    xy = np.random.default_rng(seed).uniform(-half, half, (count, 2))
    return np.column_stack([xy, 3.0 + 0.05 * xy[:, 0]]).astype(np.float32)


def test_one_station_per_cell_at_its_centre_and_on_the_ground():
    points = sloping_ground()
    stations = find_stations(points, 2.0)
    assert stations.dtype == np.float32
    cells = np.unique(np.floor(points[:, :2] / 2.0), axis=0)
    assert sorted(map(tuple, stations[:, :2].tolist())) == sorted(map(tuple, ((cells + 0.5) * 2.0).tolist()))
    np.testing.assert_allclose(stations[:, 2], 3.0 + 0.05 * np.clip(stations[:, 0], -10.5, 10.5), atol=0.04)


def test_no_station_where_there_is_no_ground():
    points = sloping_ground()
    pond = (np.abs(points[:, 0] - 1.0) < 1.0) & (np.abs(points[:, 1] + 5.0) < 1.0)
    stations = find_stations(points[~pond], 2.0)
    assert np.hypot(*(stations[:, :2] - [1.0, -5.0]).T).min() > 1.9


def test_stations_do_not_depend_on_point_order():
    points = sloping_ground()
    shuffled = points[np.random.default_rng(4).permutation(len(points))]
    one, two = (find_stations(p, 2.0) for p in (points, shuffled))
    np.testing.assert_allclose(one[np.lexsort(one.T)], two[np.lexsort(two.T)], atol=1e-5)


def test_describing_stations_in_chunks_gives_same_descriptors(monkeypatch):
    points = np.random.default_rng(5).uniform([-15, -15, 0], [15, 15, 6], (4000, 3)).astype(np.float32)
    stations = find_stations(sloping_ground(), 2.0)
    raster = rasterise(points, aligned_corner(points, 2.0, 0.5), 0.5, 0.5, margin=4)
    config = DescriptorConfig(radius=12.0, rings=6, sectors=12, channels=("scan_context", "coview"))
    whole = describe_stations(raster, stations, config)
    seen = []
    monkeypatch.setattr("coview_stream.basemap.stations._PORTION", 7)
    parts = describe_stations(raster, stations, config, lambda done, total: seen.append((done, total)))
    assert seen[-1] == (len(stations), len(stations))
    assert [done for done, _ in seen] == sorted({done for done, _ in seen})
    for name in config.channels:
        assert whole[name].shape == (len(stations), 6, 12)
        assert whole[name].dtype == np.float16
        np.testing.assert_array_equal(whole[name], parts[name])


def test_tower_appears_in_its_ring_and_sector():
    """From a station at (1, 1): 6 m east of it ring 3 of 2 m rings and the sectors around 0; never west."""
    flat = np.stack(np.meshgrid(np.arange(-12, 14, 0.5), np.arange(-12, 14, 0.5)), axis=-1).reshape(-1, 2)
    ground = np.column_stack([flat, np.zeros(len(flat))])
    tower = np.column_stack([np.full(9, 7.3), np.full(9, 1.3), np.arange(9)])
    points = np.concatenate([ground, tower]).astype(np.float32)
    config = DescriptorConfig(radius=12.0, rings=6, sectors=8, channels=("scan_context",))
    raster = rasterise(points, aligned_corner(points, 2.0, 0.5), 0.5, 0.5, margin=4)
    found = describe_stations(raster, np.array([[1, 1, 0], [7, -5, 0]], np.float32), config)["scan_context"]
    assert np.argwhere(found[0] > 1).tolist() == [[3, 0]]
    # from (7, -5) it stands 6 m to the north
    assert np.argwhere(found[1] > 1).tolist() in ([[3, 2]], [[3, 1]])
    assert found[0].max() == 8.0
