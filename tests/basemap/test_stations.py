"""Stations: on ground and floors, their descriptors against brute force, and their look-up by position."""

import numpy as np
import pytest

from coview_kernels import reference
from coview_stream.basemap.stations import (
    StationGrid,
    aligned_corner,
    below_another,
    describe_stations,
    describe_storeys,
    find_stations,
    rasterise,
)
from coview_stream.config import DescriptorConfig
from coview_stream.errors import MapError

BLOCK = 2.0


@pytest.mark.parametrize("means", [False, True])
def test_raster_cells_hold_max_height_and_voxel_count(means):
    points = np.array(
        [[0.1, 0.1, 1.0], [0.2, 0.2, 1.1], [0.3, 0.1, 4.0], [0.9, 0.1, -2.0], [0.1, 1.6, 0.3]], np.float32
    )
    raster = rasterise(points, np.array([0.0, 0.0]), cell=0.5, voxel=0.5, margin=1, means=means)
    assert raster.top.shape == (5, 3)
    # row along y, column along x; 1.0 and 1.1 share a voxel
    assert raster.count.tolist() == [[2, 1, 0], [0, 0, 0], [0, 0, 0], [1, 0, 0], [0, 0, 0]]
    assert raster.top[0, 0] == 4.0
    assert raster.top[0, 1] == -2.0
    assert raster.top[3, 0] == np.float32(0.3)
    assert raster.top[2, 2] == 0.0


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


def sloping_ground():
    xy = np.random.default_rng(3).uniform(-11.0, 11.0, (9000, 2))
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


def test_describing_stations_in_portions_gives_same_descriptors():
    points = np.random.default_rng(5).uniform([-15, -15, 0], [15, 15, 6], (4000, 3)).astype(np.float32)
    stations = find_stations(sloping_ground(), 2.0)
    raster = rasterise(points, aligned_corner(points, 2.0, 0.5), 0.5, 0.5, margin=4)
    config = DescriptorConfig(radius=12.0, rings=6, sectors=12, channels=("scan_context", "coview"))
    one, seen = describe_stations(raster, stations, config), []
    many = describe_stations(raster, np.tile(stations, (9, 1)), config, lambda *step: seen.append(step))
    total = 9 * len(stations)
    assert seen == [(512, total), (1024, total), (total, total)]
    for name in config.channels:
        assert one[name].shape == (len(stations), 6, 12)
        assert one[name].dtype == np.float16
        np.testing.assert_array_equal(many[name], np.tile(one[name], (9, 1, 1)))


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


def test_only_lower_station_of_a_cell_is_below_another():
    stations = np.array([[1, 1, 0], [3, 1, 0], [1, 1, 3.2], [1, 1, 6.4]], dtype=np.float32)
    assert below_another(stations, 2.0).tolist() == [True, False, True, False]
    assert below_another(stations[:0], 2.0).tolist() == []


def test_lower_storey_descriptor_excludes_tower_on_the_roof():
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-12, 12, 0.4), np.arange(-12, 12, 0.4)))
    floors = [np.column_stack([x, y, np.full(len(x), z)]) for z in (0.0, 3.0)]
    tower = np.column_stack([np.full(60, 7.0), np.full(60, 0.2), np.linspace(3.0, 20.0, 60)])
    points = np.concatenate([*floors, tower]).astype(np.float32)
    stations = np.array([[1, 1, 0], [1, 1, 3]], dtype=np.float32)
    config = DescriptorConfig(radius=10.0, channels=("scan_context",))
    described = describe_storeys(points, stations, 2.0, config)["scan_context"].astype(float)
    assert described[0].max() < 6.0  # up to the ceiling that counts as one
    assert described[1].max() > 15.0  # the upper storey stands beside the tower


