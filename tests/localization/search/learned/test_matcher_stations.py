"""What stations read of the scores around them, and how high a place stands that keypoints have moved."""

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
def test_station_takes_best_score_of_its_block(planted, block, cell):
    count = int(TILES * TILE / block)
    xy = np.stack(np.meshgrid(*[(np.arange(count) + 0.5) * block + low * TILE for low in LOW]), -1)
    places = np.column_stack([xy.reshape(-1, 2), np.zeros(count**2)]).astype(np.float32)
    known = FeatureMatcher(planted.features, places, LearnedConfig(cell=cell), block=block)
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


def test_four_metre_blocks_find_a_place_anywhere_inside(planted):
    axis = np.arange(2.0, TILES * TILE, 4.0)
    xy = np.stack(np.meshgrid(axis + LOW[0] * TILE, axis + LOW[1] * TILE), axis=-1).reshape(-1, 2)
    places = np.column_stack([xy, np.zeros(len(xy))]).astype(np.float32)
    known = FeatureMatcher(planted.features, places, LearnedConfig(), block=4.0)
    for place in ((21.0, 33.0), (23.0, 33.0), (21.0, 35.0), (23.0, 35.0)):
        distances = known.distances(planted.seen(place, 0.0, np.zeros(3)))
        np.testing.assert_allclose(places[distances.min(axis=1).argmin(), :2], (22.0, 34.0))


def test_hypothesis_moved_by_keypoints_keeps_its_storey(planted):
    """Two storeys 3 m apart on a slope, the upper one with a hole; beyond, no stations at all."""
    axis = np.arange(-19.0, 20.0, 2.0)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    lower = np.column_stack([xy, 0.2 * xy[:, 0]])
    upper = lower[np.hypot(*xy.T) > 5.0] + (0.0, 0.0, 3.0)
    known = FeatureMatcher(planted.features, np.vstack([lower, upper]).astype(np.float32), LearnedConfig())

    def ground(xy, before):
        return known._ground(np.array(xy), np.array(before))

    assert ground((13.0, 9.0), (9.0, 9.0, 1.8)) == pytest.approx(2.6)
    assert ground((13.0, 9.0), (9.0, 9.0, 4.8)) == pytest.approx(5.6)
    assert ground((13.2, 9.4), (13.0, 9.0, 5.6)) == pytest.approx(5.6)
    assert ground((1.0, 1.0), (1.5, 1.0, 3.3)) == 3.3  # nothing there on this storey
    assert ground((60.0, 1.0), (56.0, 1.0, 7.0)) == 7.0
