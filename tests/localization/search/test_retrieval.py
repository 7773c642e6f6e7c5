"""Retrieval: distances equal brute force, votes nearly so; squares and circles of stations."""

from functools import cached_property

import numpy as np
import pytest
from trackers import assert_usual, follow

from bench.accuracy.choices import TableVote
from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.station_index import StationIndex
from coview_stream.basemap.stations import StationGrid
from coview_stream.config import ConsensusConfig, DescriptorConfig
from coview_stream.errors import InputError
from coview_stream.geometry.transforms import Circle, pose_from, rot_z, transform, yaw_of
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.registration.clouds import LocalMaps
from coview_stream.localization.search import retrieval
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.hints import PlaceGuess, PoseHints
from coview_stream.localization.search.recognizers import SearchIndex
from coview_stream.localization.search.retrieval import CoViewVote, Retrieval, SearchStations, exact_distances
from coview_stream.localization.state import State
from coview_stream.stream.node.engine_queue import FrameJob
from coview_stream.stream.node.engines import TrackEngine

M, R, S = 40, 8, 12


class Stations:
    """Random descriptors with empty bins, empty columns and one empty station."""

    descriptor_config = DescriptorConfig(rings=R, sectors=S, channels=("scan_context", "coview"))

    def __init__(self):
        rng = np.random.default_rng(9)
        full = rng.uniform(0.5, 10, (2, M, R, S)) * (rng.random((2, M, R, S)) < 0.6)
        full[:, :, :, 4] *= rng.random((2, M, 1)) < 0.5
        full[:, 7] = 0.0
        self.full = dict(zip(("scan_context", "coview"), full.astype(np.float16), strict=True))

    def __len__(self):
        return M

    def descriptors(self, name):
        return self.full[name]

    @cached_property
    def station_index(self):
        return StationIndex.of(self.full)

    @cached_property
    def station_grid(self):
        places = np.column_stack([2.0 * np.arange(len(self)) + 1.0, np.ones(len(self)), np.zeros(len(self))])
        return StationGrid(places.astype(np.float32), 2.0)


@pytest.fixture(scope="module")
def stations():
    return Stations()


@pytest.fixture(scope="module")
def query():
    rng = np.random.default_rng(10)
    q = (rng.uniform(0.5, 10, (2, R, S)) * (rng.random((2, R, S)) < 0.6)).astype(np.float32)
    q[:, :, 9] = 0.0
    return dict(zip(("scan_context", "coview"), q, strict=True))


def brute(q, c):
    """Eqs 7-9 to the letter; a column that is empty on either side costs 1."""
    volume = np.zeros((len(c), S))
    for m in range(len(c)):
        for n in range(S):
            total = 0.0
            for j in range(S):
                a, b = q[:, (j + n) % S].astype(float), c[m, :, j].astype(float)
                size = np.linalg.norm(a) * np.linalg.norm(b)
                total += 1.0 if size == 0 else 1.0 - a @ b / size
            volume[m, n] = total / S
    return volume


def test_exhaustive_retrieval_equals_brute_force(stations, query):
    for name, descriptor in query.items():
        volume = exact_distances(stations.full[name], descriptor)
        assert volume.shape == (M, S)
        np.testing.assert_allclose(volume, brute(query[name], stations.full[name]), atol=2e-4)
        np.testing.assert_allclose(volume[7], 1.0, atol=1e-5)


def test_distances_are_the_same_in_blocks(stations, query):
    """Of 8192 stations each."""
    many = np.resize(stations.full["coview"], (8200, R, S))
    expected = exact_distances(stations.full["coview"], query["coview"])
    np.testing.assert_allclose(exact_distances(many, query["coview"]), np.resize(expected, (8200, S)), atol=1e-5)


def test_vote_is_that_of_the_exact_distances(stations, query):
    vote = CoViewVote(np.zeros(3), Retrieval(stations).compared().index, query)
    exact = TableVote.of_distances(np.zeros(3), [exact_distances(stations.full[name], query[name]) for name in query])
    station, shift = (each.ravel() for each in np.indices((M, S)))
    values, expected = vote.at(station, shift), exact.at(station, shift)
    assert np.abs(values - expected).max() < 1.0
    assert np.corrcoef(values, expected)[0, 1] > 0.98
    np.testing.assert_array_equal(vote.at(np.full(3, -1), np.arange(3)), 0.0)
    assert vote.sectors == S


def test_candidates_are_the_best_headings_of_the_best_stations(stations, query):
    vote = CoViewVote(np.zeros(3), Retrieval(stations).compared().index, query)
    station, shift = vote.candidates()
    scores = stations.station_index.all_shifts(stations.station_index.query(query), np.arange(M))
    assert len(set(zip(station.tolist(), shift.tolist(), strict=True))) == len(station)
    best = scores[station, shift]
    assert (np.diff(best) >= 0).all()
    assert (best <= scores[station, (shift + 1) % S]).all()
    assert (best < scores[station, shift - 1]).all()
    assert best[0] == scores.min()


@pytest.fixture
def few_are_many(monkeypatch):
    monkeypatch.setattr(retrieval, "_ORDINARY", 20)


def test_ordinary_maps_and_blocks_of_a_square_s_size_are_compared_whole(world_map, request):
    compared = SearchStations.of(world_map.station_index, world_map.station_grid)
    assert compared.index is world_map.station_index
    assert compared.grid is world_map.station_grid
    request.getfixturevalue("few_are_many")
    grid = StationGrid(world_map.stations, 6.0)
    assert SearchStations.of(world_map.station_index, grid).squares is None


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


