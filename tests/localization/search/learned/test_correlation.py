"""Dense correlation equals direct sums, finds planted places, and is honest about what lies off the map."""

import numpy as np
import pytest
from scipy import ndimage

from coview_stream.localization.search.learned.correlation import (
    MIN_COVERAGE,
    FeatureIndex,
    correlate,
    downsample,
    rotate_images,
)

YAWS = np.arange(12) * (np.pi / 6)


def features(rng, *shape, smooth=1.0):
    """Unit features, correlated over a cell or so like those of a network."""
    values = ndimage.gaussian_filter(rng.normal(size=shape), (0, smooth, smooth))
    return (values / np.linalg.norm(values, axis=0)).astype(np.float32)


def scores_of(query, weight, index, yaws, blocks=None):
    """Scores (K, H, W) of a query (C, h, h) and its weights, which are multiplied already."""
    return correlate(rotate_images(np.concatenate([query, weight[None]]), np.asarray(yaws)), index, False, blocks)


def disk(size):
    at = np.arange(size) - (size - 1) / 2
    return (np.hypot(at[:, None], at[None]) <= size / 2).astype(np.float32)


def bilinear(image, row, col):
    """Value of (h, w) between cells, 0 beyond them: loops, to be compared with."""
    total = 0.0
    i, j = int(np.floor(row)), int(np.floor(col))
    for k in (i, i + 1):
        for m in (j, j + 1):
            if 0 <= k < image.shape[0] and 0 <= m < image.shape[1]:
                total += (1 - abs(row - k)) * (1 - abs(col - m)) * image[k, m]
    return total


def by_loops(query, weight, known, surveyed, yaws):
    """The definition, in float64: the query's grid is turned, laid on every cell, multiplied and summed."""
    _, height, width = known.shape
    half = len(weight) // 2
    out = np.full((len(yaws), height, width), -np.inf)
    for k, yaw in enumerate(yaws):
        c, s = np.cos(yaw), np.sin(yaw)
        grid = []
        for v in range(-half, half + 1):
            for u in range(-half, half + 1):
                if np.hypot(u, v) <= half:
                    at = (c * v - s * u + half - 0.5, c * u + s * v + half - 0.5)
                    grid.append((v, u, [bilinear(q, *at) for q in query], bilinear(weight, *at)))
        total = sum(w for *_, w in grid)
        for r in range(height):
            for col in range(width):
                value = share = 0.0
                for v, u, q, w in grid:
                    if 0 <= r + v < height and 0 <= col + u < width:
                        value += float(np.dot(q, known[:, r + v, col + u]))
                        share += w * surveyed[r + v, col + u]
                if share / total >= MIN_COVERAGE:
                    out[k, r, col] = value / share
    return out


@pytest.mark.parametrize("max_bytes", [0, 1 << 30])
@pytest.mark.parametrize("opposite", [False, True])
def test_correlation_equals_direct_sums(max_bytes, opposite):
    rng = np.random.default_rng(1)
    known = features(rng, 3, 11, 17)
    known[:, :5, :9] = 0.0
    surveyed = (known != 0).any(axis=0)
    local, weights = features(rng, 3, 12, 12), rng.uniform(0.1, 1.0, (12, 12)).astype(np.float32)
    query, weight = downsample(local, weights)
    yaws = np.array([0.0, 0.3, 2.0, -1.2])
    made = FeatureIndex(known, (0.0, 0.0), block=15, margin=4, max_bytes=max_bytes)
    assert len(made) == 2 * 3
    ours = correlate(rotate_images(np.concatenate([query, weight[None]]), yaws), made, opposite)
    if opposite:
        yaws = np.concatenate([yaws, yaws + np.pi])
    expected = by_loops(query, weight, known, surveyed, yaws)
    assert ours.shape == expected.shape == (len(yaws), 11, 17)
    assert ours.dtype == np.float32
    scored = np.isfinite(expected)
    np.testing.assert_array_equal(np.isfinite(ours), scored)
    assert scored.any()
    assert not scored.all()
    np.testing.assert_allclose(ours[scored], expected[scored], atol=1e-4)


def centre_of(coarse, row, col):
    """x and y (..., 2) of the centres of cells, metres; between cells where the numbers are not whole."""
    return (np.stack([col, row], axis=-1) + 0.5) * coarse.cell + coarse.corner


def test_requested_blocks_score_as_in_full_correlation():
    rng = np.random.default_rng(5)
    known, corner = features(rng, 4, 150, 90), (100.0, -50.0)
    coarse = FeatureIndex(known, corner, block=64)
    query, weight = features(rng, 4, 32, 32) * disk(32), disk(32)
    whole = scores_of(query, weight, coarse, YAWS[:3])
    place = centre_of(coarse, 70, 33)
    near = coarse.blocks_near([place], 20.0)
    assert 0 < len(near) < len(coarse)
    part = scores_of(query, weight, coarse, YAWS[:3], near)
    rows, cols = np.indices(known.shape[1:])
    within = np.hypot(*(centre_of(coarse, rows, cols) - place).transpose(2, 0, 1)) <= 20.0
    assert np.isfinite(part[:, within]).all()
    scored = np.isfinite(part)
    assert scored.sum() < np.isfinite(whole).sum()
    np.testing.assert_allclose(part[scored], whole[scored], atol=1e-6)
    assert np.isneginf(scores_of(query, weight, coarse, YAWS[:3], coarse.blocks_near([(0, 5000)], 9.0))).all()


def test_downsampled_cells_are_weighted_means():
    local = np.arange(16, dtype=np.float32).reshape(1, 4, 4)
    weight = np.zeros((4, 4), np.float32)
    weight[0, 0], weight[1, 1] = 2.0, 1.0
    query, total = downsample(local, weight)
    assert query[0].tolist() == [[(0 * 2 + 5 * 1) / 4, 0], [0, 0]]
    assert total.tolist() == [[0.75, 0], [0, 0]]
    np.testing.assert_allclose(downsample(local)[0][0, 1, 1], np.mean([10, 11, 14, 15]))


def test_query_without_weight_is_refused():
    query, weight = np.ones((2, 32, 32), np.float32), np.zeros((32, 32), np.float32)
    with pytest.raises(ValueError, match="no cell of the query has a weight"):
        scores_of(query, weight, FeatureIndex(np.ones((2, 40, 40), np.float32), (0, 0)), [0.0])
