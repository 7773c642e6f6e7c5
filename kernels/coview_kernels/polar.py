"""Polar binning: of the points around a sensor (VLS), and of a raster map around many stations (VRS)."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from coview_kernels import check, reference
from coview_kernels.arrays import PolarGrid


def polar_bin(
    points: npt.ArrayLike, centre: npt.ArrayLike, rings: int, sectors: int, r_max: float
) -> tuple[PolarGrid, int]:
    """Greatest height, sum of heights and number of points in rings x sectors around ``centre``.

    Height is z above ``centre``. Ring ``floor(r / (r_max / R))`` of the horizontal range r, points at or
    beyond ``r_max`` excluded; sector ``floor(theta / (2 pi / S))`` of theta = atan2(dy, dx) in [0, 2 pi),
    counter-clockwise from the x axis. A point on a ring edge belongs to the outer ring, on a sector edge to
    the sector counter-clockwise of it, at the centre to ring 0, sector 0; :mod:`coview_kernels.sectors` says
    how that is decided exactly (offsets from the centre are rounded to float32).

    Args:
        points: (N, 3) float32, metres.
        centre: (3,) in the frame of the points, metres.
        rings: R, at least 1.
        sectors: S, at least 1.
        r_max: outer radius, metres.

    Returns:
        The grid, (R, S) each, and the number of rows dropped because they hold NaN or inf.

    Raises:
        ValueError: a shape or a number is out of its range.
    """
    cloud = check.float32("points", points, None, 3)
    origin = check.finite64("centre", centre, 3)
    check.grid_size(rings, sectors, r_max)
    return reference.polar_bin(cloud, origin, rings, sectors, r_max)


def station_bins(
    raster_max: npt.ArrayLike,
    raster_count: npt.ArrayLike,
    raster_sum: npt.ArrayLike,
    cell: float,
    rows: npt.ArrayLike,
    cols: npt.ArrayLike,
    ground: npt.ArrayLike,
    rings: int,
    sectors: int,
    r_max: float,
) -> PolarGrid:
    """Virtual reference scans (VRS) of M stations, gathered from a raster of the base map.

    Station m stands at the centre of raster cell (rows[m], cols[m]) at height ground[m]; row runs along y,
    column along x. Every raster cell counts as ``raster_count`` points at its centre, so one table of (dx,
    dy) to bin, with the edges of :func:`polar_bin`, serves all stations. What lies outside the raster is
    empty. Memory for the result is 12 R S bytes a station: hand over stations in portions.

    Args:
        raster_max: (H, W) float32 greatest height of each cell, metres; ignored where the count is 0.
        raster_count: (H, W) int32 points (occupied voxels) of each cell; 0 marks an empty cell.
        raster_sum: (H, W) float32 sum of the heights of each cell, metres.
        cell: edge of the raster cells, metres.
        rows: (M,) int32 row of each station.
        cols: (M,) int32 column of each station.
        ground: (M,) float32 ground height at each station, metres, in the datum of the raster.
        rings: R, at least 1.
        sectors: S, at least 1.
        r_max: outer radius, metres.

    Returns:
        The grid, (M, R, S) each; heights above the station's ground.

    Raises:
        ValueError: shapes disagree, a station lies outside the raster, or a number is out of its range.
    """
    top = check.float32("raster_max", raster_max, None, None)
    count = check.int32("raster_count", raster_count, *top.shape)
    total = check.float32("raster_sum", raster_sum, *top.shape)
    row = check.int32("rows", rows, None)
    col = check.int32("cols", cols, len(row))
    base = check.float32("ground", ground, len(row))
    check.grid_size(rings, sectors, r_max)
    if not (math.isfinite(cell) and cell > 0):
        raise ValueError(f"cell must be finite and positive, got {cell}")
    if np.any((row < 0) | (row >= top.shape[0]) | (col < 0) | (col >= top.shape[1])):
        raise ValueError(f"rows and cols must lie inside the raster of {top.shape[0]} x {top.shape[1]} cells")
    return reference.station_bins(top, count, total, cell, row, col, base, rings, sectors, r_max)