@pytest.fixture(scope="module")
def both():
    """Descriptors of twenty stations among boxes, from the raster and from the highest points of all voxels."""
    rng, config = np.random.default_rng(1), DescriptorConfig()
    xy = rng.uniform(0.0, 70.0, (400_000, 2))
    z = 2.0 * np.sin(xy[:, 0] / 37.0) + 1.5 * np.cos(xy[:, 1] / 51.0) + rng.normal(0.0, 0.02, len(xy))
    stations = np.column_stack([xy[:20], z[:20]]).astype(np.float32)
    for middle, size, height in zip(rng.uniform(0, 70, (9, 2)), rng.uniform(4, 10, (9, 2)), range(4, 13), strict=True):
        inside = (np.abs(xy - middle) < size).all(axis=1)
        z[inside] += height * rng.choice([rng.random(), 1.0], inside.sum())
    cloud = np.column_stack([xy, z]).astype(np.float32)
    raster = rasterise(cloud, aligned_corner(cloud, BLOCK, 0.5), 0.5, config.voxel, 4)
    thin = cloud[np.argsort(-cloud[:, 2])]
    thin = thin[np.unique(np.floor(thin / config.voxel), axis=0, return_index=True)[1]]
    exact = {"scan_context": [], "coview": []}
    for station in stations.astype(np.float64):
        grid, _ = reference.polar_bin(thin, station, config.rings, config.sectors, config.radius)
        exact["scan_context"].append(np.where(grid.count > 0, np.maximum(grid.max_height, 0), 0))
        exact["coview"].append(reference.coview(grid.max_height, grid.count))
    found = describe_stations(raster, stations, config)
    return {name: (found[name].astype(np.float32), np.stack(values)) for name, values in exact.items()}


@pytest.mark.parametrize(("channel", "share", "distance"), [("scan_context", 0.05, 0.06), ("coview", 0.07, 0.1)])
def test_raster_descriptor_bins_are_close_to_exact_bins(both, channel, share, distance):
    found, exact = both[channel]
    assert (np.abs(found - exact) > 0.5).mean() < share
    found, exact = found.reshape(len(found), -1), exact.reshape(len(exact), -1)
    cosine = (found * exact).sum(axis=1) / np.linalg.norm(found, axis=1) / np.linalg.norm(exact, axis=1)
    assert (1 - cosine).mean() < distance


def stations_of(side=6, z=0.0):
    axis = (np.arange(side) - 2 + 0.5) * BLOCK
    x, y = np.meshgrid(axis, axis, indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), np.full(side * side, z)]).astype(np.float32)


def test_a_cell_reaches_to_its_edges_and_belongs_to_one_station():
    grid = StationGrid(stations_of()[::5], BLOCK)
    places = np.concatenate([np.random.default_rng(0).uniform(-9, 14, (500, 3)), [[-100, 0, 0], [0, 2000, 0]]])
    for position, found in zip(places, grid.at(places), strict=True):
        near = np.flatnonzero((np.abs(grid.stations[:, :2] - position[:2]) < 0.5 * BLOCK).all(axis=1))
        assert found == (near[0] if len(near) else -1)


def test_storeys_are_distinguished_by_height():
    stations = np.concatenate([stations_of(4), stations_of(4, z=4.0)[:8]])
    grid = StationGrid(stations, BLOCK)
    np.testing.assert_array_equal(grid.at(stations), np.arange(24))
    up = grid.at(stations + np.array([0.0, 0.0, 4.0]))
    np.testing.assert_array_equal(up[:8], np.arange(16, 24))
    assert (up[8:] == -1).all()  # no upper storey there, and above it nothing
    down = grid.at(stations - np.array([0.0, 0.0, 4.0]))
    np.testing.assert_array_equal(down[16:], np.arange(8))
    assert (down[:16] == -1).all()


def test_a_map_without_storeys_has_its_stations_at_any_height():
    stations = stations_of()
    np.testing.assert_array_equal(StationGrid(stations, BLOCK).at(stations + np.array([0.0, 0.0, 7.0])), np.arange(36))


def test_stations_beside_all_points_are_refused():
    points = np.random.default_rng(1).uniform(0.0, 10.0, (500, 3)).astype(np.float32)
    stations = np.array([[5.0, 5.0, 0.0], [25.0, 5.0, 0.0], [5.0, -9.0, 0.0]], np.float32)
    with pytest.raises(MapError, match="2 stations lie beside"):
        describe_storeys(points, stations, 2.0, DescriptorConfig())
