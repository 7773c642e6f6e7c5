"""Keypoints are the least uncertain cells, pairs the most similar descriptors."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.config.search import LearnedMatchConfig
from coview_stream.errors import ConfigError
from coview_stream.localization.search.learned.keypoints import Keypoints, keypoints, local_minima, nearest_pairs


def test_local_minima_match_definition_and_are_not_adjacent():
    rng = np.random.default_rng(0)
    values = rng.integers(0, 12, (30, 41)).astype(np.float32)  # with many equal ones
    found = local_minima(values)
    padded = np.pad(values, 1, constant_values=np.inf)
    for r, c in zip(*np.nonzero(found), strict=True):
        assert values[r, c] == padded[r : r + 3, c : c + 3].min()
        assert found[max(0, r - 1) : r + 2, max(0, c - 1) : c + 2].sum() == 1
    distinct = rng.permutation(30 * 41).reshape(30, 41).astype(np.float32)
    padded = np.pad(distinct, 1, constant_values=np.inf)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).min(axis=(2, 3))
    np.testing.assert_array_equal(local_minima(distinct), distinct == windows)


def test_flat_image_has_one_minimum_and_empty_image_none():
    assert local_minima(np.ones((5, 6))).sum() == 1
    assert not local_minima(np.full((5, 6), np.inf)).any()


def test_keypoints_are_cell_centres_sorted_by_sigma():
    sigma = np.ones((6, 8), np.float32)
    sigma[4, 2], sigma[1, 6] = 0.3, 0.2
    local = np.arange(2 * 6 * 8, dtype=np.float32).reshape(2, 6, 8)
    found = keypoints(local, sigma, (-32.0, 100.0), count=2)
    np.testing.assert_allclose(found.xy, [[-32 + 6.5, 101.5], [-32 + 2.5, 104.5]])
    np.testing.assert_array_equal(found.sigma, sigma[[1, 4], [6, 2]])
    np.testing.assert_array_equal(found.descriptors, local[:, [1, 4], [6, 2]].T)
    assert len(keypoints(local, sigma, (0, 0), count=1)) == 1
    np.testing.assert_allclose(keypoints(local, sigma, (0, 0), count=1, cell=2.0).xy, [[13.0, 3.0]])


def test_masked_cells_are_excluded_and_hide_no_keypoint():
    sigma = np.ones((6, 8), np.float32)
    sigma[2, 2], sigma[2, 3] = 0.1, 0.2
    mask = np.ones((6, 8), bool)
    mask[2, 2] = False
    found = keypoints(np.zeros((2, 6, 8), np.float32), sigma, (0, 0), mask=mask, count=1)
    np.testing.assert_allclose(found.xy, [[3.5, 2.5]])
    assert not len(keypoints(np.zeros((2, 6, 8), np.float32), sigma, (0, 0), mask=np.zeros((6, 8), bool)))


def test_keypoints_within_radius_of_a_place():
    xy = np.array([[0.0, 0.0], [3.0, 4.0], [6.0, 8.0]])
    found = Keypoints(xy, np.zeros((3, 2), np.float32), np.ones(3, np.float32)).around((0, 0), 5.0)
    np.testing.assert_array_equal(found.xy, xy[:2])


def test_mismatched_shapes_are_refused():
    with pytest.raises(ValueError, match="different numbers"):
        Keypoints(np.zeros((3, 2)), np.zeros((2, 4), np.float32), np.ones(3, np.float32))
    with pytest.raises(ValueError, match="mask is"):
        keypoints(np.zeros((2, 4, 4), np.float32), np.ones((4, 4), np.float32), (0, 0), mask=np.ones((3, 4), bool))
    with pytest.raises(ValueError, match="do not compare"):
        nearest_pairs(np.zeros((3, 4), np.float32), np.zeros((3, 5), np.float32))


def unit(rng, *shape):
    values = rng.normal(size=shape)
    return (values / np.linalg.norm(values, axis=1, keepdims=True)).astype(np.float32)


def test_nearest_pairs_match_definition():
    rng = np.random.default_rng(1)
    query, known = unit(rng, 20, 6), unit(rng, 33, 6)
    similarity = query @ known.T
    expected = set()
    for i in range(20):
        for j in range(33):
            if similarity[i, j] == similarity[i].max() == similarity[:, j].max():
                expected.add((i, j))
    pairs, values = nearest_pairs(query, known, max_pairs=10_000)
    assert {(int(i), int(j)) for i, j in pairs} == expected
    np.testing.assert_array_equal(values, similarity[pairs[:, 0], pairs[:, 1]])
    assert (np.diff(values) <= 0).all()
    few, best = nearest_pairs(query, known, max_pairs=5)
    np.testing.assert_array_equal(few, pairs[:5])
    np.testing.assert_array_equal(best, values[:5])


def test_infeasible_pairs_are_replaced_by_feasible_ones():
    query = np.array([[1.0, 0.0]], np.float32)
    known = np.array([[1.0, 0.0], [0.8, 0.6]], np.float32)
    assert nearest_pairs(query, known)[0].tolist() == [[0, 0]]
    assert nearest_pairs(query, known, possible=np.array([[False, True]]))[0].tolist() == [[0, 1]]
    assert nearest_pairs(query, known, possible=np.zeros((1, 2), bool))[0].shape == (0, 2)


def test_empty_keypoints_give_no_pairs():
    empty, some = np.zeros((0, 3), np.float32), np.ones((4, 3), np.float32)
    for one, other in ((empty, some), (some, empty), (empty, empty)):
        pairs, values = nearest_pairs(one, other)
        assert pairs.shape == (0, 2)
        assert values.shape == (0,)


@pytest.mark.parametrize(
    "wrong", [{"keypoints": 0}, {"pairs": 401}, {"min_inliers": 1}, {"tolerance": 0.0}, {"max_turn": -1.0}]
)
def test_match_config_out_of_range_is_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        LearnedMatchConfig(**wrong)
