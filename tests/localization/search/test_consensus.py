"""Consensus: what all keyframes agree on beats the one smallest distance, also far from the origin."""

from __future__ import annotations

import numpy as np
import pytest

from coview_kernels import Nearest
from coview_stream.config import ConsensusConfig
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, transform
from coview_stream.localization.search.consensus import Consensus, StationGrid, argsmallest, robust_zscore, yaw_of_shift

BLOCK, S, SIDE = 2.0, 12, 12
SHIFT = 2  # yaw of odometry in the map: -60 degrees
T_MAP_ODOM = pose_from(rot_z(-np.pi / 3), [0, 0, 0]) @ pose_from(np.eye(3), [-4000.0, 2500.0, -30.0])
CONFIG = ConsensusConfig(peaks=4)


def grid_stations(side=SIDE, z=0.0):
    axis = (np.arange(side) - 5 + 0.5) * BLOCK
    x, y = np.meshgrid(axis, axis, indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), np.full(side * side, z)]).astype(np.float32)


def station_at(stations, xy):
    return int(np.hypot(*(stations[:, :2] - np.asarray(xy)).T).argmin())


def centres(stations, visited):
    """Where keyframes at these stations are in the odometry frame."""
    return transform(inverse(T_MAP_ODOM), stations[visited].astype(np.float64))


def volume(seed, station, wrong=None, M=SIDE * SIDE):
    noise = np.random.default_rng(seed).normal(0.6, 0.02, (M, S))
    noise[station, SHIFT] = 0.45
    if wrong is not None:
        noise[wrong] = 0.35  # the single smallest of all
    return {"scan_context": noise.astype(np.float32)}


def nearest_of(distances):
    station = distances.min(axis=1).argmin(keepdims=True)
    return Nearest(station, distances[station].argmin(axis=1), distances[station].min(axis=1))


@pytest.fixture
def voted():
    """Five keyframes along x whose own minima are all wrong, each elsewhere."""
    stations = grid_stations()
    consensus = Consensus(stations, BLOCK, CONFIG)
    visited = [station_at(stations, (-5 + 2 * k, 3)) for k in range(5)]
    for k, (station, centre) in enumerate(zip(visited, centres(stations, visited), strict=True)):
        consensus.vote(centre, volume(k, station, wrong=(11 + 17 * k, 5 + k)))
    return consensus, visited


def test_consensus_is_right_where_every_single_minimum_is_wrong(voted):
    consensus, visited = voted
    best = consensus.hypotheses()[0]
    assert (best.station, best.shift) == (visited[-1], SHIFT)
    assert consensus.scores()[visited[-1], SHIFT] == pytest.approx(best.score, rel=1e-3)


def test_single_minimum_mode_returns_the_wrong_minimum_there(voted):
    consensus, visited = voted
    single = Consensus(consensus.stations, BLOCK, ConsensusConfig(mode="single"))
    for k, (station, centre) in enumerate(zip(visited, centres(single.stations, visited), strict=True)):
        single.vote(centre, volume(k, station, wrong=(11 + 17 * k, 5 + k)))
    (only,) = single.hypotheses()
    assert (only.station, only.shift) in [(11 + 17 * k, 5 + k) for k in range(5)]


def test_single_minimum_mode_uses_nearest_stations_only(voted):
    consensus, visited = voted
    config = ConsensusConfig(mode="single")
    by_volume, by_nearest = (Consensus(consensus.stations, BLOCK, config) for _ in range(2))
    for k, (station, centre) in enumerate(zip(visited, centres(consensus.stations, visited), strict=True)):
        asked = volume(k, station, wrong=(11 + 17 * k, 5 + k))["scan_context"] + np.float32(0.01 * (k != 3))
        channels = {"coview": asked + np.float32(0.1), "scan_context": asked}
        by_volume.vote(centre, channels)
        by_nearest.vote_nearest(centre, {name: nearest_of(v) for name, v in channels.items()}, S)
    (expected,), (found,) = by_volume.hypotheses(), by_nearest.hypotheses()
    assert (found.station, found.shift) == (expected.station, expected.shift) == (11 + 17 * 3, 5 + 3)
    assert found.score == expected.score
    np.testing.assert_array_equal(found.T_map_odom, expected.T_map_odom)


