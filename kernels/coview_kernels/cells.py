"""Cells that sort a cloud, to find the points around a place."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coview_kernels.arrays import F32, F64, I32, I64

CELL = 1.0
"""Edge of the cells, metres; 0.5 to 1.5 are as fast for a point every 0.25 m, and small cells cost memory."""
_MAX_LAYERS = 128  # higher points share the topmost layer, so that a stray point in the sky does not enlarge all cells
_MAX_CELLS = 1 << 22  # 16 MB; a wider cloud has larger cells


class Cells(NamedTuple):
    """A cloud sorted by cell; cell (i, j, k) along x, y, z is number (i * ny + j) * nz + k."""

    frame: F64
    """(8,) lowest corner (3) and edge of the cells, metres, reciprocal of the edge, and nx, ny, nz."""
    starts: I32
    """(cells + 1,) first row in ``rows`` of each cell."""
    rows: I32
    """(4 K,) row by row, the bits of x, y, z as float32 and the point's index in the cloud, in one cache line."""


def grid_frame(low: F64, high: F64) -> F64:
    """Return the frame (8,) of cells for points between two corners (3,), with a larger edge if needed."""
    edge = CELL
    while True:
        shape = np.floor((high - low) / edge) + 1
        shape[2] = min(shape[2], _MAX_LAYERS)
        if shape.prod() <= _MAX_CELLS:
            return np.array([*low, edge, 1.0 / edge, *shape])
        edge *= 1.5


def cell_numbers(points: F32, frame: F64) -> I64:
    """Return the number (N,) of the cell, or the nearest cell, of each of (N, 3) points."""
    index = np.clip((points - frame[:3]) * frame[4], 0, frame[5:] - 1).astype(np.int64)
    _, ny, nz = frame[5:].astype(np.int64)
    return np.asarray((index[:, 0] * ny + index[:, 1]) * nz + index[:, 2])