@pytest.fixture(scope="module")
def twice(map_points):
    """The small world twice, the second time turned by a quarter and without its southern border."""
    turned = (map_points @ rot_z(0.5 * np.pi).T)[map_points[:, 0] > -14.0] + np.array([192.0, 0.0, 0.0])
    return BaseMap.build(np.concatenate([map_points, turned]).astype(np.float32), radius=30.0)


@pytest.mark.parametrize("whole", [True, False], ids=["all stations", "squares"])
def test_place_has_its_copy_among_those_that_look_like_it(twice, whole, request):
    if not whole:
        request.getfixturevalue("few_are_many")
    compared, origin = SearchStations.of(twice.station_index, twice.station_grid), np.asarray(twice.origin)
    assert (compared.squares is None) == whole
    to_copy = pose_from(rot_z(0.5 * np.pi), [192.0, 0.0, 0.0])
    for x, y in ((3.0, 5.0), (-8.0, 12.0), (6.5, -9.5)):
        alike = compared.alike(np.array([x, y, 0.0]) - origin, ConsensusConfig())
        there = transform(to_copy, np.array([[x, y, 0.0]]))[0] - origin
        off = [np.linalg.norm((transform(T, np.array([[x, y, 0.0]]) - origin)[0] - there)[:2]) for T in alike]
        assert min(off) < 2.5
        assert yaw_of(alike[np.argmin(off)]) == pytest.approx(0.5 * np.pi, abs=0.06)


def test_storeys_have_squares_of_their_own(few_are_many, world_map):
    ground = world_map.stations[:80]
    above = ground + np.array([0, 0, 6], dtype=np.float32)
    for lower, upper in ((ground, above[::2]), (ground[::2], above), (ground[::3], above[1::2])):
        grid = StationGrid(np.concatenate([lower, upper]), world_map.config.block)
        compared = SearchStations.of(world_map.station_index.subset(np.arange(len(grid)) % 80), grid)
        members = compared.squares.members
        heights = np.where(members < 0, np.nan, grid.stations[members, 2])
        assert np.nanmax(np.nanmax(heights, axis=1) - np.nanmin(heights, axis=1)) < 3.0
        np.testing.assert_array_equal(np.sort(members[members >= 0]), np.arange(len(grid)))
        # each of them is found at its height by the one that stands for it
        values = compared.grid.at(grid.stations)
        assert (values >= 0).all()
        assert (np.abs(compared.grid.stations[values, 2] - grid.stations[:, 2]) < 3.0).all()


@pytest.mark.parametrize("many", [False, True])
def test_circle_has_the_scores_of_the_map(world_map, request, many):
    if many:
        request.getfixturevalue("few_are_many")
    index, grid = world_map.station_index, world_map.station_grid
    chosen = np.flatnonzero(Circle(*world_map.stations[40, :2].tolist(), 12.0).holds(world_map.stations))
    compared = SearchStations.of(index, grid, chosen)
    assert set(compared.numbers.tolist()) <= set(chosen.tolist())
    query = {name: world_map.descriptors(name)[40].astype(np.float32) for name in world_map.descriptor_config.channels}
    asked, whole = compared.index.query(query), index.query(query)
    every = np.arange(len(compared))
    values, expected = compared.index.all_shifts(asked, every), index.all_shifts(whole, compared.numbers)
    np.testing.assert_allclose(values, expected, atol=1e-4)
    if not many:
        single = compared.index.at(asked, every, np.zeros(len(every)))
        np.testing.assert_allclose(single, index.at(whole, compared.numbers, np.zeros(len(every))), atol=1e-4)


@pytest.mark.slow
def test_robot_is_found_by_squares_as_by_all_stations(few_are_many, world_map, world_drive, world_fixes):
    assert_usual(follow(Localizer(world_map), world_drive, 6), world_fixes, 0.1)


@pytest.mark.slow
def test_robot_is_found_within_a_circle_and_not_beside_it(world_map, world_drive, world_fixes):
    def guided(x, y):
        localizer = Localizer(world_map)
        localizer.guess_place(PlaceGuess(x, y, within=50.0))
        return follow(localizer, world_drive, 6)

    x, y = next(fix for fix in world_fixes if fix.T_map_body is not None).T_map_body[:2, 3].tolist()
    here = guided(x + 15.0, y - 12.0)
    assert any(fix.T_map_body is not None for fix in here)
    for fix, plain in zip(here, world_fixes, strict=False):
        if fix.T_map_body is not None and plain.T_map_body is not None:
            np.testing.assert_allclose(fix.T_map_body[:3, 3], plain.T_map_body[:3, 3], atol=0.1)
    away = world_map.stations[np.linalg.norm(world_map.stations[:, :2] - (x, y), axis=1).argmax()] + world_map.origin
    away[:2] += 45.0 * (away[:2] - (x, y)) / np.linalg.norm(away[:2] - (x, y))
    assert all(fix.T_map_body is None for fix in guided(*away[:2].tolist()))


def test_localizer_that_does_not_search_chooses_no_stations(world_map, world_drive):
    """As the tracking engine's: the search is in another process."""
    localizer = Localizer(world_map, index=SearchIndex(object(), None))
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
    localizer, guess = Localizer(world_map), PlaceGuess(9000.0, 9000.0, within=60.0)
    for beside, metres in ((guess, 60), (PlaceGuess(9000.0, 9000.0), 5)):
        with pytest.raises(InputError, match=f"no ground within {metres} m"):
            localizer.guess_place(beside)
    job = FrameJob("r1", 0, 0, world_drive.clouds[0], world_drive.T_odom_body[0], guess=guess)
    result = TrackEngine(world_map).run(job)
    assert result.request is None
    assert "no ground in the circle" in result.fix.evidence.reason
    assert result.fix.state is State.SEARCHING


@pytest.mark.slow
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
