"""Learned re-localization with planted features: the right place and heading win with any weights."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

from bench.accuracy.choices import TableVote
from coview_stream.basemap.stations import StationGrid
from coview_stream.config import ConsensusConfig, LearnedConfig, LocalizerConfig
from coview_stream.descriptors.feature_map import (
    TILE,
    FeatureMap,
    feature_arrays,
    quantized,
    quantized_sigma,
    weights_sha256,
)
from coview_stream.descriptors.network import Features
from coview_stream.geometry.transforms import Circle, inverse, pose_from, rot_z, transform, wrap_angle, yaw_of
from coview_stream.localization.search.consensus import Consensus
from coview_stream.localization.search.learned.matcher import YAWS, FeatureMatcher, LearnedRecognizer, QueryFeatures
from coview_stream.localization.search.learned.rasters import principal_axes
from coview_stream.localization.search.request import SearchRequest

CHANNELS = 16
TILES = 6  # along an edge: 192 m
LOW = np.array([-3, -2])  # tile at the lower corner
SECTORS = 36


def field(seed, shape, smooth):
    """Unit vectors (C, H, W) that change over ``smooth`` cells."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(CHANNELS, *shape)).astype(np.float32)
    values = ndimage.gaussian_filter(values, (0, smooth, smooth))
    return values / np.linalg.norm(values, axis=0)


def in_tiles(values):
    """(H, W, ...) as tiles, row by row."""
    size, *rest = values.shape[0] // TILE, *values.shape[2:]
    blocks = values.reshape(size, TILE, size, TILE, *rest).swapaxes(1, 2)
    return blocks.reshape(size * size, TILE, TILE, *rest)


