"""Eqs 1-4, co-visibility of polar bins, in plain NumPy, all rings and sectors at once."""

from __future__ import annotations

import numpy as np

from coview_kernels.arrays import F32, I32, Mask, Vertical

_LOWEST = -np.finfo(
    np.float64
).max  # slope of a height of minus infinity: an occupied bin is above empty ones


def visible(max_height: F32, count: I32) -> Mask:
    """Return the horizontally visible bins (..., R, S) of eq. 2; see :func:`coview_kernels.coview`."""
    occupied: Mask = count > 0
    # Slopes are quotients of a float32 and a small integer, rounded once: equal ones stay equal, and distinct ones
    # distinct. So a tie is a tie on every machine.
    distance = np.arange(1.0, occupied.shape[-2] + 1)[:, None]
    with np.errstate(invalid="ignore"):  # an empty bin may hold anything
        slope = np.where(occupied, np.maximum(max_height.astype(np.float64) / distance, _LOWEST), -np.inf)
    horizon = np.full_like(slope, -np.inf)
    np.maximum.accumulate(slope[..., :-1, :], axis=-2, out=horizon[..., 1:, :])
    seen: Mask = slope > horizon
    return seen


def coview(
    max_height: F32,
    sum_height: F32,
    count: I32,
    vertical: Vertical = "max",
) -> F32:
    """See :func:`coview_kernels.coview`."""
    occupied = count > 0
    horizontal = visible(max_height, count)
    value = np.where(horizontal, max_height, np.float32(0))
    if vertical == "off":
        return value
    bins = count.shape[-2] * count.shape[-1]
    points = np.where(occupied, count, 0).astype(np.int64)
    dense = occupied & (points * bins >= points.sum(axis=(-2, -1), keepdims=True))
    from_above = dense & ~horizontal
    if vertical == "max":
        return np.where(from_above, max_height, value)
    mean = sum_height.astype(np.float64) / np.maximum(count, 1)
    return np.where(from_above, mean.astype(np.float32), value)
