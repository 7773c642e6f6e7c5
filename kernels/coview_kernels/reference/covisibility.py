"""Co-view descriptor (eqs 1-4) in plain NumPy, all rings and sectors at once."""

from __future__ import annotations

import numpy as np

from coview_kernels.arrays import F32, I32, Mask, Vertical

_MIN_SLOPE = -np.finfo(np.float64).max  # of a height of minus infinity: above the slopes of empty bins


def visible(max_height: F32, count: I32) -> Mask:
    """Return the horizontally visible bins (..., R, S) of eq. 2; see :func:`coview_kernels.coview`."""
    occupied: Mask = count > 0
    # Slopes are quotients of a float32 and a small integer, rounded once: equal ones stay equal, and distinct ones
    # distinct. So a tie is a tie on every machine.
    distance = np.arange(1.0, occupied.shape[-2] + 1)[:, None]
    with np.errstate(invalid="ignore"):  # an empty bin may hold anything
        slope = np.where(occupied, np.maximum(max_height.astype(np.float64) / distance, _MIN_SLOPE), -np.inf)
    horizon = np.full_like(slope, -np.inf)
    np.maximum.accumulate(slope[..., :-1, :], axis=-2, out=horizon[..., 1:, :])
    seen: Mask = slope > horizon
    return seen


def coview(max_height: F32, count: I32, vertical: Vertical = "max") -> F32:
    """See :func:`coview_kernels.coview`."""
    seen = visible(max_height, count)
    if vertical != "off":
        occupied = count > 0
        bins = count.shape[-2] * count.shape[-1]
        points = np.where(occupied, count, 0).astype(np.int64)
        seen |= occupied & (points * bins >= points.sum(axis=(-2, -1), keepdims=True))
    return np.where(seen, max_height, np.float32(0))