def test_hypothesis_is_T_map_odom_for_any_odometry_origin(voted):
    """Eq. 12, mended: the yaw turns about the keyframe, not about the odometry's origin."""
    consensus, _ = voted
    np.testing.assert_allclose(consensus.hypotheses()[0].T_map_odom, T_MAP_ODOM, atol=1e-3)


def test_turn_of_opposite_sign_gets_no_consensus(voted):
    """With the yaw's sign swapped the keyframes' votes would miss each other."""
    consensus, visited = voted
    scores = consensus.scores()
    assert scores[visited[-1], SHIFT] < scores[visited[-1], S - SHIFT] - 3.0


def test_yaw_of_shift_matches_equation_9():
    assert yaw_of_shift(0, 60) == 0.0
    assert yaw_of_shift(15, 60) == pytest.approx(-np.pi / 2)
    np.testing.assert_allclose(yaw_of_shift(np.array([1, 2]), 12), [-np.pi / 6, -np.pi / 3])


def test_missing_station_gets_neutral_score():
    whole = grid_stations()
    visited = [station_at(whole, (-5 + 2 * k, 3)) for k in range(4)]
    where = centres(whole, visited)
    hole = visited[1]
    kept = np.delete(np.arange(len(whole)), hole)
    index = {int(old): new for new, old in enumerate(kept)}
    full, holed, shorter = (Consensus(s, BLOCK, CONFIG) for s in (whole, whole[kept], whole[kept]))
    for k, station in enumerate(visited):
        votes = volume(k, station)["scan_context"]
        full.vote(where[k], {"coview": votes})
        holed.vote(where[k], {"coview": votes[kept]})
        if k != 1:
            shorter.vote(where[k], {"coview": votes[kept]})
    newest = index[visited[-1]]
    assert holed.hypotheses()[0].station == newest
    # as if that keyframe had not voted, but for the normalisation
    assert holed.scores()[newest, SHIFT] * 2 == pytest.approx(shorter.scores()[newest, SHIFT] * np.sqrt(3), rel=1e-2)


def test_votes_do_not_wrap_around_map_edges():
    stations = grid_stations()
    grid = StationGrid(stations, BLOCK)
    for step in ([3, 0], [0, 3], [-4, 0], [0, -5], [2, -1], [-50, 0], [0, 1000], [0, 0]):
        found = grid.shifted_index(np.array(step), 0.0)
        goal = stations[:, :2] + BLOCK * np.array(step)
        for m in range(len(stations)):
            there = np.flatnonzero(np.abs(stations[:, :2] - goal[m]).max(axis=1) < 0.1)
            assert found[m] == (there[0] if len(there) else -1)


def test_grid_and_lookup_layouts_give_the_same_shifted_sum():
    """Stations of a ragged site; a layout on cells and a look-up each are the same sum."""
    rng = np.random.default_rng(5)
    stations = grid_stations(9)[rng.permutation(81)[:60]]
    cells, each = StationGrid(stations, BLOCK), StationGrid(stations, BLOCK)
    assert cells.is_raster
    each.is_raster = False
    values = rng.normal(size=(3, 60)).astype(np.float32)
    np.testing.assert_array_equal(cells.from_grid(cells.to_grid(values)), values)
    for step in ([0, 0], [2, -3], [-8, 1], [8, 8], [9, 0], [0, -9], [500, 0], [-150, 150]):
        sums = []
        for grid in (cells, each):
            total = grid.to_grid(values[:1])
            grid.add(total[0], grid.to_grid(values[1:2])[0], np.array(step), 0.0)
            sums.append(grid.from_grid(total)[0])
        there = cells.shifted_index(np.array(step), 0.0)
        np.testing.assert_array_equal(sums[0], values[0] + np.where(there < 0, 0, values[1][there]))
        np.testing.assert_array_equal(sums[0], sums[1])


@pytest.mark.parametrize("kind", ["one road", "two storeys"])
def test_few_stations_on_a_wide_grid_are_no_raster(kind):
    road = (
        grid_stations(40)[::41] if kind == "one road" else np.concatenate([grid_stations(4), grid_stations(4, z=4.0)])
    )
    assert not StationGrid(road, BLOCK).is_raster


