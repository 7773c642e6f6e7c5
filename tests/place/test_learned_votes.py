"""Learned re-localization with planted features: the right place and heading win, whatever the weights are worth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from coview_stream.config import ConsensusConfig, LearnedConfig
from coview_stream.geometry import inverse, pose_from, rot_z, transform, wrap_angle, yaw_of
from coview_stream.place.consensus import Consensus, Hypothesis
from coview_stream.place.learned.feature_build import feature_arrays
from coview_stream.place.learned.feature_map import FeatureMap, weights_sha256
from coview_stream.place.learned.feature_tiles import TILE, packed, packed_sigma
from coview_stream.place.learned.network import Features
from coview_stream.place.learned.votes import LearnedMap, View

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
            "learned.local": in_tiles(packed(self.local.transpose(1, 2, 0))),
            "learned.sigma": in_tiles(packed_sigma(self.sigma)),
            "learned.tiles": tiles,
            "learned.place": packed(self.place),
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
        return View(Features(local.astype(np.float32), sigma, place.astype(np.float32)), weight, centre)


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
    return LearnedMap(planted.features, stations, LearnedConfig())


PLACES = [((21.0, 33.0), 0), ((-41.0, 75.0), 7), ((61.0, -15.0), 30)]


@pytest.mark.parametrize(("xy", "shift"), PLACES)
def test_the_right_station_and_shift_win(planted, known, stations, xy, shift):
    yaw = -2 * np.pi * shift / SECTORS
    distances = known.distances(planted.seen(xy, yaw, np.array([4.0, -7.0, 1.0])))
    assert distances.shape == (len(stations), SECTORS)
    station, found = np.unravel_index(distances.argmin(), distances.shape)
    np.testing.assert_allclose(stations[station, :2], xy)
    assert found == shift


def test_the_median_distance_is_that_of_what_was_not_compared(planted, known):
    distances = known.distances(planted.seen((21.0, 33.0), 0.4, np.zeros(3)))
    assert (distances[-1] == 1.0).all()  # the station off the map
    assert np.median(distances[:-1][distances[:-1] != 1.0]) == pytest.approx(1.0, abs=0.01)


def test_keyframes_votes_meet_at_the_newest(planted, known, stations):
    """Each alone is hardly to be told from noise; odometry lays them on each other."""
    yaw, start = -2 * np.pi * 11 / SECTORS, np.array([-21.0, 41.0])
    T = pose_from(rot_z(yaw), [*start, 0.0])
    consensus = Consensus(stations[:-1], 2.0, ConsensusConfig())
    for k in range(5):
        centre = np.array([4.0 * k, 1.0 * k, 0.0])
        there = transform(T, centre[None])[0]
        view = planted.seen(there[:2], yaw, centre, noise=3.0, seed=k)
        consensus.vote(centre, {"learned": known.distances(view)[:-1]})
    best = consensus.hypotheses()[0]
    assert np.linalg.norm(transform(best.T_map_odom, centre[None])[0] - there)[None] < 2.0
    assert abs(wrap_angle(yaw_of(best.T_map_odom) - yaw)) < np.radians(6)


def test_large_maps_are_searched_around_what_looks_alike(planted, stations):
    config = LearnedConfig(dense_area=1000.0, shortlist=1)
    known = LearnedMap(planted.features, stations, config)
    assert not known.dense
    assert LearnedMap(planted.features, stations, LearnedConfig()).dense
    distances = known.distances(planted.seen((-77.0, -43.0), 0.0, np.zeros(3)))
    searched = (distances != 1.0).any(axis=1)
    assert 0.05 < searched.mean() < 0.8
    assert np.hypot(*(stations[distances.min(axis=1).argmin(), :2] - (-77.0, -43.0))) < 2.0
    far = distances[np.hypot(*(stations[:, :2] - (80.0, 110.0)).T) < 10.0]
    assert (far == 1.0).all()


def test_they_are_searched_around_suggestions_too(planted, stations):
    known = LearnedMap(planted.features, stations, LearnedConfig(dense_area=1000.0, shortlist=1))
    view = planted.seen((-77.0, -43.0), 0.0, np.zeros(3))
    near = np.hypot(*(stations[:, :2] - (50.0, 70.0)).T) < 10.0
    assert (known.distances(view)[near] == 1.0).all()
    assert (known.distances(view, [[50.0, 70.0]])[near] != 1.0).any(axis=1).all()


def test_only_small_maps_are_prepared_to_be_searched_all_over(planted, stations):
    large = LearnedMap(planted.features, stations, LearnedConfig(dense_area=1000.0))
    small = LearnedMap(planted.features, stations, LearnedConfig())
    for known, prepared in ((large, {"coarse"}), (small, {"coarse", "_everywhere"})):
        known.prepare()
        assert {"coarse", "_everywhere"} & set(vars(known)) == prepared


@pytest.mark.parametrize("block", [0.5, 1.0, 2.0, 3.0, 4.0, 6.0])
@pytest.mark.parametrize("cell", [2.0, 4.0])
def test_a_station_has_the_best_score_of_its_block(planted, block, cell):
    count = int(TILES * TILE / block)
    xy = np.stack(np.meshgrid(*[(np.arange(count) + 0.5) * block + low * TILE for low in LOW]), -1)
    places = np.column_stack([xy.reshape(-1, 2), np.zeros(count**2)]).astype(np.float32)
    known = LearnedMap(planted.features, places, LearnedConfig(cell=cell), block=block)
    side = int(TILES * TILE / cell)
    scores = np.random.default_rng(0).normal(size=(3, side, side)).astype(np.float32)
    found = known._at_stations(scores)
    middles = (np.arange(side) + 0.5) * cell
    for k in np.random.default_rng(1).permutation(len(places))[:200]:
        low = places[k, :2] - LOW * TILE - 0.5 * block
        columns, rows = (np.flatnonzero((middles >= m) & (middles < m + block)) for m in low)
        if not len(rows) or not len(columns):  # a block smaller than cells
            x, y = ((low + 0.5 * block) // cell).astype(int)
            columns = columns if len(columns) else [x]
            rows = rows if len(rows) else [y]
        np.testing.assert_array_equal(found[k], scores[:, rows][:, :, columns].max(axis=(1, 2)))


def test_blocks_of_four_metres_find_a_place_anywhere_in_them(planted):
    axis = np.arange(2.0, TILES * TILE, 4.0)
    xy = np.stack(np.meshgrid(axis + LOW[0] * TILE, axis + LOW[1] * TILE), axis=-1).reshape(-1, 2)
    places = np.column_stack([xy, np.zeros(len(xy))]).astype(np.float32)
    known = LearnedMap(planted.features, places, LearnedConfig(), block=4.0)
    for place in ((21.0, 33.0), (23.0, 33.0), (21.0, 35.0), (23.0, 35.0)):
        distances = known.distances(planted.seen(place, 0.0, np.zeros(3)))
        np.testing.assert_allclose(places[distances.min(axis=1).argmin(), :2], (22.0, 34.0))


def test_a_place_that_keypoints_have_moved_stands_on_its_own_storey(planted):
    """Two storeys 3 m apart on a slope, the upper one with a hole; beyond, no stations at all."""
    axis = np.arange(-19.0, 20.0, 2.0)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    lower = np.column_stack([xy, 0.2 * xy[:, 0]])
    upper = lower[np.hypot(*xy.T) > 5.0] + (0.0, 0.0, 3.0)
    known = LearnedMap(planted.features, np.vstack([lower, upper]).astype(np.float32), LearnedConfig())

    def ground(xy, before):
        return known._ground(np.array(xy), np.array(before))

    assert ground((13.0, 9.0), (9.0, 9.0, 1.8)) == pytest.approx(2.6)
    assert ground((13.0, 9.0), (9.0, 9.0, 4.8)) == pytest.approx(5.6)
    assert ground((13.2, 9.4), (13.0, 9.0, 5.6)) == pytest.approx(5.6)
    assert ground((1.0, 1.0), (1.5, 1.0, 3.3)) == 3.3  # nothing there on this storey
    assert ground((60.0, 1.0), (56.0, 1.0, 7.0)) == 7.0


def at(xy, yaw, centre, z=0.0):
    """``T_map_odom`` of a robot at ``centre`` in its odometry."""
    return pose_from(rot_z(yaw), [*xy, z]) @ pose_from(np.eye(3), -centre)


def test_keypoints_make_a_hypothesis_exact(planted, known):
    xy, yaw, centre = np.array([13.4, 27.8]), 0.83, np.array([40.0, -3.0, 1.5])
    view = planted.seen(xy, yaw, centre, noise=0.2)
    rough = Hypothesis(
        at(xy + np.array([1.5, -2.0]), yaw + np.radians(5), centre, 2.5), 17, 4, -3.0, learned=True
    )
    (exact,) = known.sharpened([rough], view)
    there = transform(exact.T_map_odom, centre[None])[0]
    assert np.hypot(*(there[:2] - xy)) < 0.4
    assert there[2] == pytest.approx(0.02 * 13.0)  # the nearest station's: keypoints know no heights
    assert abs(wrap_angle(yaw_of(exact.T_map_odom) - yaw)) < np.radians(1.0)
    assert exact.exact
    assert replace(exact, T_map_odom=rough.T_map_odom, exact=False) == rough  # all else is as it was


def test_where_keypoints_do_not_agree_a_hypothesis_stays(planted, known):
    view = planted.seen((13.4, 27.8), 0.83, np.zeros(3))
    wrong = Hypothesis(at((-50.0, 80.0), 2.0, np.zeros(3)), 17, 4, -3.0, learned=True)
    beyond = Hypothesis(at((950.0, 80.0), 2.0, np.zeros(3)), 17, 4, -3.0, learned=True)
    assert known.sharpened([wrong, beyond], view) == [wrong, beyond]


def pointwise(image):
    """Stands in for both networks: descriptors are what is seen around a cell, the same at every heading."""
    height, width = (n // 2 for n in image.shape[1:])
    shown = image.reshape(len(image), height, 2, width, 2).mean(axis=(2, 4), dtype=np.float32)
    local = ndimage.gaussian_filter(shown, (0, 1.0, 1.0)) - 30.0
    local /= np.linalg.norm(local, axis=0)
    edges = ndimage.gaussian_laplace(shown[-3], 1.0)
    sigma = (0.2 + 2.0 * np.exp(-np.abs(edges) / 5.0)).astype(np.float32)
    return Features(local, sigma, np.ones((8, height // 4, width // 4), dtype=np.float32))


@pytest.mark.parametrize(
    ("xy", "degrees"), [((5.6, -8.8), 100.0), ((5.6, -8.8), -57.0), ((6.0, -9.0), 90.0), ((6.0, -9.0), 0.0)]
)
def test_from_clouds_to_a_pose(map_points, monkeypatch, xy, degrees):
    """Drawing, features, correlation, stations and keypoints mean the same by x, y and heading."""
    monkeypatch.setattr("coview_stream.place.learned.feature_build.network", lambda *_: pointwise)
    cloud, place, yaw = map_points.astype(np.float32), np.array([*xy, 0.0]), np.radians(degrees)
    axis = np.arange(-31.0, 32.0, 2.0)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    stations = np.column_stack([grid, np.zeros(len(grid))]).astype(np.float32)
    known = LearnedMap(FeatureMap(*feature_arrays(cloud)), stations, LearnedConfig())
    known.network = pointwise
    centre = np.array([50.0, -8.0, 3.0])
    near = cloud[np.hypot(*(cloud[:, :2] - place[:2]).T) < 29.0]
    view = known.view(transform(inverse(at(xy, yaw, centre)), near).astype(np.float32), centre)

    def errors(hypothesis):
        gap = transform(hypothesis.T_map_odom, centre[None])[0] - place
        return np.hypot(*gap[:2]), np.degrees(abs(wrap_angle(yaw_of(hypothesis.T_map_odom) - yaw)))

    consensus = Consensus(stations, 2.0, ConsensusConfig())
    consensus.vote(centre, {"learned": known.distances(view)})
    metres, turn = errors(consensus.hypotheses()[0])
    assert metres < 2.0
    assert turn < 8.0
    if degrees % 90 == 0:  # then cells lie on cells, and such simple descriptors are alike enough
        rough = Hypothesis(at(place[:2] + np.array([1.5, -1.0]), yaw + np.radians(6), centre), 3, 4, -3.0)
        metres, turn = errors(*known.sharpened([rough], view))
        assert metres < 0.2
        assert turn < 0.5


def test_a_cloud_becomes_a_view(known):
    """By the network of the package, whatever it is worth: shapes, norms, and where it counts."""
    rng = np.random.default_rng(0)
    cloud = rng.uniform([-23, -28, 0], [37, 32, 5], (20_000, 3)).astype(np.float32)
    view = known.view(cloud, np.array([7.0, 2.0, 0.0]))
    assert view.features.local.shape[1:] == view.weight.shape == (64, 64)
    assert np.linalg.norm(view.place) == pytest.approx(1.0, abs=1e-4)
    assert view.weight[32, 32] > 0
    assert view.weight[0, 0] == 0 == view.weight[32, 0]
