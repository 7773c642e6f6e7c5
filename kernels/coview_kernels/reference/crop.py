"""Points around a place, cut out of a map, in plain NumPy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coview_kernels.arrays import F32, F64, I8, I32
from coview_kernels.cells import CELL, Cells, cell_numbers, grid_frame

LOWEST = np.float32(-1e6)
"""Height of a cell of the raster that has no point, metres."""


class Cut(NamedTuple):
    """What to cut out of a map, and what to make of it."""

    x: float
    y: float
    radius: float
    """Metres around (x, y), exclusive."""
    every: int
    """Of so many points, in the map's order, one is in the sample."""
    cell: float
    """Edge of the raster's cells, metres."""

    def raster(self, low: F64, high: F64) -> tuple[F64, tuple[int, int]]:
        """Lower corner (2,) and shape of the raster for points between two corners: two cells of margin."""
        corner = low[:2] - 2 * self.cell
        last = np.floor((high[:2] - corner) * (1.0 / self.cell)).astype(np.int64)
        return corner, (int(last[0]) + 3, int(last[1]) + 3)


class Crop(NamedTuple):
    """Points around a place."""

    points: F32
    """(K, 3) metres, by cell; a view of ``cells.rows``, not contiguous."""
    normals: F32
    """(K, 3), as long as the planarity around each point."""
    cells: Cells
    """Of these points, with the order that they have."""
    sample: F32
    """(S, 3) one of so many points."""
    top: F32
    """(H, W) height of the highest point in each cell of the raster, rows along x; ``LOWEST`` where there is none."""
    corner: F64
    """(2,) x and y of its first cell's corner."""


def crop_points(points: F32, normals: I8, spans: I32, cut: Cut) -> Crop | None:
    """See :func:`coview_kernels.crop_points`."""
    wanted = np.concatenate([np.arange(*span) for span in spans.tolist()] or [np.empty(0, dtype=np.int64)])
    near = points[wanted]
    dx, dy = near[:, 0] - np.float64(cut.x), near[:, 1] - np.float64(cut.y)
    inside = (dx * dx + dy * dy < cut.radius * cut.radius) & np.isfinite(near[:, 2])
    near, wanted = near[inside], wanted[inside]
    if not len(near):
        return None
    low, high = near.min(axis=0).astype(np.float64), near.max(axis=0).astype(np.float64)
    corner, shape = cut.raster(low, high)
    top = np.full(shape, LOWEST)
    i, j = np.floor((near[:, :2] - corner) * (1.0 / cut.cell)).astype(np.int64).T
    np.maximum.at(top, (i, j), near[:, 2])
    frame = grid_frame(low, high, CELL)
    number = cell_numbers(near, frame)
    order = np.argsort(number, kind="stable")
    starts = np.searchsorted(number[order], np.arange(int(frame[5:].prod()) + 1)).astype(np.int32)
    rows = np.empty((len(near), 4), dtype=np.int32)
    rows[:, :3], rows[:, 3] = near[order].view(np.int32), np.arange(len(near))
    planes = normals[wanted[order]].astype(np.float32)
    planes /= 127.0
    cells = Cells(frame, starts, rows.reshape(-1))
    return Crop(rows.view(np.float32)[:, :3], planes, cells, near[:: cut.every], top, corner)
