"""Station grid: which station is at a position, at edges, off the map, and between storeys."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.basemap.stations import StationGrid

BLOCK = 2.0


def stations_of(side=6, z=0.0):
    axis = (np.arange(side) - 2 + 0.5) * BLOCK
    x, y = np.meshgrid(axis, axis, indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), np.full(side * side, z)]).astype(np.float32)


@pytest.mark.parametrize("step", [[3, 0], [0, 3], [-4, 0], [0, -5], [2, -1], [-50, 0], [0, 1000], [0, 0], [1, -6]])
def test_stations_a_step_apart_are_found_and_none_beyond_the_edges(step):
    stations = stations_of()
    goal = stations + np.array([*np.array(step) * BLOCK, 0.0])
    found = StationGrid(stations, BLOCK).at(goal)
    for m in range(len(stations)):
        there = np.flatnonzero(np.abs(stations[:, :2] - goal[m, :2]).max(axis=1) < 0.1)
        assert found[m] == (there[0] if len(there) else -1)


def test_a_cell_reaches_to_its_edges_and_belongs_to_one_station():
    grid = StationGrid(stations_of()[::5], BLOCK)
    places = np.random.default_rng(0).uniform(-9, 14, (500, 3))
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
