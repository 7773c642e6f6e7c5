"""Points around a place, cut out of a map, in plain NumPy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coview_kernels.arrays import F32, I8, I32
from coview_kernels.cells import Cells, cell_numbers, grid_frame


class Cut(NamedTuple):
    """Circle to cut out of a map, metres; excludes its edge."""

    x: float
    y: float
    radius: float


class Crop(NamedTuple):
    """Points around a place."""

    points: F32
    """(K, 3) metres, by cell; a view of ``cells.rows``, not contiguous."""
    normals: F32
    """(K, 3) unit normals times the planarity around each point."""
    cells: Cells
    """Cells of these points, in their order."""


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
    frame = grid_frame(low, high)
    number = cell_numbers(near, frame)
    order = np.argsort(number, kind="stable")
    starts = np.searchsorted(number[order], np.arange(int(frame[5:].prod()) + 1)).astype(np.int32)
    rows = np.empty((len(near), 4), dtype=np.int32)
    rows[:, :3], rows[:, 3] = near[order].view(np.int32), np.arange(len(near))
    planes = normals[wanted[order]].astype(np.float32)
    planes /= 127.0
    return Crop(rows.view(np.float32)[:, :3], planes, Cells(frame, starts, rows.reshape(-1)))
