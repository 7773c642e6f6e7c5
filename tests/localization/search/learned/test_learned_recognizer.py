"""Stations above each other look alike from above: each storey is named."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bench.accuracy.paper import TableVote
from coview_stream.basemap.stations import StationGrid
from coview_stream.config import LearnedConfig, LocalizerConfig
from coview_stream.geometry.transforms import transform
from coview_stream.localization.search.learned.matcher import LearnedRecognizer
from coview_stream.localization.search.request import SearchRequest

HERE, THERE, SHIFT = (5.0, -7.0), (-15.0, 11.0), 7


def named(heights, peaks=5):
    """What is named on a map with these storeys, of which features favour one place on all."""
    axis = np.arange(-19.0, 20.0, 2.0)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    stations = np.vstack([np.column_stack([xy, np.full(len(xy), z)]) for z in heights]).astype(np.float32)
    config = LocalizerConfig(learned=LearnedConfig(peaks=peaks))
    flat = np.random.default_rng(0).normal(1.0, 0.1, (len(xy), config.learned.yaws)).astype(np.float32)
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
    found, stations = named([0.0, gap])
    at = [transform(each.T_map_odom, np.zeros((1, 3)))[0] for each in found]
    assert [tuple(xy) for xy in np.round(at, 3)[:2, :2].tolist()] == [HERE, HERE]
    assert sorted(round(z, 3) for _, _, z in at[:2]) == [0.0, gap]
    for each, place in zip(found[:4], at, strict=False):
        np.testing.assert_allclose(stations[each.station], place, atol=1e-5)
        assert each.shift == SHIFT
        assert each.learned
    assert [each.score for each in found[:2]] == pytest.approx([single.score] * 2, rel=0.01)
    assert len({(each.station, each.shift) for each in found}) == len(found)


def test_storey_hypotheses_are_bounded():
    assert len(named([0.0, 2.9, 5.8])[0]) == 10
    assert len(named([0.0])[0]) == 5
