"""Polar binning of points and of raster cells in plain NumPy, with the same rings and sectors as every kernel.

An offset (dx, dy) is rounded to float32, so that its products are exact in float64. Both decisions compare exact
numbers with a table, so neither fused multiply-add nor a vectorised sine can move a point across an edge:

* ring k holds ``edge2[k] <= dx*dx + dy*dy < edge2[k + 1]``;
* sector k lies counter-clockwise of, or on, the ray ``edges[k]`` and clockwise of ``edges[k + 1]``; the rays are
  float32 directions, 6e-8 rad from 2 pi k / S at worst and exact on the axes.

A point on a ring edge belongs to the outer ring, a point on a sector edge to the sector counter-clockwise of it, the
centre to ring 0, sector 0. Offsets below 1e-37 m may count as zero, as Taichi's threads flush subnormal numbers.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from coview_kernels.arrays import F32, F64, I32, I64, PolarGrid


@lru_cache(maxsize=64)
def ring_edges2(rings: int, r_max: float) -> F64:
    """Return the squared ring edges (R + 1,), square metres; read-only."""
    edges: F64 = np.square(np.linspace(0.0, r_max, rings + 1, dtype=np.float64))
    edges.flags.writeable = False
    return edges


@lru_cache(maxsize=64)
def sector_edges(sectors: int) -> F64:
    """Return the directions (S + 1, 2) of the sector edges, float32 values in float64; read-only."""
    angle = np.arange(sectors + 1) * (2.0 * np.pi / sectors)
    rays = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rays[np.abs(rays) < 1e-12] = 0.0  # the axes must be exact, as points of raster maps lie on them
    rays[-1] = rays[0]
    edges = rays.astype(np.float32).astype(np.float64)
    edges.flags.writeable = False
    return edges


def polar_index(dx: F32, dy: F32, rings: int, sectors: int, r_max: float) -> I64:
    """Return the flat bin ``ring * S + sector`` of offsets (N,) in metres, -1 at and beyond ``r_max``."""
    x, y = dx.astype(np.float64) + 0.0, dy.astype(np.float64) + 0.0  # turns -0 into 0, which arctan2 distinguishes
    r2 = x * x + y * y
    edge2 = ring_edges2(rings, r_max)
    inside = r2 < edge2[-1]
    ring = np.minimum(np.sqrt(np.where(inside, r2, 0.0)) * (rings / r_max), rings - 1).astype(np.int64)
    # the guesses are accurate to about 1e-15: only the edge next to them can be on the wrong side
    ring += (r2 >= edge2[ring + 1]).astype(np.int64) - (r2 < edge2[ring])

    theta = np.arctan2(y, x)
    theta[theta < 0] += 2.0 * np.pi
    sector = np.minimum(theta * (sectors / (2.0 * np.pi)), sectors - 1).astype(np.int64)
    ray_x, ray_y = np.ascontiguousarray(sector_edges(sectors).T)
    lx, ly, ux, uy = ray_x[sector], ray_y[sector], ray_x[sector + 1], ray_y[sector + 1]
    before = (lx * y < ly * x) & (lx * x + ly * y > 0)
    after = (ux * y >= uy * x) & (ux * x + uy * y > 0)
    sector = (sector - before + (after & ~before)) % sectors
    return np.where(inside, ring * sectors + sector, -1).astype(np.int64)


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
    mean = (np.bincount(bins, weights=height, minlength=size) / np.maximum(count, 1)).astype(np.float32)
    shape = (rings, sectors)
    grid = PolarGrid(highest.reshape(shape), count.reshape(shape), mean.reshape(shape))
    return grid, int(np.count_nonzero(~finite))


def cell_table(cell: float, rings: int, sectors: int, r_max: float) -> tuple[I64, I64, I64]:
    """Return row offset, column offset and flat bin of every raster cell within ``r_max``, sorted by bin."""
    reach = math.ceil(r_max / cell)
    steps = np.arange(-reach, reach + 1)
    rows, cols = (a.ravel() for a in np.meshgrid(steps, steps, indexing="ij"))
    offset = (np.stack([cols, rows]) * cell).astype(np.float32)
    bins = polar_index(offset[0], offset[1], rings, sectors, r_max)
    order = np.argsort(bins, kind="stable")
    order = order[bins[order] >= 0]
    return rows[order], cols[order], bins[order]


def station_bins(
    raster_max: F32, raster_count: I32, cell: float, rows: I32, cols: I32, ground: F32,
    rings: int, sectors: int, r_max: float, raster_mean: F32 | None = None,
) -> PolarGrid:  # fmt: skip
    """See :func:`coview_kernels.station_bins`."""
    d_row, d_col, bins = cell_table(cell, rings, sectors, r_max)
    occupied_bins, starts = np.unique(bins, return_index=True)
    reach = math.ceil(r_max / cell)
    # with a border as wide as the radius every neighbour is a plain offset, without bounds checks
    empty = raster_count <= 0
    count_pad = np.pad(np.where(empty, 0, raster_count), reach).ravel()
    max_pad = np.pad(np.where(empty, -np.inf, raster_max), reach, constant_values=-np.inf).ravel()
    width = raster_max.shape[1] + 2 * reach
    offsets = d_row * width + d_col

    size = (len(rows), rings * sectors)
    highest, count, mean = np.zeros(size, np.float32), np.zeros(size, np.int32), np.zeros(size, np.float32)
    sums = None
    if raster_mean is not None:
        sums = np.pad(np.where(empty, 0.0, raster_mean.astype(np.float64) * raster_count), reach).ravel()
    for m, (row, col, base) in enumerate(zip(rows, cols, ground.astype(np.float64), strict=True)):
        at = offsets + ((int(row) + reach) * width + int(col) + reach)
        n = np.add.reduceat(count_pad[at], starts)
        top = np.maximum.reduceat(max_pad[at], starts)
        highest[m, occupied_bins] = np.where(n > 0, top - base, 0.0)
        count[m, occupied_bins] = n
        if sums is not None:
            total = np.add.reduceat(sums[at], starts)
            mean[m, occupied_bins] = np.where(n > 0, total / np.maximum(n, 1) - base, 0.0)
    shape = (len(rows), rings, sectors)
    return PolarGrid(highest.reshape(shape), count.reshape(shape), None if sums is None else mean.reshape(shape))
