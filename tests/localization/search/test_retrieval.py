"""Retrieval: distances equal brute force, votes nearly so."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import pytest

from bench.accuracy.paper import TableVote
from coview_stream.basemap.station_index import StationIndex
from coview_stream.basemap.stations import StationGrid
from coview_stream.config import DescriptorConfig
from coview_stream.descriptors.coview import describe
from coview_stream.localization.search import retrieval
from coview_stream.localization.search.consensus import yaw_of_shift
from coview_stream.localization.search.retrieval import CoViewVote, Retrieval, exact_distances

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


@pytest.mark.parametrize("block", [1, 7, M])
def test_distances_are_the_same_in_blocks(stations, query, monkeypatch, block):
    expected = exact_distances(stations.full["coview"], query["coview"])
    monkeypatch.setattr(retrieval, "_BLOCK", block)
    np.testing.assert_allclose(exact_distances(stations.full["coview"], query["coview"]), expected, atol=1e-5)


def test_vote_is_that_of_the_exact_distances(stations, query):
    vote = CoViewVote(np.zeros(3), Retrieval(stations).compared().index, query)
    exact = TableVote.of_distances(np.zeros(3), [exact_distances(stations.full[name], query[name]) for name in query])
    station, shift = (each.ravel() for each in np.indices((M, S)))
    found, expected = vote.at(station, shift), exact.at(station, shift)
    assert np.abs(found - expected).max() < 1.0
    assert np.corrcoef(found, expected)[0, 1] > 0.98
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


@pytest.mark.parametrize("turn", [0, 1, 5, 11])
def test_robot_turned_left_is_found_at_its_heading(turn):
    """Eq. 9: shift n means that the robot's x axis points at yaw -2 pi n / S in the map."""
    rng = np.random.default_rng(12)
    config = DescriptorConfig(radius=20.0, rings=R, sectors=S, channels=("scan_context",))
    places = [
        np.column_stack([rng.uniform(-20, 20, (60, 2)), rng.uniform(0.5, 9, 60)]).astype(np.float32) for _ in range(12)
    ]
    there = Stations()
    there.full = {"scan_context": np.stack([describe(p, np.zeros(3), config)["scan_context"] for p in places])}
    yaw = 2 * np.pi * turn / S
    c, s = np.cos(yaw), np.sin(yaw)
    seen = places[8].astype(np.float64) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])  # map -> body: inverse turn
    query = describe(seen.astype(np.float32), np.zeros(3), config)["scan_context"]
    volume = exact_distances(there.full["scan_context"], query)
    station, shift = np.unravel_index(volume.argmin(), volume.shape)
    assert station == 8
    assert np.cos(yaw_of_shift(int(shift), S) - yaw) == pytest.approx(1.0)
