"""Consensus: the places on which all keyframes agree beat the smallest single distance, also far from the origin."""

import numpy as np
import pytest

from bench.accuracy.choices import TableVote
from coview_stream.basemap.stations import StationGrid
from coview_stream.config import ConsensusConfig
from coview_stream.geometry.rasters import argsmallest
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, transform
from coview_stream.localization.search.consensus import Consensus, yaw_of_shift


def dense_scores(grid, votes):
    """Sum of z-scores (M, S) for the newest keyframe to stand at station m with shift n, per sqrt(keyframe).

    Args:
        grid: the stations' grid.
        votes: of each keyframe, oldest first, its centre (3,) and z-scores (M, S).
    """
    centre, newest = votes[-1]
    total = newest.astype(np.float64)
    for other, scores in votes[:-1]:
        step = other - centre
        for n, yaw in enumerate(yaw_of_shift(np.arange(total.shape[1]), total.shape[1])):
            turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
            there = grid.at(grid.stations + turn @ step)
            total[:, n] += np.where(there < 0, 0.0, scores[there, n])
    return total / np.sqrt(len(votes))


BLOCK, S, SIDE = 2.0, 12, 12
SHIFT = 2  # yaw of odometry in the map: -60 degrees
T_MAP_ODOM = pose_from(rot_z(-np.pi / 3), [0, 0, 0]) @ pose_from(np.eye(3), [-4000.0, 2500.0, -30.0])
CONFIG = ConsensusConfig(peaks=4)


def grid_stations(side=SIDE, z=0.0):
    axis = (np.arange(side) - 5 + 0.5) * BLOCK
    x, y = np.meshgrid(axis, axis, indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), np.full(side * side, z)]).astype(np.float32)


GRID = StationGrid(grid_stations(), BLOCK)


def station_at(stations, xy):
    return int(np.hypot(*(stations[:, :2] - np.asarray(xy)).T).argmin())


def centres(stations, visited):
    """Where keyframes at these stations are in the odometry frame."""
    return transform(inverse(T_MAP_ODOM), stations[visited].astype(np.float64))


def vote_of(centre, *volumes, count=4000):
    return TableVote(centre, TableVote.of_distances(centre, volumes).scores, count)


def volume(seed, station, wrong=None, M=SIDE * SIDE):
    noise = np.random.default_rng(seed).normal(0.6, 0.02, (M, S))
    noise[station, SHIFT] = 0.45
    if wrong is not None:
        noise[wrong] = 0.35  # the single smallest of all
    return noise.astype(np.float32)


@pytest.fixture
def voted():
    """Five keyframes along x whose own minima are all wrong, each elsewhere."""
    consensus = Consensus(GRID, CONFIG)
    visited = [station_at(GRID.stations, (-5 + 2 * k, 3)) for k in range(5)]
    volumes = [volume(k, station, wrong=(11 + 17 * k, 5 + k)) for k, station in enumerate(visited)]
    votes = [vote_of(*each) for each in zip(centres(GRID.stations, visited), volumes, strict=True)]
    for vote in votes:
        consensus.vote(vote)
    return consensus, visited, volumes, votes


def test_consensus_is_right_where_every_single_minimum_is_wrong(voted):
    consensus, visited, _, votes = voted
    best = consensus.hypotheses()[0]
    assert (best.station, best.shift) == (visited[-1], SHIFT)
    dense = dense_scores(GRID, [(vote.centre, vote.scores) for vote in votes])
    assert dense[visited[-1], SHIFT] == pytest.approx(best.votes, rel=1e-5)


def test_hypothesis_is_T_map_odom_for_any_odometry_origin(voted):
    """Eqs 9 and 12, mended: the yaw turns about the keyframe, not about the odometry's origin."""
    np.testing.assert_allclose(yaw_of_shift(np.array([0, 1, 2, 3]), 12), [0.0, -np.pi / 6, -np.pi / 3, -np.pi / 2])
    consensus = voted[0]
    np.testing.assert_allclose(consensus.hypotheses()[0].T_map_odom, T_MAP_ODOM, atol=1e-3)


