"""Augmentation of bird's-eye views: fallen trees, thinner clouds, layers that a sensor or a season does not show."""

from __future__ import annotations

import numpy as np

from coview_stream.descriptors.birds_eye_view import CELL, LAYERS, Image

_HEIGHTS = LAYERS - 3  # height layers; then come the greatest height, ground seen, relief
_TOP, _SEEN, _RELIEF = LAYERS - 3, LAYERS - 2, LAYERS - 1
# set by hand, as the ranges drawn from below
_CHANCE = 0.5  # of each change
_MAX_FALLEN = 0.004  # disks per square metre: 40 a hectare
_RADII = (1.0, 2.5)  # metres


def augmented(image: Image, aerial: bool, rng: np.random.Generator) -> Image:
    """Return a copy of a bird's-eye view (LAYERS, H, W) with random changes to its trees, cells and layers."""
    image = image.copy()
    if rng.random() < _CHANCE:
        _fell(image, rng)
    if rng.random() < _CHANCE:
        _thin(image, rng)
    if rng.random() < 0.5 * _CHANCE:
        _hide(image, aerial, rng)
    if rng.random() < _CHANCE:
        power = np.exp(rng.uniform(-0.6, 0.6))
        shares = 255.0 * (np.arange(256) / 255.0) ** power
        image[:_HEIGHTS] = shares.astype(np.uint8)[image[:_HEIGHTS]]
    if rng.random() < 0.5 * _CHANCE:
        image[_RELIEF] = 128 if rng.random() < 0.5 else _weaker(image[_RELIEF], rng.uniform(0.3, 1.5))
    return image


def _fell(image: Image, rng: np.random.Generator) -> None:
    """Clear disks of all height layers, as if trees were gone; the ground layers stay."""
    height, width = image.shape[1:]
    count = rng.poisson(rng.uniform(0.0, _MAX_FALLEN) * height * width * CELL**2)
    for row, column, radius in zip(
        rng.integers(height, size=count), rng.integers(width, size=count), rng.uniform(*_RADII, count), strict=True
    ):
        reach = int(radius / CELL) + 1
        rows = slice(max(0, row - reach), row + reach + 1)
        columns = slice(max(0, column - reach), column + reach + 1)
        y, x = np.ogrid[rows.start : min(rows.stop, height), columns.start : min(columns.stop, width)]
        near = np.hypot(y - row, x - column) * CELL < radius
        image[:_SEEN, rows, columns][:, near] = 0


def _thin(image: Image, rng: np.random.Generator) -> None:
    """Drop a share of the filled cells of each layer, as in a sparser scan."""
    kept = rng.random(image[:_HEIGHTS].shape, dtype=np.float32) > rng.uniform(0.0, 0.5)
    image[:_HEIGHTS] *= kept
    image[_SEEN] *= rng.random(image[_SEEN].shape, dtype=np.float32) > rng.uniform(0.0, 0.5)


def _hide(image: Image, aerial: bool, rng: np.random.Generator) -> None:
    """Drop the layers below dense leaves (from above), or those above a sensor's field of view (from below)."""
    if aerial:
        image[: int(rng.integers(1, 4))] = 0
        return
    first = int(rng.integers(3, _HEIGHTS))
    image[first:_HEIGHTS] = 0
    image[_TOP] = np.minimum(image[_TOP], int(255 * rng.uniform(0.1, 0.4)))


def _weaker(layer: Image, factor: float) -> Image:
    return np.asarray(np.clip(128.0 + factor * (layer.astype(np.float32) - 128.0), 0.0, 255.0).astype(np.uint8))
