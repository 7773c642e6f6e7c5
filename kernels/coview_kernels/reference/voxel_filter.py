"""Rigid transform, range filter and first point of each voxel in plain NumPy."""

from __future__ import annotations

import math

import numpy as np

from coview_kernels.arrays import F32, F64, I64


def transform_unique(
    points: F32,
    T: F64,
    voxel: float,
    r_min: float = 0.0,
    r_max: float = math.inf,
    centre: tuple[float, ...] = (0, 0, 0),
) -> tuple[F32, int]:
    """See :func:`coview_kernels.transform_unique`."""
    x, y, z = points.astype(np.float64).T
    # written out, not a BLAS product, because the kernel must round in the same order
    with np.errstate(over="ignore", invalid="ignore"):
        r2 = (x - centre[0]) * (x - centre[0]) + (y - centre[1]) * (y - centre[1]) + (z - centre[2]) * (z - centre[2])
        moved = np.stack([row[0] * x + row[1] * y + row[2] * z + row[3] for row in T[:3]], axis=1)
        moved = moved.astype(np.float32)
    finite = np.isfinite(points).all(axis=1) & np.isfinite(moved).all(axis=1)
    moved = moved[finite & (r2 >= r_min * r_min) & (r2 < r_max * r_max)]
    if voxel > 0 and len(moved):
        moved = moved[_first_of_each(np.floor(moved.astype(np.float64) * (1.0 / voxel)))]
    return moved, int(np.count_nonzero(~finite))


def _first_of_each(cells: F64) -> I64:
    """Return the ascending indices of the first row of each distinct value in (N, 3) integral ``cells``."""
    offset = cells - cells.min(axis=0)
    spans = offset.max(axis=0) + 1.0
    if spans.prod() < 2.0**62:
        index = offset.astype(np.int64)
        packed = (index[:, 0] * int(spans[1]) + index[:, 1]) * int(spans[2]) + index[:, 2]
        first = np.unique(packed, return_index=True)[1]
    else:
        first = np.unique(cells + 0.0, axis=0, return_index=True)[1]
    return np.sort(first)
