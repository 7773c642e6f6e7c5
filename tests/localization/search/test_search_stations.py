"""Stations that a search compares: squares of many, a circle of a map, and places that come out as without them."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.basemap.station_grid import StationGrid
from coview_stream.geometry.circle import Circle
from coview_stream.geometry.transforms import pose_from
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.search import search_stations
from coview_stream.localization.search.place_guess import PlaceGuess
from coview_stream.localization.search.search_stations import SearchStations
from coview_stream.localization.state import State


@pytest.fixture
def few_are_many(monkeypatch):
    monkeypatch.setattr(search_stations, "_ORDINARY", 50)


def test_ordinary_maps_are_compared_whole(world_map):
    compared = SearchStations.of(world_map.station_index, world_map.station_grid)
    assert compared.index is world_map.station_index
    assert compared.grid is world_map.station_grid


def test_every_station_is_in_one_square_and_its_middle_stands_for_it(few_are_many, world_map):
    compared = SearchStations.of(world_map.station_index, world_map.station_grid)
    members = compared.squares.members
    assert len(compared) == len(members) < len(world_map) / 6
    np.testing.assert_array_equal(np.sort(members[members >= 0]), np.arange(len(world_map)))
    for square, middle in zip(members, compared.numbers, strict=True):
        inside = world_map.stations[square[square >= 0], :2]
        assert np.ptp(np.floor(inside / 6.0), axis=0).max() == 0
        centre = (np.floor(inside[0] / 6.0) + 0.5) * 6.0
        nearest = np.abs(inside - centre).max(axis=1).min()
        assert np.abs(world_map.stations[middle, :2] - centre).max() == pytest.approx(nearest)


def test_storeys_have_squares_of_their_own(few_are_many, world_map):
    ground = world_map.stations[:80]
    above = ground + np.array([0, 0, 4], dtype=np.float32)
    grid = StationGrid(np.concatenate([ground, above[::2]]), world_map.config.block)
    members = search_stations._members(grid, np.arange(len(grid)), 3)
    heights = np.where(members < 0, np.nan, grid.stations[members, 2])
    assert np.nanmax(np.nanmax(heights, axis=1) - np.nanmin(heights, axis=1)) < 3.0
    np.testing.assert_array_equal(np.sort(members[members >= 0]), np.arange(len(grid)))


def test_blocks_of_a_square_s_size_stand_for_themselves(few_are_many, world_map):
    grid = StationGrid(world_map.stations, 6.0)
    assert SearchStations.of(world_map.station_index, grid).squares is None


@pytest.mark.parametrize("many", [False, True])
def test_circle_has_the_scores_of_the_map(world_map, monkeypatch, many):
    if many:
        monkeypatch.setattr(search_stations, "_ORDINARY", 20)
    index, grid = world_map.station_index, world_map.station_grid
    chosen = np.flatnonzero(Circle(*world_map.stations[40, :2].tolist(), 12.0).holds(world_map.stations))
    compared = SearchStations.of(index, grid, chosen)
    assert set(compared.numbers.tolist()) <= set(chosen.tolist())
    query = {name: world_map.descriptors(name)[40].astype(np.float32) for name in world_map.descriptor_config.channels}
    asked, whole = compared.index.query(query), index.query(query)
    every = np.arange(len(compared))
    found, expected = compared.index.all_shifts(asked, every), index.all_shifts(whole, compared.numbers)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    if not many:
        single = compared.index.at(asked, every, np.zeros(len(every)))
        np.testing.assert_allclose(single, index.at(whole, compared.numbers, np.zeros(len(every))), atol=1e-4)


def driven(localizer, world_drive, guess=None, frames=6):
    if guess is not None:
        localizer.guess_place(guess)
    steps = zip(world_drive.clouds, world_drive.T_odom_body, range(frames), strict=False)
    return [localizer.step(cloud, T, 0.5 * k) for cloud, T, k in steps]


@pytest.mark.slow
def test_robot_is_found_by_squares_as_by_all_stations(few_are_many, world_map, world_drive, world_fixes):
    for fix, plain in zip(driven(Localizer(world_map), world_drive), world_fixes, strict=False):
        assert fix.state is plain.state
        if plain.T_map_body is not None:
            np.testing.assert_allclose(fix.T_map_body[:3, 3], plain.T_map_body[:3, 3], atol=0.1)


@pytest.mark.slow
def test_robot_is_found_within_a_circle_and_not_beside_it(world_map, world_drive, world_fixes):
    true = next(fix for fix in world_fixes if fix.T_map_body is not None).T_map_body
    x, y = true[:2, 3].tolist()
    here = driven(Localizer(world_map), world_drive, PlaceGuess(x + 15.0, y - 12.0, within=50.0))
    assert any(fix.T_map_body is not None for fix in here)
    for fix, plain in zip(here, world_fixes, strict=False):
        if fix.T_map_body is not None and plain.T_map_body is not None:
            np.testing.assert_allclose(fix.T_map_body[:3, 3], plain.T_map_body[:3, 3], atol=0.1)
    away = world_map.stations[np.linalg.norm(world_map.stations[:, :2] - (x, y), axis=1).argmax()] + world_map.origin
    away[:2] += 45.0 * (away[:2] - (x, y)) / np.linalg.norm(away[:2] - (x, y))
    localizer = Localizer(world_map)
    there = driven(localizer, world_drive, PlaceGuess(*away[:2].tolist(), within=50.0))
    assert all(fix.T_map_body is None for fix in there)
    x_away, y_away = away[:2].tolist()
    localizer.guess_place(PlaceGuess(x_away, y_away, distance=5.0, within=50.0))
    last = world_drive.clouds[6], world_drive.T_odom_body[6]
    assert localizer.step(*last, 3.0).state is not State.TRACKING


def test_localizer_that_does_not_search_chooses_no_stations(world_map, world_drive, monkeypatch):
    """As the tracking engine's: the search is in another process."""
    monkeypatch.setattr(SearchStations, "of", None)
    localizer = Localizer(world_map)
    assert localizer.add_frame(world_drive.clouds[0], world_drive.T_odom_body[0], 0.0) is not None


def test_hints_outside_the_circle_are_not_tried(world_map, world_drive):
    x, y = (world_map.stations[0] + world_map.origin)[:2].tolist()
    for away, tried in ((20.0, True), (70.0, False)):
        localizer = Localizer(world_map)
        localizer.hint_pose(pose_from(np.eye(3), [x + away, y, 1.0]))
        localizer.guess_place(PlaceGuess(x, y, within=50.0))
        request = localizer.add_frame(world_drive.clouds[0], world_drive.T_odom_body[0], 0.0)
        assert len(request.hints) == tried
        assert request.area == Circle(*(np.array([x, y]) - world_map.origin[:2]).tolist(), 50.0)