class Planted:
    """A map of random features, and what a perfect ground network would see anywhere in it."""

    def __init__(self, seed=1):
        size = TILES * TILE
        self.local = field(seed, (size, size), 2.5)
        rng = np.random.default_rng(seed)
        self.marks = rng.uniform(0, size, (1200, 2))  # keypoints: x and y in cells
        self.sigma = np.full((size, size), 3.0, dtype=np.float32)
        column, row = self.marks.astype(int).T
        self.sigma[row, column] = rng.uniform(0.2, 0.4, len(self.marks)).astype(np.float32)
        row, column = np.divmod(np.arange(TILES**2), TILES)
        tiles = (np.column_stack([column, row]) + LOW).astype(np.int32)
        at = (np.stack(np.meshgrid(np.arange(size // 8), np.arange(size // 8)), -1).reshape(-1, 2) + 0.5) * 8
        place = rng.normal(size=(len(at), 24)).astype(np.float32)
        self.place = place / np.linalg.norm(place, axis=1, keepdims=True)
        self.place_at = at + LOW * TILE
        arrays = {
            "learned.local": in_tiles(quantized(self.local.transpose(1, 2, 0))),
            "learned.sigma": in_tiles(quantized_sigma(self.sigma)),
            "learned.tiles": tiles,
            "learned.place": quantized(self.place),
            "learned.place_at": self.place_at.astype(np.float32),
        }
        self.features = FeatureMap(arrays, {"weights": weights_sha256(), "cell": 1.0})

    def seen(self, xy, yaw, centre, noise=0.5, seed=0):
        """What the network makes of a robot at ``xy`` whose odometry frame is turned by ``yaw`` in the map."""
        axis = np.arange(64) + 0.5 - 32.0
        u, v = np.meshgrid(axis, axis)
        c, s = np.cos(yaw), np.sin(yaw)
        at = np.stack([c * u - s * v + xy[0], s * u + c * v + xy[1]]) - (LOW * TILE)[:, None, None]
        where = at[::-1] - 0.5
        local = np.stack([ndimage.map_coordinates(k, where, order=1, mode="nearest") for k in self.local])
        local += noise * field(100 + seed, (64, 64), 1.0)
        local /= np.linalg.norm(local, axis=0)
        sigma = np.full((64, 64), 3.0, dtype=np.float32)
        there = self.marks + LOW * TILE - xy
        mine = np.column_stack([c * there[:, 0] + s * there[:, 1], -s * there[:, 0] + c * there[:, 1]]) + 32.0
        near = ((mine > 0) & (mine < 64)).all(axis=1)
        column, row = mine[near].astype(int).T
        sigma[row, column] = 0.3
        nearest = np.hypot(*(self.place_at - xy).T).argmin()
        place = np.repeat(self.place[nearest][:, None], 256, axis=1).reshape(-1, 16, 16)
        inside = np.hypot(u, v) <= 30.0
        weight = np.where(inside, 1.0 / sigma, 0.0).astype(np.float32)
        return QueryFeatures(Features(local.astype(np.float32), sigma, place.astype(np.float32)), weight, centre)


@pytest.fixture(scope="module")
def planted():
    return Planted()


@pytest.fixture(scope="module")
def stations():
    """A station at every 2 m of the map, and one that is off it."""
    axis = np.arange(1.0, TILES * TILE, 2.0)
    xy = np.stack(np.meshgrid(axis + LOW[0] * TILE, axis + LOW[1] * TILE), axis=-1).reshape(-1, 2)
    ground = 0.02 * xy[:, :1]
    return np.vstack([np.hstack([xy, ground]), [[901.0, 5.0, 0.0]]]).astype(np.float32)


@pytest.fixture(scope="module")
def known(planted, stations):
    return FeatureMatcher(planted.features, stations, LearnedConfig())


PLACES = [((21.0, 33.0), 0), ((-41.0, 75.0), 7), ((61.0, -15.0), 30)]


def scores_of(vote, stations):
    """z-scores (M, S) of all stations at all shifts."""
    station, shift = np.divmod(np.arange(len(stations) * SECTORS), SECTORS)
    return vote.at(station, shift).reshape(-1, SECTORS)


@pytest.mark.parametrize(("xy", "shift"), PLACES)
def test_true_station_and_shift_score_best(planted, known, stations, xy, shift):
    yaw = -2 * np.pi * shift / SECTORS
    vote = known.vote(planted.seen(xy, yaw, np.array([4.0, -7.0, 1.0])))
    scores = scores_of(vote, stations)
    station, result = np.unravel_index(scores.argmin(), scores.shape)
    np.testing.assert_allclose(stations[station, :2], xy)
    assert result == shift
    named, shifts = vote.candidates()
    assert (named[0], shifts[0]) == (station, shift)
    assert len(named) >= 64
    assert len(set(zip(named.tolist(), shifts.tolist(), strict=True))) == len(named)
    assert (np.diff(vote.at(named, shifts)) >= 0).all()  # best first


def test_votes_are_standard_scores_and_nothing_where_nothing_is_compared(planted, known, stations):
    vote = known.vote(planted.seen((21.0, 33.0), 0.4, np.zeros(3)))
    scores = scores_of(vote, stations)
    assert (scores[-1] == 0.0).all()  # the station off the map
    assert (vote.at(np.array([-1, -1]), np.array([0, 5])) == 0.0).all()
    compared = scores[:-1][scores[:-1] != 0.0]
    assert np.median(compared) == pytest.approx(0.0, abs=0.1)
    assert np.median(np.abs(compared)) * 1.4826 == pytest.approx(1.0, abs=0.1)


def test_query_beyond_the_edge_scores_by_what_is_surveyed(planted, known, stations):
    """At the edge a third of the query lies off the map; at the corner more than is allowed."""
    edge, corner = (np.array([-95.0, 33.0]), np.array([-95.0, -63.0]))
    for xy, compared in ((edge, False), (np.array([-85.0, 33.0]), True), (corner, False)):
        vote = known.vote(planted.seen(xy, 0.0, np.zeros(3), noise=0.1))
        station = int(np.hypot(*(stations[:, :2] - xy).T).argmin())
        assert (vote.at(np.array([station]), np.array([0]))[0] < -4.0) == compared


def test_votes_of_keyframes_add_up_at_the_newest(planted, known, stations):
    """Each alone is hardly to be told from noise; odometry lays them on each other."""
    yaw, start = -2 * np.pi * 11 / SECTORS, np.array([-21.0, 41.0])
    T = pose_from(rot_z(yaw), [*start, 0.0])
    consensus = Consensus(StationGrid(stations[:-1], 2.0), ConsensusConfig())
    for k in range(5):
        centre = np.array([4.0 * k, 1.0 * k, 0.0])
        there = transform(T, centre[None])[0]
        consensus.vote(known.vote(planted.seen(there[:2], yaw, centre, noise=3.0, seed=k)))
    best = consensus.hypotheses()[0]
    assert np.linalg.norm(transform(best.T_map_odom, centre[None])[0] - there)[None] < 2.0
    assert abs(wrap_angle(yaw_of(best.T_map_odom) - yaw)) < np.radians(6)


def test_large_maps_are_searched_around_place_matches_and_hints(planted, stations):
    known = FeatureMatcher(planted.features, stations, LearnedConfig(dense_area=1000.0, shortlist=1))
    assert not known.dense
    assert FeatureMatcher(planted.features, stations, LearnedConfig()).dense
    view, hint = planted.seen((-77.0, -43.0), 0.0, np.zeros(3)), (70.0, 90.0)
    for near, beyond in (((), False), ([hint], True)):
        vote = known.vote(view, near)
        named = stations[vote.candidates()[0], :2]
        assert np.hypot(*(named[0] - (-77.0, -43.0))) < 2.0
        assert (named > (32.0, 64.0)).all(axis=1).any() == beyond  # the block that the hint lies in
    there = int(np.hypot(*(stations[:, :2] - hint).T).argmin())
    assert vote.at(np.array([there]), np.array([3]))[0] != 0.0  # what other keyframes name is looked at anywhere


@pytest.mark.parametrize("dense_area", [1000.0, 2e6])
def test_candidates_lie_within_the_area_that_is_searched(planted, stations, dense_area):
    known = FeatureMatcher(planted.features, stations, LearnedConfig(dense_area=dense_area))
    view = planted.seen((-77.0, -43.0), 0.0, np.zeros(3))
    for area in (Circle(-60.0, -40.0, 40.0), Circle(60.0, 60.0, 50.0)):
        vote = known.vote(view, (), area)
        named = vote.candidates()[0]
        assert len(named)
        assert area.holds(stations[named]).all()
        assert (np.hypot(*(stations[named[0], :2] - (-77.0, -43.0))) < 2.0) == (area.x < 0.0)


def at(xy, yaw, centre, z=0.0):
    """``T_map_odom`` of a robot at ``centre`` in its odometry."""
    return pose_from(rot_z(yaw), [*xy, z]) @ pose_from(np.eye(3), -centre)


def pointwise(image):
    """Stands in for both networks: descriptors are what is seen around a cell, the same at every heading."""
    height, width = (n // 2 for n in image.shape[1:])
    shown = image.reshape(len(image), height, 2, width, 2).mean(axis=(2, 4), dtype=np.float32)
    local = ndimage.gaussian_filter(shown, (0, 1.0, 1.0)) - 30.0
    local /= np.linalg.norm(local, axis=0)
    edges = ndimage.gaussian_laplace(shown[-3], 1.0)
    sigma = (0.2 + 2.0 * np.exp(-np.abs(edges) / 5.0)).astype(np.float32)
    return Features(local, sigma, np.ones((8, height // 4, width // 4), dtype=np.float32))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("xy", "degrees"), [((5.6, -8.8), 100.0), ((5.6, -8.8), -57.0), ((6.0, -9.0), 90.0), ((6.0, -9.0), 0.0)]
)
def test_clouds_to_pose_end_to_end(map_points, monkeypatch, xy, degrees):
    """Drawing, features, correlation and stations mean the same by x, y and heading."""
    monkeypatch.setattr("coview_stream.descriptors.feature_map.network", lambda *_: pointwise)
    cloud, place, yaw = map_points.astype(np.float32), np.array([*xy, 0.0]), np.radians(degrees)
    axis = np.arange(-31.0, 32.0, 2.0)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    stations = np.column_stack([grid, np.zeros(len(grid))]).astype(np.float32)
    known = FeatureMatcher(FeatureMap(*feature_arrays(cloud)), stations, LearnedConfig())
    known.network = pointwise
    centre = np.array([50.0, -8.0, 3.0])
    near = cloud[np.hypot(*(cloud[:, :2] - place[:2]).T) < 29.0]
    view = known.encode(transform(inverse(at(xy, yaw, centre)), near).astype(np.float32), centre)

    def errors(hypothesis):
        gap = transform(hypothesis.T_map_odom, centre[None])[0] - place
        return np.hypot(*gap[:2]), np.degrees(abs(wrap_angle(yaw_of(hypothesis.T_map_odom) - yaw)))

    consensus = Consensus(StationGrid(stations, 2.0), ConsensusConfig())
    consensus.vote(known.vote(view))
    metres, turn = errors(consensus.hypotheses()[0])
    assert metres < 2.0
    assert turn < 8.0


def test_query_features_of_a_cloud(known):
    """By the network of the package, with any weights: shapes, norms, and where it counts."""
    rng = np.random.default_rng(0)
    cloud = rng.uniform([-23, -28, 0], [37, 32, 5], (20_000, 3)).astype(np.float32)
    view = known.encode(cloud, np.array([7.0, 2.0, 0.0]))
    assert view.features.local.shape[1:] == view.weight.shape == (64, 64)
    assert np.linalg.norm(view.place) == pytest.approx(1.0, abs=1e-4)
    assert view.weight[32, 32] > 0
    assert view.weight[0, 0] == 0 == view.weight[32, 0]


def test_principal_axes_keep_inner_products_with_what_they_were_found_in():
    rng = np.random.default_rng(3)
    mixing = rng.normal(size=(32, 4)).astype(np.float32)
    vectors = mixing @ rng.normal(size=(4, 500)).astype(np.float32) + rng.normal(0, 1e-3, (32, 500)).astype(np.float32)
    axes = principal_axes(vectors, 0.999, 7)
    assert axes.shape == (4, 32)
    np.testing.assert_allclose(axes @ axes.T, np.eye(4), atol=1e-5)
    query = rng.normal(size=32).astype(np.float32)
    np.testing.assert_allclose((axes @ query) @ (axes @ vectors), query @ vectors, atol=0.1)
    assert principal_axes(vectors, 0.999, 3).shape == (3, 32)


@pytest.mark.parametrize("block", [0.5, 1.0, 2.0, 3.0, 4.0, 6.0])
@pytest.mark.parametrize("cell", [2.0, 4.0])
def test_station_has_the_cells_of_its_block(planted, block, cell):
    count = int(TILES * TILE / block)
    xy = np.stack(np.meshgrid(*[(np.arange(count) + 0.5) * block + low * TILE for low in LOW]), -1)
    places = np.column_stack([xy.reshape(-1, 2), np.zeros(count**2)]).astype(np.float32)
    cells = FeatureMatcher(planted.features, places, LearnedConfig(cell=cell), block=block).cells
    assert cells.shape == (int(TILES * TILE / cell),) * 2
    middles = (np.arange(int(TILES * TILE / cell)) + 0.5) * cell
    for k in np.random.default_rng(1).permutation(len(places))[:200]:
        low = places[k, :2] - LOW * TILE - 0.5 * block
        for axis, number in ((1, 0), (0, 1)):  # rows are along y
            inside = np.flatnonzero((middles >= low[axis]) & (middles < low[axis] + block))
            if not len(inside):  # a block smaller than cells
                inside = np.array([(low[axis] + 0.5 * block) // cell])
            assert cells.first[k, number] == inside[0]
            assert cells.size[k, number] == len(inside)


HERE, THERE, SHIFT = (5.0, -7.0), (-15.0, 11.0), 7


def named(heights, peaks=5):
    """What is named on a map with these storeys, of which features favour one place on all."""
    axis = np.arange(-19.0, 20.0, 2.0)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    stations = np.vstack([np.column_stack([xy, np.full(len(xy), z)]) for z in heights]).astype(np.float32)
    config = LocalizerConfig(learned=LearnedConfig(peaks=peaks))
    flat = np.random.default_rng(0).normal(1.0, 0.1, (len(xy), YAWS)).astype(np.float32)
    flat[(xy == HERE).all(axis=1), SHIFT] = -1.0
    flat[(xy == THERE).all(axis=1), SHIFT] = 0.2
    learned = SimpleNamespace(
        encode=lambda points, centre: SimpleNamespace(centre=centre),
        vote=lambda view, near, area: TableVote.of_distances(view.centre, [np.tile(flat, (len(heights), 1))]),
    )
    source = LearnedRecognizer(SimpleNamespace(station_grid=StationGrid(stations, 2.0)), config, learned)
    ground = np.random.default_rng(1).uniform(-20, 20, (3000, 3)).astype(np.float32) * (1, 1, 0)
    body = np.eye(4)
    body[2, 3] = 1.5
    none = np.empty((0, 3), np.float32)
    source.vote(SearchRequest(0.0, body, none, none, none, surroundings=ground.astype(np.float32)))
    return source.hypotheses(), stations


@pytest.mark.parametrize("gap", [3.0, 8.0])
def test_each_storey_is_a_hypothesis(gap):
    """At 3 m the consensus takes both for one place, at 8 m for two."""
    (single, *_), _ = named([0.0])
    result, stations = named([0.0, gap])
    at = [transform(each.T_map_odom, np.zeros((1, 3)))[0] for each in result]
    assert [tuple(xy) for xy in np.round(at, 3)[:2, :2].tolist()] == [HERE, HERE]
    assert sorted(round(z, 3) for _, _, z in at[:2]) == [0.0, gap]
    for each, place in zip(result[:4], at, strict=False):
        np.testing.assert_allclose(stations[each.station], place, atol=1e-5)
        assert each.shift == SHIFT
        assert each.learned
    assert [each.score for each in result[:2]] == pytest.approx([single.score] * 2, rel=0.01)
    assert len({(each.station, each.shift) for each in result}) == len(result)


def test_storey_hypotheses_are_bounded():
    assert len(named([0.0, 2.9, 5.8])[0]) == 10
    assert len(named([0.0])[0]) == 5
