"""The paper's modes: ring keys score their candidates only, and the single smallest distance names the place."""

from __future__ import annotations

import numpy as np
import pytest

from bench.accuracy import paper
from bench.accuracy.paper import Modes, SmallestDistance, ring_key
from coview_stream.descriptors.coview import describe
from coview_stream.geometry.transforms import transform, wrap_angle, yaw_of
from coview_stream.localization.search import recognizers
from coview_stream.localization.search.consensus import yaw_of_shift
from coview_stream.localization.search.retrieval import exact_distances


@pytest.fixture
def query(world_map):
    return {name: np.float32(world_map.descriptors(name)[3]) for name in world_map.descriptor_config.channels}


def test_ring_keys_score_only_their_candidates(world_map, query, monkeypatch):
    monkeypatch.setattr(paper, "CANDIDATES", 6)
    for name, volume in Modes(ring_key=True).distances(world_map, query).items():
        stations = np.float32(world_map.descriptors(name))
        gap = np.linalg.norm(ring_key(stations) - ring_key(query[name]), axis=1)
        nearest = np.argsort(gap, kind="stable")[:6]
        np.testing.assert_allclose(volume[nearest], exact_distances(stations[nearest], query[name]), atol=1e-5)
        assert (np.delete(volume, nearest, axis=0) == 1.0).all()
        assert volume.argmin() // volume.shape[1] == 3


def test_ring_key_is_the_occupied_share_of_each_ring_at_any_turn():
    descriptor = np.zeros((4, 12), np.float32)
    descriptor[0], descriptor[1, :3], descriptor[3, 5] = 1.0, 2.0, 3.0
    np.testing.assert_allclose(ring_key(descriptor), [1.0, 0.25, 0.0, 1 / 12])
    np.testing.assert_allclose(ring_key(np.roll(descriptor, 5, axis=1)), ring_key(descriptor))


def test_single_smallest_distance_names_the_place():
    rng = np.random.default_rng(0)
    stations = np.column_stack([rng.uniform(-20, 20, (40, 2)), np.zeros(40)]).astype(np.float32)
    single = SmallestDistance(stations, 10)
    assert single.hypotheses() == []
    centres = [np.array([k, 2.0 * k, 0.0]) for k in range(4)]
    for k, centre in enumerate(centres):
        volume = rng.normal(0.6, 0.02, (40, 12)).astype(np.float32)
        volume[11 + k, 5 + k] = 0.35 - 0.1 * (k == 2)
        single.vote(centre, [volume + np.float32(0.1), volume])
    (only,) = single.hypotheses()
    assert (only.station, only.shift, only.votes) == (13, 7, pytest.approx(0.25))
    there = transform(only.T_map_odom, centres[2][None])[0]
    np.testing.assert_allclose(there, stations[13], atol=1e-6)
    assert yaw_of(only.T_map_odom) == pytest.approx(wrap_angle(float(yaw_of_shift(7, 12))))
    single.clear()
    assert len(single) == 0


def test_strict_descriptors_lack_bins_that_are_seen_from_above_only(world_map):
    config = world_map.descriptor_config
    points, centre = np.array(world_map.points), np.float64(world_map.stations[3])
    loose = describe(points, centre, config)
    with Modes(strict=True).descriptors():
        strict = describe(points, centre, config)
    assert (strict["coview"] != 0).sum() < (loose["coview"] != 0).sum()
    np.testing.assert_array_equal(strict["scan_context"], loose["scan_context"])


def test_localizers_vote_by_the_modes_only_inside_the_block():
    product = recognizers.StationConsensus
    with Modes(single=True).localizer():
        assert recognizers.StationConsensus is not product
    assert recognizers.StationConsensus is product
