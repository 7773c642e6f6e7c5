"""Co-view descriptors (eqs 1-4) in plain NumPy, all rings and sectors at once."""

from __future__ import annotations

import numpy as np

from coview_kernels.arrays import F32, I32, Mask

_MIN_SLOPE = -np.finfo(np.float64).max  # slope of a height of minus infinity, above the slopes of empty bins


def visible(max_height: F32, count: I32, ties: bool = False) -> Mask:
    """Return the horizontally visible bins (..., R, S) of eq. 2, with ``ties`` also those on the line of sight."""
    occupied: Mask = count > 0
    # Slopes are quotients of a float32 and a small integer, rounded once, so equal slopes stay equal and different
    # slopes stay different: a tie is a tie on every machine.
    distance = np.arange(1.0, occupied.shape[-2] + 1)[:, None]
    with np.errstate(invalid="ignore"):  # an empty bin may hold anything
        slope = np.where(occupied, np.maximum(max_height.astype(np.float64) / distance, _MIN_SLOPE), -np.inf)
    horizon = np.full_like(slope, -np.inf)
    np.maximum.accumulate(slope[..., :-1, :], axis=-2, out=horizon[..., 1:, :])
    seen: Mask = occupied & (slope >= horizon) if ties else slope > horizon
    return seen


def dense(count: I32) -> Mask:
    """Return the vertically visible bins (..., R, S) of eq. 3, with at least the bins' mean number of points."""
    points = np.maximum(count, 0).astype(np.int64)
    bins = count.shape[-2] * count.shape[-1]
    enough: Mask = (points > 0) & (points * bins >= points.sum(axis=(-2, -1), keepdims=True))
    return enough


def coview(max_height: F32, count: I32) -> F32:
    """See :func:`coview_kernels.coview`."""
    return np.where(visible(max_height, count) | dense(count), max_height, np.float32(0))


def paper_context(max_height: F32, count: I32, mean_height: F32) -> F32:
    """See :func:`coview_kernels.paper_context`."""
    height = np.where(dense(count), mean_height, max_height)
    return np.where(visible(max_height, count, ties=True), height, np.float32(0))