@pytest.mark.parametrize("count", [1, 7, 4000, 9999, 10_000, 20_000])
@pytest.mark.parametrize("kind", ["normal", "ties", "few", "rising"])
def test_argsmallest_equals_stable_sort(kind, count, monkeypatch):
    monkeypatch.setattr("coview_stream.localization.search.consensus._SAMPLE", 100)
    rng = np.random.default_rng(6)
    values = {
        "normal": rng.normal(size=10_000),
        "ties": rng.integers(0, 5, 10_000),
        "few": np.where(np.arange(10_000) % 100, 1.0, 2.0),  # the sample sees only what is large
        "rising": np.arange(10_000),
    }[kind].astype(np.float32)
    np.testing.assert_array_equal(argsmallest(values, count), np.argsort(values, kind="stable")[:count])


def test_storeys_are_distinguished_by_height_gained():
    low, high = grid_stations(4), grid_stations(4, z=4.0)
    stations = np.concatenate([low, high[:8]])
    grid = StationGrid(stations, BLOCK)
    same = grid.shifted_index(np.zeros(2, np.int64), 0.0)
    np.testing.assert_array_equal(same, np.arange(24))
    up = grid.shifted_index(np.zeros(2, np.int64), 4.0)
    np.testing.assert_array_equal(up[:8], np.arange(16, 24))
    assert (up[8:] == -1).all()  # no upper storey there, and above it nothing
    down = grid.shifted_index(np.zeros(2, np.int64), -4.0)
    np.testing.assert_array_equal(down[16:], np.arange(8))
    assert (down[:16] == -1).all()


def test_peaks_are_distinct_in_place_or_heading():
    stations = grid_stations()
    consensus = Consensus(stations, BLOCK, ConsensusConfig(peaks=3, distinct_distance=5.0, distinct_yaw=1.0))
    one, beside, far = (station_at(stations, xy) for xy in ((-7, -7), (-5, -7), (9, 9)))
    votes = np.random.default_rng(0).normal(0.6, 0.01, (len(stations), S)).astype(np.float32)
    votes[one, 3], votes[beside, 3], votes[one, 4] = 0.30, 0.31, 0.32  # one hypothesis, seen thrice
    votes[one, 9], votes[far, 3] = 0.35, 0.40
    consensus.vote(np.zeros(3), {"coview": votes})
    found = consensus.hypotheses()
    assert [(h.station, h.shift) for h in found] == [(one, 3), (one, 9), (far, 3)]
    assert [h.score for h in found] == sorted(h.score for h in found)


def test_headings_are_compared_around_the_circle():
    stations = grid_stations()
    consensus = Consensus(stations, BLOCK, ConsensusConfig(peaks=2, distinct_yaw=1.0))
    here, far = station_at(stations, (1, 1)), station_at(stations, (15, 15))
    votes = np.random.default_rng(0).normal(0.6, 0.01, (len(stations), S)).astype(np.float32)
    votes[here, 0], votes[here, S - 1], votes[far, 6] = 0.3, 0.31, 0.4
    consensus.vote(np.zeros(3), {"coview": votes})
    assert [(h.station, h.shift) for h in consensus.hypotheses()] == [(here, 0), (far, 6)]


def test_consensus_window_is_bounded_and_clear_empties_it(voted):
    consensus, visited = voted
    assert len(consensus) == 5
    for k in range(20):
        consensus.vote(np.zeros(3), volume(k, visited[0]))
    assert len(consensus) == CONFIG.window
    consensus.clear()
    assert len(consensus) == 0
    assert consensus.hypotheses() == []


def test_channels_have_equal_weight_for_any_spread():
    stations = grid_stations()
    consensus = Consensus(stations, BLOCK, CONFIG)
    rng = np.random.default_rng(3)
    wide = rng.normal(0.5, 0.1, (len(stations), S)).astype(np.float32)
    narrow = rng.normal(0.9, 0.001, (len(stations), S)).astype(np.float32)
    narrow[40, 6] = 0.88  # 20 sigma in its own channel, nothing in the other's
    consensus.vote(np.zeros(3), {"scan_context": wide, "coview": narrow})
    best = consensus.hypotheses()[0]
    assert (best.station, best.shift) == (40, 6)


def test_robust_zscore_ignores_outliers():
    values = np.random.default_rng(1).normal(5.0, 2.0, (300, 60)).astype(np.float32)
    values[0] = -500.0
    z = robust_zscore(values)[1:]
    assert np.median(z) == pytest.approx(0.0, abs=0.02)
    assert z.std() == pytest.approx(1.0, abs=0.05)
    assert np.isfinite(robust_zscore(np.ones((3, 4), np.float32))).all()