def test_sparse_scores_are_the_dense_sum_on_a_ragged_site():
    rng = np.random.default_rng(5)
    grid = StationGrid(grid_stations(9)[rng.permutation(81)[:60]], BLOCK)
    consensus = Consensus(grid, ConsensusConfig(window=4, peaks=10_000, distinct_distance=0.1, distinct_yaw=0.1))
    votes = []
    for _ in range(7):
        step = rng.integers(-3, 4, 2) * BLOCK  # whole cells, where rounding is the same for both
        vote = TableVote(np.array([*step, 0.0]), rng.normal(size=(60, 4)).astype(np.float32))
        votes.append((vote.centre, vote.scores))
        consensus.vote(vote)
        dense = dense_scores(grid, votes[-4:])
        hypotheses = consensus.hypotheses()
        assert len(hypotheses) == 60 * 4
        np.testing.assert_allclose(
            [h.votes for h in hypotheses], [dense[h.station, h.shift] for h in hypotheses], atol=1e-5
        )
        assert [h.votes for h in hypotheses] == sorted(h.votes for h in hypotheses)


def test_places_that_one_keyframe_names_are_scored_by_all():
    """The newest keyframe names three places, none of them right: what older ones named is known."""
    visited = [station_at(GRID.stations, (-5 + 2 * k, 3)) for k in range(5)]
    consensus = Consensus(GRID, CONFIG)
    for k, (station, centre) in enumerate(zip(visited, centres(GRID.stations, visited), strict=True)):
        asked = volume(k, station)
        if k == 4:
            asked[station, SHIFT] = 0.58
        consensus.vote(vote_of(centre, asked, count=3))
    best = consensus.hypotheses()[0]
    assert (best.station, best.shift) == (visited[-1], SHIFT)


def test_hypotheses_follow_the_height_of_the_stations():
    hill = grid_stations()
    hill[:, 2] = 0.1 * hill[:, 0]
    consensus = Consensus(StationGrid(hill, BLOCK), CONFIG)
    visited = [station_at(hill, (-5 + 2 * k, 3)) for k in range(5)]
    for k, (station, centre) in enumerate(zip(visited, centres(hill, visited), strict=True)):
        consensus.vote(vote_of(np.array([*centre[:2], 0.0]), volume(k, station)))  # an odometry that feels no slope
    best = consensus.hypotheses()[0]
    assert transform(best.T_map_odom, np.array([*centre[:2], 0.0])[None])[0, 2] == pytest.approx(hill[visited[-1], 2])


@pytest.mark.parametrize("count", [1, 7, 4000, 9999, 10_000, 20_000])
@pytest.mark.parametrize("kind", ["normal", "ties", "few", "rising"])
def test_argsmallest_equals_stable_sort(kind, count):
    rng = np.random.default_rng(6)
    values = {
        "normal": rng.normal(size=10_000),
        "ties": rng.integers(0, 5, 10_000),
        "few": np.where(np.arange(10_000) % 100, 1.0, 2.0),  # the sample sees only what is large
        "rising": np.arange(10_000),
    }[kind].astype(np.float32)
    np.testing.assert_array_equal(argsmallest(values, count), np.argsort(values, kind="stable")[:count])


def test_peaks_are_distinct_in_place_or_heading():
    consensus = Consensus(GRID, ConsensusConfig(peaks=3, distinct_distance=5.0, distinct_yaw=1.0))
    one, beside, far = (station_at(GRID.stations, xy) for xy in ((-7, -7), (-5, -7), (9, 9)))
    votes = np.random.default_rng(0).normal(0.6, 0.01, (len(GRID), S)).astype(np.float32)
    votes[one, 3], votes[beside, 3], votes[one, 4] = 0.30, 0.31, 0.32  # one hypothesis, seen thrice
    votes[one, 9], votes[far, 0], votes[far, S - 1] = 0.35, 0.40, 0.41  # headings are compared around the circle
    consensus.vote(vote_of(np.zeros(3), votes))
    hypotheses = consensus.hypotheses()
    assert [(h.station, h.shift) for h in hypotheses] == [(one, 3), (one, 9), (far, 0)]
    assert [h.votes for h in hypotheses] == sorted(h.votes for h in hypotheses)


def test_consensus_window_is_bounded_and_clear_empties_it(voted):
    consensus, visited, _, _ = voted
    assert len(consensus) == 5
    for k in range(20):
        consensus.vote(vote_of(np.zeros(3), volume(k, visited[0])))
    assert len(consensus) == CONFIG.window
    consensus.clear()
    assert len(consensus) == 0
    assert consensus.hypotheses() == []
