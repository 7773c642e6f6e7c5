"""Stations that a search compares: squares of many, a circle of a map, and places that come out as without them."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.basemap.stations import StationGrid
from coview_stream.errors import InputError
from coview_stream.geometry.transforms import Circle, pose_from
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.search import retrieval
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.hints import PlaceGuess, PoseHints
from coview_stream.localization.search.retrieval import SearchStations
from coview_stream.localization.state import State
from coview_stream.stream.node.engine_queue import FrameJob
from coview_stream.stream.node.engines import TrackEngine


@pytest.fixture
def few_are_many(monkeypatch):
    monkeypatch.setattr(retrieval, "_ORDINARY", 50)


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
    above = ground + np.array([0, 0, 6], dtype=np.float32)
    for lower, upper in ((ground, above[::2]), (ground[::2], above), (ground[::3], above[1::2])):
        grid = StationGrid(np.concatenate([lower, upper]), world_map.config.block)
        members = retrieval._members(grid, np.arange(len(grid)), 3)
        heights = np.where(members < 0, np.nan, grid.stations[members, 2])
        assert np.nanmax(np.nanmax(heights, axis=1) - np.nanmin(heights, axis=1)) < 3.0
        np.testing.assert_array_equal(np.sort(members[members >= 0]), np.arange(len(grid)))
        # each of them is found at its height by the one that stands for it
        coarse = StationGrid(grid.stations[members[:, 0]], 3 * grid.block)
        found = coarse.at(grid.stations)
        assert (found >= 0).all()
        assert (np.abs(coarse.stations[found, 2] - grid.stations[:, 2]) < 3.0).all()


def test_blocks_of_a_square_s_size_stand_for_themselves(few_are_many, world_map):
    grid = StationGrid(world_map.stations, 6.0)
    assert SearchStations.of(world_map.station_index, grid).squares is None


@pytest.mark.parametrize("many", [False, True])
def test_circle_has_the_scores_of_the_map(world_map, monkeypatch, many):
    if many:
        monkeypatch.setattr(retrieval, "_ORDINARY", 20)
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
    there = driven(Localizer(world_map), world_drive, PlaceGuess(*away[:2].tolist(), within=50.0))
    assert all(fix.T_map_body is None for fix in there)


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
        assert request.area == Circle(*(np.array([x, y]) - world_map.origin[:2]).tolist(), 62.5)


def test_circle_grows_with_what_the_robot_drives():
    hints, anchor, body = PoseHints(), np.array([100.0, 50.0, 0.0]), np.eye(4)
    assert hints.area(anchor, body) is None
    hints.guess(PlaceGuess(10.0, 20.0, within=80.0))
    hints.guessed(np.zeros(3), anchor, body)
    for metres, radius in ((0.0, 100.0), (19.0, 100.0), (30.0, 125.0), (400.0, 80.0 * 1.25**9)):
        body[0, 3] = metres
        assert hints.area(anchor, body) == Circle(10.0, 20.0, pytest.approx(radius))
        assert radius >= 80.0 + metres
        moved = body.copy()
        moved[:3, 3] += (5.0, -4.0, 0.0)
        assert hints.area(anchor - (5.0, -4.0, 0.0), moved) == hints.area(anchor, body)  # another anchor


def test_circle_without_ground_is_searched_by_nothing(world_map, world_drive):
    guess = PlaceGuess(9000.0, 9000.0, within=60.0)
    localizer = Localizer(world_map)
    with pytest.raises(InputError, match="no ground within 60 m"):
        localizer.guess_place(guess)
    engine = TrackEngine(world_map)
    job = FrameJob("r1", 0, 0, world_drive.clouds[0], world_drive.T_odom_body[0], guess=guess)
    result = engine.run(job)
    assert result.request is None
    assert "no ground in the circle" in result.fix.evidence.reason
    assert result.fix.state is State.SEARCHING


@pytest.mark.parametrize("lifted", [False, True])
def test_result_of_a_search_from_before_the_circle_is_not_taken(world_map, world_drive, lifted):
    localizer = Localizer(world_map)
    search = GlobalSearch(world_map, localizer.config, LocalMaps(world_map, 50.0))
    x, y = (world_map.stations[0] + world_map.origin)[:2].tolist()
    if lifted:
        localizer.guess_place(PlaceGuess(x, y, within=500.0))
    frames = zip(world_drive.clouds, world_drive.T_odom_body, range(6), strict=False)
    requests = [localizer.add_frame(cloud, T, 0.5 * k) for cloud, T, k in frames]
    results = [search.update(each) for each in requests if each is not None]
    assert any(result.accepted is not None for result in results)
    localizer.guess_place(PlaceGuess(x, y, within=None if lifted else 500.0))
    for result in results:
        localizer.apply_search_result(result)
    assert localizer.state is not State.TRACKING
