"""Twins of the kernels of clouds seen from above."""

from __future__ import annotations

import numpy as np

from coview_kernels.arrays import F32, F64, I64, U8, OverheadGrid


def _inside(points: F32, grid: OverheadGrid) -> tuple[F32, I64]:
    """Return the points (M, 3) in a grid, relative to its corner, and their cells (M,)."""
    rows, columns = grid.shape
    local = points - np.array([grid.x, grid.y, 0.0], dtype=np.float32)
    column, row = np.floor(local[:, :2] * np.float32(1.0 / grid.cell)).T
    kept = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    return local[kept], row[kept].astype(np.int64) * columns + column[kept].astype(np.int64)


def lowest_heights(points: F32, grid: OverheadGrid) -> F32:
    """Twin of :func:`coview_kernels.lowest_heights`."""
    local, cell = _inside(points, grid)
    lowest = np.full(grid.shape[0] * grid.shape[1], np.inf, dtype=np.float32)
    np.minimum.at(lowest, cell, local[:, 2])
    return lowest.reshape(grid.shape)


def offsets_near(points: F32, grid: OverheadGrid, level: F32, band: float) -> tuple[I64, F64]:
    """Twin of :func:`coview_kernels.offsets_near`."""
    local, cell = _inside(points, grid)
    off = local[:, 2] - level.reshape(-1)[cell]
    near = np.abs(off) < np.float32(band)
    count = np.bincount(cell[near], minlength=level.size)
    total = np.bincount(cell[near], weights=off[near], minlength=level.size)
    return count.reshape(grid.shape).astype(np.int64), total.reshape(grid.shape).astype(np.float64)


def height_columns(
    points: F32, grid: OverheadGrid, ground: F32, ratio: int, step: float, bounds: tuple[float, float, float]
) -> tuple[U8, F32, U8]:
    """Twin of :func:`coview_kernels.height_columns`."""
    local, cell = _inside(points, grid)
    low, high, near = bounds
    size = grid.shape[0] * grid.shape[1]
    above = local[:, 2] - _interpolated(ground, local, np.float32(1.0 / (grid.cell * ratio)))
    standing = (above >= np.float32(low)) & (above < np.float32(high))
    level = (above[standing] * np.float32(1.0 / step)).astype(np.int64)
    occupied = np.zeros((round(high / step), size), dtype=np.uint8)
    occupied[np.minimum(level, len(occupied) - 1), cell[standing]] = 1
    top = np.zeros(size, dtype=np.float32)
    np.maximum.at(top, cell, np.clip(above, np.float32(0.0), np.float32(high)))
    seen = np.zeros(size, dtype=np.uint8)
    seen[cell[above < np.float32(near)]] = 1
    return occupied, top, seen


def _interpolated(values: F32, local: F32, scale: np.float32) -> F32:
    """Interpolate an image (h, w) bilinearly at points (N, 3), constant beyond the outer cells' centres."""
    rows, columns = values.shape
    at = (local[:, :2] * scale - np.float32(0.5)).astype(np.float64)
    x, y = np.clip(at[:, 0], 0, columns - 1), np.clip(at[:, 1], 0, rows - 1)
    j, i = np.minimum(x.astype(np.int64), max(columns - 2, 0)), np.minimum(y.astype(np.int64), max(rows - 2, 0))
    u, v = x - j, y - i
    right, down = np.minimum(j + 1, columns - 1), np.minimum(i + 1, rows - 1)
    upper = values[i, j] * (1 - u) + values[i, right] * u
    lower = values[down, j] * (1 - u) + values[down, right] * u
    return np.asarray(upper * (1 - v) + lower * v, dtype=np.float32)
