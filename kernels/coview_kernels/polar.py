"""Polar binning of the points around a sensor (VLS), and of a raster map around many stations (VRS)."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from coview_kernels import reference, runtime
from coview_kernels.arrays import F32, F64, I32, PolarGrid, as_finite64, as_float32, as_int32, check_grid_size
from coview_kernels.launch import Launch
from coview_kernels.reference.polar import cell_table, ring_edges2, sector_edges
from coview_kernels.warm_up import SAMPLE, compiled_by

_POINTS_PER_CHUNK = 8192  # fewer points take less time than waking another thread
_EXTRA = 3  # bins behind the grid's: points outside, not finite, near an edge
_EMPTY: F32 = np.empty(0, dtype=np.float32)


def polar_bin(
    points: npt.ArrayLike, centre: npt.ArrayLike, rings: int, sectors: int, r_max: float
) -> tuple[PolarGrid, int]:
    """Bin points in rings x sectors around ``centre``: greatest height, number and mean height.

    Height is z above ``centre``. The ring is ``floor(r / (r_max / R))`` for the horizontal range r < ``r_max``, the
    sector ``floor(theta / (2 pi / S))`` for theta = atan2(dy, dx) in [0, 2 pi), counter-clockwise from the x axis.
    :mod:`coview_kernels.reference.polar` defines the edges.

    Args:
        points: (N, 3) float32, metres.
        centre: (3,) in the frame of the points, metres.
        rings: R, at least 1.
        sectors: S, at least 1.
        r_max: outer radius, metres.

    Returns:
        The grid of arrays (R, S), and the number of rows dropped because of NaN or inf.

    Raises:
        ValueError: a shape or a number is out of its range.
    """
    cloud = as_float32("points", points, None, 3)
    origin = as_finite64("centre", centre, 3)
    check_grid_size(rings, sectors, r_max)
    reach = float(r_max)
    return runtime.dispatch(
        lambda: _bins(rings, sectors, reach)(cloud, origin),
        lambda: reference.polar_bin(cloud, origin, rings, sectors, reach),
    )


class _PolarBins:
    """Bins, edges and results of one grid size, kept between calls; for the owner thread only."""

    def __init__(self, rings: int, sectors: int, r_max: float) -> None:
        self._chunks = runtime.workers()
        self._size = rings * sectors
        shape = self._chunks, self._size + _EXTRA
        edges = np.concatenate([ring_edges2(rings, r_max), sector_edges(sectors).ravel()])
        self._params = np.array([0.0, 0.0, 0.0, rings / r_max])
        self._highest = np.empty(shape, dtype=np.float32)
        self._count = np.empty(shape, dtype=np.int32)
        self._total = np.empty(shape, dtype=np.float64)
        self._shape = rings, sectors
        self._launch = Launch(
            *("polar", "bins", _EMPTY, 0, 1, rings, sectors, self._params, edges),
            *(self._highest.reshape(-1), self._count.reshape(-1), self._total.reshape(-1)),
        )

    def __call__(self, points: F32, centre: F64) -> tuple[PolarGrid, int]:
        """Return the grid of the points (N, 3) around ``centre`` (3,), and the number of rows not finite."""
        self._params[:3] = centre
        self._highest.fill(-np.inf)
        self._count.fill(0)
        self._total.fill(0.0)
        chunks = min(self._chunks, 1 + len(points) // _POINTS_PER_CHUNK)
        for index, value in enumerate((points.reshape(-1), len(points), chunks)):
            self._launch.put(index, value)
        self._launch()
        self._launch.put(0, _EMPTY)  # keeps no cloud alive
        shape, size = self._shape, self._size
        top = np.maximum.reduce(self._highest[:, :size].reshape(-1, *shape), axis=0)
        count = np.add.reduce(self._count[:, :size].reshape(-1, *shape), axis=0, dtype=np.int32)
        top[count == 0] = 0.0
        mean = np.add.reduce(self._total[:, :size].reshape(-1, *shape), axis=0) / np.maximum(count, 1)
        return PolarGrid(top, count, mean.astype(np.float32)), int(self._count[:, size + 1].sum())


_bins = lru_cache(maxsize=8)(_PolarBins)


def station_bins(
    raster_max: npt.ArrayLike,
    raster_count: npt.ArrayLike,
    cell: float,
    rows: npt.ArrayLike,
    cols: npt.ArrayLike,
    ground: npt.ArrayLike,
    rings: int,
    sectors: int,
    r_max: float,
    raster_mean: npt.ArrayLike | None = None,
) -> PolarGrid:
    """Gather the virtual reference scans (VRS) of M stations from a raster of the base map.

    Station m is at the centre of raster cell (rows[m], cols[m]) at height ground[m]; rows run along y, columns along x.
    A raster cell counts as ``raster_count`` points at its centre, so that one table from (dx, dy) to bin, with the
    edges of :func:`polar_bin`, serves all stations. Outside the raster there is nothing. The result takes 8 R S bytes
    per station, 12 with means: pass stations in portions.

    Args:
        raster_max: (H, W) float32 greatest height of each cell, metres; ignored if the count is 0.
        raster_count: (H, W) int32 points (occupied voxels) of each cell; 0 marks an empty cell.
        cell: edge of the raster cells, metres.
        rows: (M,) int32 row of each station.
        cols: (M,) int32 column of each station.
        ground: (M,) float32 ground height at each station, metres, in the datum of the raster.
        rings: R, at least 1.
        sectors: S, at least 1.
        r_max: outer radius, metres.
        raster_mean: (H, W) float32 mean height of each cell, metres; adds mean heights to the grid.

    Returns:
        The grid of arrays (M, R, S), with heights above the station's ground.

    Raises:
        ValueError: shapes disagree, a station lies outside the raster, or a number is out of its range.
    """
    top = as_float32("raster_max", raster_max, None, None)
    count = as_int32("raster_count", raster_count, *top.shape)
    row = as_int32("rows", rows, None)
    col = as_int32("cols", cols, len(row))
    base = as_float32("ground", ground, len(row))
    mean = None if raster_mean is None else as_float32("raster_mean", raster_mean, *top.shape)
    check_grid_size(rings, sectors, r_max)
    if not (math.isfinite(cell) and cell > 0):
        raise ValueError(f"cell must be finite and positive, got {cell}")
    if np.any((row < 0) | (row >= top.shape[0]) | (col < 0) | (col >= top.shape[1])):
        raise ValueError(f"rows and cols must lie inside the raster of {top.shape[0]} x {top.shape[1]} cells")
    return runtime.dispatch(
        _station_bins,
        reference.station_bins,
        *(top, count, float(cell), row, col, base, rings, sectors, float(r_max), mean),
    )


def _station_bins(
    raster_max: F32, raster_count: I32, cell: float, rows: I32, cols: I32, ground: F32,
    rings: int, sectors: int, r_max: float, raster_mean: F32 | None = None,
) -> PolarGrid:  # fmt: skip
    d_row, d_col, bins = cell_table(cell, rings, sectors, r_max)
    starts = np.searchsorted(bins, np.arange(rings * sectors + 1)).astype(np.int32)
    reach = math.ceil(r_max / cell)
    # with a border as wide as the radius every neighbour is a plain offset, without bounds checks
    empty = raster_count <= 0
    lowest = np.finfo(np.float32).min
    top = np.pad(np.where(empty, lowest, raster_max), reach, constant_values=lowest)
    points = np.pad(np.where(empty, 0, raster_count).astype(np.int32), reach)
    width = top.shape[1]
    base = (rows.astype(np.int64) + reach) * width + cols + reach
    size = rings * sectors
    shape = (len(rows), rings, sectors)
    highest, number = np.zeros(shape, np.float32), np.zeros(shape, np.int32)
    parts = (len(rows), min(runtime.workers(), max(1, len(rows))), size)
    where = base.astype(np.int32), ground, starts, (d_row * width + d_col).astype(np.int32)
    Launch(
        *("polar", "station_bins", *parts, top.ravel(), points.ravel(), *where),
        *(highest.reshape(-1), number.reshape(-1)),
    )()
    if raster_mean is None:
        return PolarGrid(highest, number)
    mean = np.zeros(shape, np.float32)
    total = np.pad(np.where(empty, 0.0, raster_mean.astype(np.float64) * raster_count), reach)
    Launch("polar", "station_means", *parts, total.ravel(), *where, number.reshape(-1), mean.reshape(-1))()
    return PolarGrid(highest, number, mean)


_CENTRE, _ONE, _INDEX = (0.0, 0.0, 0.0), np.ones((1, 1)), np.zeros(1, dtype=np.int32)
compiled_by("polar_bin", lambda: polar_bin(SAMPLE, _CENTRE, 2, 4, 8.0))
compiled_by("station_bins", lambda: station_bins(_ONE, _ONE, 1.0, _INDEX, _INDEX, _INDEX, 2, 4, 2.0))
