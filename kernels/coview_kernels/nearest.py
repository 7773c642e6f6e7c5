"""Nearest point of a cloud for many queries, by a grid over the cloud instead of a tree.

The cells of a column follow one another upwards, so the points of a stretch of a column are one stretch of memory. Map
clouds are surfaces: a column holds few points, and most queries look into one to four columns. One counting sort builds
the grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from coview_kernels import reference, runtime
from coview_kernels.arrays import F32, F64, I64, as_finite64, as_float32
from coview_kernels.cells import CELL, Cells, grid_frame
from coview_kernels.launch import Launch
from coview_kernels.warm_up import SAMPLE, compiled_by

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_EYE = np.eye(4)


@dataclass(frozen=True, eq=False)
class PointGrid:
    """A cloud for :func:`nearest`; the first search builds the backend's index.

    Attributes:
        points: (K, 3) float32, metres.

    Raises:
        ValueError: the points have a wrong shape, or hold NaN or inf.
    """

    points: F32

    def __post_init__(self) -> None:
        cloud = as_float32("points", self.points, None, 3)
        if not np.isfinite(cloud).all():
            raise ValueError("points hold NaN or inf")
        object.__setattr__(self, "points", cloud)

    @classmethod
    def sorted(cls, points: F32, cells: Cells) -> PointGrid:
        """Return the grid of finite points (K, 3) that are already sorted."""
        grid = cls.__new__(cls)
        vars(grid).update(points=points, cells=cells)
        return grid

    @cached_property
    def cells(self) -> Cells:
        """The points by cell, for the kernel; read it on the owner thread."""
        points = self.points
        if not len(points):
            return Cells(np.array([0.0, 0, 0, CELL, 1 / CELL, 1, 1, 1]), np.zeros(2, np.int32), np.empty(0, np.int32))
        # column by column, twenty times as fast as along the first axis
        low, high = (np.array([f(points[:, d]) for d in range(3)], dtype=np.float64) for f in (np.min, np.max))
        frame = grid_frame(low, high)
        starts = np.zeros(int(frame[5:].prod()) + 1, dtype=np.int32)
        cell = np.empty(len(points), dtype=np.int32)
        rows = np.empty(4 * len(points), dtype=np.int32)
        runtime.kernels("nearest").sort(points, frame, cell, starts, rows)
        return Cells(frame, starts, rows)

    @cached_property
    def tree(self) -> cKDTree:
        """The points in a k-d tree, for the NumPy twin."""
        from scipy.spatial import cKDTree

        # an unbalanced tree takes a third of the time to build, and is searched as fast
        return cKDTree(self.points, balanced_tree=False, compact_nodes=False)


def nearest(grid: PointGrid, queries: npt.ArrayLike, radius: float, T: npt.ArrayLike | None = None) -> tuple[F64, I64]:
    """Find the nearest point of a cloud within ``radius`` of each query; exact, with cKDTree.query's results.

    Args:
        grid: the cloud.
        queries: (N, 3) float32, metres. Rows with NaN or inf find nothing.
        radius: metres (exclusive).
        T: (4, 4) ``T_cloud_queries`` that moves the queries, in float64; None if they are in the cloud's frame.

    Returns:
        Distances (N,) float64 and indices (N,) into the cloud; inf and K without such a point. Any of several equally
        near points may be returned.

    Raises:
        ValueError: a shape is wrong, ``T`` is not finite, or ``radius`` is not finite and positive.
    """
    cloud = as_float32("queries", queries, None, 3)
    pose = None if T is None else as_finite64("T", T, 4, 4)
    if not (math.isfinite(radius) and radius > 0):
        raise ValueError(f"radius must be finite and positive, got {radius}")
    return runtime.dispatch_here(
        lambda: "cells" in vars(grid) and _launch.ready(),
        lambda: _nearest(grid, cloud, float(radius), pose),
        lambda: reference.nearest(grid.tree, cloud, radius, pose),
    )


_WHOLES = np.zeros(1, dtype=np.int32)
_launch = Launch("nearest", "nearest", np.zeros(8), _WHOLES, _WHOLES, np.zeros((1, 3), np.float32), _EYE, 1.0, _EYE)
"""One launch for all calls, as only one call of native code runs at a time."""


def _nearest(grid: PointGrid, queries: F32, radius: float, T: F64 | None) -> tuple[F64, I64]:
    cells = grid.cells
    answer = np.empty((2, len(queries)))
    answer[0], answer[1] = np.inf, len(grid.points)
    for index, value in enumerate((*cells, queries, _EYE if T is None else T, radius, answer)):
        _launch.put(index, value)
    _launch()
    return answer[0], answer[1].astype(np.int64)


SAMPLE_GRID = PointGrid.sorted(SAMPLE, Cells(np.ones(8), np.array([0, 2], np.int32), np.zeros(8, np.int32)))
"""A sorted cloud for the calls of :func:`compiled_by`, as most clouds come sorted from the map."""

compiled_by("nearest", lambda: nearest(SAMPLE_GRID, SAMPLE, 1.0))
compiled_by("PointGrid", lambda: nearest(PointGrid(SAMPLE), SAMPLE, 1.0))
