"""Cells of the stations: all in a station's block, or the one around it."""

from __future__ import annotations

import numpy as np
import pytest
from planted_features import LOW, TILES, Planted

from coview_stream.config import LearnedConfig
from coview_stream.descriptors.feature_map import TILE
from coview_stream.localization.search.learned.matcher import FeatureMatcher


@pytest.fixture(scope="module")
def planted():
    return Planted()


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


def test_four_metre_blocks_find_a_place_anywhere_inside(planted):
    axis = np.arange(2.0, TILES * TILE, 4.0)
    xy = np.stack(np.meshgrid(axis + LOW[0] * TILE, axis + LOW[1] * TILE), axis=-1).reshape(-1, 2)
    places = np.column_stack([xy, np.zeros(len(xy))]).astype(np.float32)
    known = FeatureMatcher(planted.features, places, LearnedConfig(), block=4.0)
    for place in ((21.0, 33.0), (23.0, 33.0), (21.0, 35.0), (23.0, 35.0)):
        stations, _ = known.vote(planted.seen(place, 0.0, np.zeros(3))).candidates()
        np.testing.assert_allclose(places[stations[0], :2], (22.0, 34.0))
