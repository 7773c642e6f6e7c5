"""Polar binning of points and of raster cells in plain NumPy."""

from __future__ import annotations

import math

import numpy as np

from coview_kernels.arrays import F32, F64, I32, I64, PolarGrid, Vertical
from coview_kernels.reference.covisibility import coview
from coview_kernels.sectors import polar_index


def polar_bin(points: F32, centre: F64, rings: int, sectors: int, r_max: float) -> tuple[PolarGrid, int]:
    """See :func:`coview_kernels.polar_bin`."""
    finite = np.isfinite(points).all(axis=1)
    with np.errstate(over="ignore"):
        offset = (points[finite].astype(np.float64) - centre).astype(np.float32)
    bins = polar_index(offset[:, 0], offset[:, 1], rings, sectors, r_max)
    inside = bins >= 0
    bins, height = bins[inside], offset[inside, 2]

    size = rings * sectors
    count = np.bincount(bins, minlength=size).astype(np.int32)
    highest = np.full(size, -np.inf, dtype=np.float32)
    np.maximum.at(highest, bins, height)
    highest[count == 0] = 0.0
    shape = (rings, sectors)
    grid = PolarGrid(highest.reshape(shape), count.reshape(shape))
    return grid, int(np.count_nonzero(~finite))


def describe_points(
    points: F32, centre: F64, rings: int, sectors: int, r_max: float, vertical: Vertical = "max"
) -> tuple[PolarGrid, F32, int]:
    """See :func:`coview_kernels.describe_points`."""
    grid, dropped = polar_bin(points, centre, rings, sectors, r_max)
    return grid, coview(*grid, vertical=vertical), dropped


def cell_table(cell: float, rings: int, sectors: int, r_max: float) -> tuple[I64, I64, I64]:
    """Row offset, column offset and flat bin of every raster cell within ``r_max``, sorted by bin."""
    reach = math.ceil(r_max / cell)
    steps = np.arange(-reach, reach + 1)
    rows, cols = (a.ravel() for a in np.meshgrid(steps, steps, indexing="ij"))
    offset = (np.stack([cols, rows]) * cell).astype(np.float32)
    bins = polar_index(offset[0], offset[1], rings, sectors, r_max)
    order = np.argsort(bins, kind="stable")
    order = order[bins[order] >= 0]
    return rows[order], cols[order], bins[order]


def station_bins(
    raster_max: F32,
    raster_count: I32,
    cell: float,
    rows: I32,
    cols: I32,
    ground: F32,
    rings: int,
    sectors: int,
    r_max: float,
) -> PolarGrid:
    """See :func:`coview_kernels.station_bins`."""
    d_row, d_col, bins = cell_table(cell, rings, sectors, r_max)
    occupied_bins, starts = np.unique(bins, return_index=True)
    reach = math.ceil(r_max / cell)
    # a border as wide as the radius makes every neighbour a plain offset, without bounds checks
    empty = raster_count <= 0
    count_pad = np.pad(np.where(empty, 0, raster_count), reach).ravel()
    max_pad = np.pad(np.where(empty, -np.inf, raster_max), reach, constant_values=-np.inf).ravel()
    width = raster_max.shape[1] + 2 * reach
    offsets = d_row * width + d_col

    size = (len(rows), rings * sectors)
    highest, count = np.zeros(size, np.float32), np.zeros(size, np.int32)
    for m, (row, col, base) in enumerate(zip(rows, cols, ground.astype(np.float64), strict=True)):
        at = offsets + ((int(row) + reach) * width + int(col) + reach)
        n = np.add.reduceat(count_pad[at], starts)
        top = np.maximum.reduceat(max_pad[at], starts)
        highest[m, occupied_bins] = np.where(n > 0, top - base, 0.0)
        count[m, occupied_bins] = n
    shape = (len(rows), rings, sectors)
    return PolarGrid(highest.reshape(shape), count.reshape(shape))
