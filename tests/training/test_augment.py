"""Each change that spoils a bird view does what it says, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.descriptors.birds_eye_view import CELL, LAYERS, Image
from coview_stream.training.batches import _fell, augmented

HEIGHTS, TOP, SEEN, RELIEF = slice(0, LAYERS - 3), LAYERS - 3, LAYERS - 2, LAYERS - 1
SHAPE = (LAYERS, 96, 80)


class Draws:
    """Random numbers of a seed; those that decide whether a change is made are given."""

    def __init__(self, seed: int, *decisions: float) -> None:
        self._rng, self._decisions = np.random.default_rng(seed), list(decisions)

    def random(self, *args, **more):
        return self._rng.random(*args, **more) if args or not self._decisions else self._decisions.pop(0)

    def __getattr__(self, name):
        return getattr(self._rng, name)


@pytest.fixture
def image() -> Image:
    return np.random.default_rng(1).integers(1, 256, SHAPE).astype(np.uint8)


def changed(before: Image, after: Image) -> list[int]:
    return [k for k in range(LAYERS) if not np.array_equal(before[k], after[k])]


@pytest.mark.parametrize("aerial", [True, False])
@pytest.mark.parametrize("seed", range(12))
def test_augmentation_keeps_shape_type_and_original(image: Image, aerial: bool, seed: int) -> None:
    kept = image.copy()
    spoilt = augmented(image, aerial, np.random.default_rng(seed))
    assert spoilt.shape == SHAPE
    assert spoilt.dtype == np.uint8
    assert not np.shares_memory(spoilt, image)
    np.testing.assert_array_equal(image, kept)
    np.testing.assert_array_equal(spoilt, augmented(image, aerial, np.random.default_rng(seed)))


def test_augmentation_with_zero_probabilities_changes_nothing(image: Image) -> None:
    np.testing.assert_array_equal(augmented(image, True, Draws(0, 1, 1, 1, 1, 1)), image)


def test_fallen_trees_clear_disks_in_height_layers(image: Image) -> None:
    counts = []
    for seed in range(40):
        felled = augmented(image, True, Draws(seed, 0, 1, 1, 1, 1))
        np.testing.assert_array_equal(felled[SEEN:], image[SEEN:])
        gone = felled[TOP] == 0
        for layer in felled[: TOP + 1]:  # the same disks in all layers; elsewhere as it was
            np.testing.assert_array_equal(layer == 0, gone)
        np.testing.assert_array_equal(felled[:, ~gone], image[:, ~gone])
        counts.append(gone.sum() * CELL**2 / (SHAPE[1] * SHAPE[2] * CELL**2))
    # 20 disks a hectare on average, of about 10 m2 each, some cut by the edge
    assert 0.01 < np.mean(counts) < 0.03
    assert max(counts) > 0.03


def test_one_fallen_tree_is_round(monkeypatch) -> None:
    image = np.full((LAYERS, 41, 41), 9, dtype=np.uint8)
    rng = Draws(0)
    rng.poisson = lambda mean: 1
    rng.integers = lambda high, size: np.array([20])
    rng.uniform = lambda low, high, size=None: np.array([2.0]) if size else 0.0
    _fell(image, rng)
    y, x = np.indices((41, 41))
    np.testing.assert_array_equal(image[0] == 0, np.hypot(y - 20, x - 20) * CELL < 2.0)
    assert (image[SEEN:] == 9).all()


def test_thinning_drops_cells_of_each_layer_independently(image: Image) -> None:
    shares = []
    for seed in range(20):
        thin = augmented(image, True, Draws(seed, 1, 0, 1, 1, 1))
        assert changed(image, thin) == [*range(LAYERS - 3), SEEN]
        assert ((thin == image) | (thin == 0)).all()
        lost = thin[HEIGHTS] == 0
        shares.append(lost.mean())
        assert lost.any(axis=0).mean() > lost[0].mean()  # not the same cells in every layer
    assert 0.15 < np.mean(shares) < 0.35
    assert max(shares) <= 0.51


def test_occlusion_from_above_hides_lowest_layers(image: Image) -> None:
    for seed in range(20):
        hidden = changed(image, augmented(image, True, Draws(seed, 1, 1, 0, 1, 1)))
        assert hidden == list(range(len(hidden)))
        assert 1 <= len(hidden) <= 3


def test_occlusion_from_below_hides_upper_layers(image: Image) -> None:
    for seed in range(20):
        low = augmented(image, False, Draws(seed, 1, 1, 0, 1, 1))
        hidden = [k for k in range(LAYERS - 3) if not low[k].any()]
        assert hidden == list(range(hidden[0], LAYERS - 3))
        assert hidden[0] >= 3
        assert changed(image, low) == [*hidden, TOP]
        assert low[TOP].max() <= 0.4 * 255
        assert (low[TOP] <= image[TOP]).all()
        np.testing.assert_array_equal(low[SEEN:], image[SEEN:])


def test_density_change_keeps_order_and_both_ends(image: Image) -> None:
    image[0, 0, :2] = 0, 255
    directions = set()
    for seed in range(20):
        other = augmented(image, True, Draws(seed, 1, 1, 1, 0, 1))
        np.testing.assert_array_equal(other[TOP:], image[TOP:])
        assert other[0, 0, :2].tolist() == [0, 255]
        order = np.argsort(image[HEIGHTS].ravel(), kind="stable")
        assert (np.diff(other[HEIGHTS].ravel()[order].astype(int)) >= 0).all()
        directions.add(bool(other[HEIGHTS].mean() > image[HEIGHTS].mean()))
    assert directions == {True, False}


def test_relief_layer_is_scaled_or_dropped_alone(image: Image) -> None:
    spreads = []
    for seed in range(40):
        other = augmented(image, True, Draws(seed, 1, 1, 1, 1, 0))
        assert changed(image, other) == [RELIEF]
        before, after = image[RELIEF].astype(int) - 128, other[RELIEF].astype(int) - 128
        assert (np.sign(before) * after >= -1).all()  # no hill becomes a hollow, rounding apart
        spreads.append(after.std() / before.std())
    assert min(spreads) == 0.0
    assert 0.3 < sorted(spreads)[len(spreads) // 2 + 5] < 1.3
    assert max(spreads) > 1.0
