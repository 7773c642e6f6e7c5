"""Eqs 1-4, co-visibility of polar bins, in plain NumPy: one pass over the rings, all sectors at once."""

from __future__ import annotations

import numpy as np

from coview_kernels.arrays import F32, I32, Mask, Mode, Vertical


def visible(max_height: F32, count: I32, mode: Mode, eye: float = 1.5) -> Mask:
    """See :func:`coview_kernels.visible`."""
    occupied: Mask = count > 0
    if mode == "off":
        return occupied
    # Both modes compare slopes h / a with a = i or i - 1/2. Doubling the half and cross-multiplying leaves
    # products of a float32 and a small integer, exact in float64: a tie is a tie on every machine.
    zero = 0.0 if mode == "paper" else float(np.float32(eye))
    seen = np.zeros_like(occupied)
    best_h = np.zeros(occupied.shape[:-2] + occupied.shape[-1:])
    best_a = np.zeros_like(best_h)
    for i in range(1, occupied.shape[-2] + 1):
        a = i if mode == "paper" else 2 * i - 1
        h = max_height[..., i - 1, :].astype(np.float64) - zero
        with np.errstate(invalid="ignore"):  # an empty bin may hold anything
            now = occupied[..., i - 1, :] & ((best_a == 0) | (h * best_a > a * best_h))
        best_h = np.where(now, h, best_h)
        best_a = np.where(now, a, best_a)
        seen[..., i - 1, :] = now
    return seen


def coview(
    max_height: F32,
    sum_height: F32,
    count: I32,
    vertical: Vertical = "max",
    mode: Mode = "paper",
    eye: float = 1.5,
) -> F32:
    """See :func:`coview_kernels.coview`."""
    occupied = count > 0
    horizontal = visible(max_height, count, mode, eye)
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
