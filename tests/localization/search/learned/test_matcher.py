"""Learned re-localization with planted features: the right place and heading win with any weights."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from planted_features import LOW, SECTORS, TILES, Planted
from scipy import ndimage

from coview_stream.basemap.station_grid import StationGrid
from coview_stream.config import ConsensusConfig, LearnedConfig
from coview_stream.descriptors.feature_build import feature_arrays
from coview_stream.descriptors.feature_map import TILE, FeatureMap
from coview_stream.descriptors.network import Features
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, transform, wrap_angle, yaw_of
from coview_stream.localization.search.consensus import Consensus, Hypothesis
from coview_stream.localization.search.learned.matcher import FeatureMatcher, principal_axes
from coview_stream.localization.search.votes import TableVote


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


@pytest.mark.parametrize(("xy", "shift"), PLACES)
def test_true_station_and_shift_score_best(planted, known, stations, xy, shift):
    yaw = -2 * np.pi * shift / SECTORS
    distances = known.distances(planted.seen(xy, yaw, np.array([4.0, -7.0, 1.0])))
    assert distances.shape == (len(stations), SECTORS)
    station, found = np.unravel_index(distances.argmin(), distances.shape)
    np.testing.assert_allclose(stations[station, :2], xy)
    assert found == shift


def test_uncompared_stations_get_the_median_distance(planted, known):
    distances = known.distances(planted.seen((21.0, 33.0), 0.4, np.zeros(3)))
    assert (distances[-1] == 1.0).all()  # the station off the map
    assert np.median(distances[:-1][distances[:-1] != 1.0]) == pytest.approx(1.0, abs=0.01)


def test_votes_of_keyframes_add_up_at_the_newest(planted, known, stations):
    """Each alone is hardly to be told from noise; odometry lays them on each other."""
    yaw, start = -2 * np.pi * 11 / SECTORS, np.array([-21.0, 41.0])
    T = pose_from(rot_z(yaw), [*start, 0.0])
    consensus = Consensus(StationGrid(stations[:-1], 2.0), ConsensusConfig())
    for k in range(5):
        centre = np.array([4.0 * k, 1.0 * k, 0.0])
        there = transform(T, centre[None])[0]
        view = planted.seen(there[:2], yaw, centre, noise=3.0, seed=k)
        consensus.vote(TableVote.of_distances(centre, [known.distances(view)[:-1]]))
    best = consensus.hypotheses()[0]
    assert np.linalg.norm(transform(best.T_map_odom, centre[None])[0] - there)[None] < 2.0
    assert abs(wrap_angle(yaw_of(best.T_map_odom) - yaw)) < np.radians(6)


def test_large_maps_are_searched_around_place_matches(planted, stations):
    config = LearnedConfig(dense_area=1000.0, shortlist=1)
    known = FeatureMatcher(planted.features, stations, config)
    assert not known.dense
    assert FeatureMatcher(planted.features, stations, LearnedConfig()).dense
    distances = known.distances(planted.seen((-77.0, -43.0), 0.0, np.zeros(3)))
    searched = (distances != 1.0).any(axis=1)
    assert 0.05 < searched.mean() < 0.8
    assert np.hypot(*(stations[distances.min(axis=1).argmin(), :2] - (-77.0, -43.0))) < 2.0
    far = distances[np.hypot(*(stations[:, :2] - (80.0, 110.0)).T) < 10.0]
    assert (far == 1.0).all()


def test_large_maps_are_searched_around_pose_hints(planted, stations):
    known = FeatureMatcher(planted.features, stations, LearnedConfig(dense_area=1000.0, shortlist=1))
    view = planted.seen((-77.0, -43.0), 0.0, np.zeros(3))
    near = np.hypot(*(stations[:, :2] - (50.0, 70.0)).T) < 10.0
    assert (known.distances(view)[near] == 1.0).all()
    assert (known.distances(view, [[50.0, 70.0]])[near] != 1.0).any(axis=1).all()


def test_only_small_maps_are_prepared_for_full_search(planted, stations):
    large = FeatureMatcher(planted.features, stations, LearnedConfig(dense_area=1000.0))
    small = FeatureMatcher(planted.features, stations, LearnedConfig())
    for known, prepared in ((large, {"index"}), (small, {"index", "_feature_blocks"})):
        known.prepare()
        assert {"index", "_feature_blocks"} & set(vars(known)) == prepared


def at(xy, yaw, centre, z=0.0):
    """``T_map_odom`` of a robot at ``centre`` in its odometry."""
    return pose_from(rot_z(yaw), [*xy, z]) @ pose_from(np.eye(3), -centre)


def test_keypoints_refine_a_hypothesis(planted, known):
    xy, yaw, centre = np.array([13.4, 27.8]), 0.83, np.array([40.0, -3.0, 1.5])
    view = planted.seen(xy, yaw, centre, noise=0.2)
    rough = Hypothesis(at(xy + np.array([1.5, -2.0]), yaw + np.radians(5), centre, 2.5), 17, 4, -3.0, learned=True)
    (exact,) = known.refine([rough], view)
    there = transform(exact.T_map_odom, centre[None])[0]
    assert np.hypot(*(there[:2] - xy)) < 0.4
    assert there[2] == pytest.approx(0.02 * 13.0)  # the nearest station's: keypoints know no heights
    assert abs(wrap_angle(yaw_of(exact.T_map_odom) - yaw)) < np.radians(1.0)
    assert exact.exact
    same = replace(exact, T_map_odom=rough.T_map_odom, exact=False)
    assert all(getattr(same, f.name) is getattr(rough, f.name) for f in fields(same))  # all else is as it was


def test_disagreeing_keypoints_leave_hypothesis_unchanged(planted, known):
    view = planted.seen((13.4, 27.8), 0.83, np.zeros(3))
    wrong = Hypothesis(at((-50.0, 80.0), 2.0, np.zeros(3)), 17, 4, -3.0, learned=True)
    beyond = Hypothesis(at((950.0, 80.0), 2.0, np.zeros(3)), 17, 4, -3.0, learned=True)
    assert [id(each) for each in known.refine([wrong, beyond], view)] == [id(wrong), id(beyond)]


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
    """Drawing, features, correlation, stations and keypoints mean the same by x, y and heading."""
    monkeypatch.setattr("coview_stream.descriptors.feature_build.network", lambda *_: pointwise)
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
    consensus.vote(TableVote.of_distances(centre, [known.distances(view)]))
    metres, turn = errors(consensus.hypotheses()[0])
    assert metres < 2.0
    assert turn < 8.0
    if degrees % 90 == 0:  # then cells lie on cells, and such simple descriptors are alike enough
        rough = Hypothesis(at(place[:2] + np.array([1.5, -1.0]), yaw + np.radians(6), centre), 3, 4, -3.0)
        metres, turn = errors(*known.refine([rough], view))
        assert metres < 0.2
        assert turn < 0.5


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
    axes = principal_axes(vectors, 0.999)
    assert axes.shape == (4, 32)
    np.testing.assert_allclose(axes @ axes.T, np.eye(4), atol=1e-5)
    query = rng.normal(size=32).astype(np.float32)
    np.testing.assert_allclose((axes @ query) @ (axes @ vectors), query @ vectors, atol=0.1)
