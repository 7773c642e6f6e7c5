"""Ring and sector of an offset, decided in the same way by every kernel.

An offset (dx, dy) is rounded to float32, so that its products are exact in float64. Both decisions then
compare exact numbers with a table, and neither fused multiply-add nor a vectorised sine can move a point
across an edge:

* ring k holds ``edge2[k] <= dx*dx + dy*dy < edge2[k + 1]``;
* sector k lies counter-clockwise of, or on, the ray ``edges[k]`` and clockwise of ``edges[k + 1]``; the rays
  are float32 directions, 6e-8 rad from 2 pi k / S at worst and exact on the axes.

So a point on a ring edge belongs to the outer ring, a point on a sector edge to the sector counter-clockwise
of it, and the centre itself to ring 0, sector 0. Offsets below 1e-37 m may count as zero: Taichi's
threads flush subnormal numbers.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from coview_kernels.arrays import F32, F64, I64


@lru_cache(maxsize=64)
def ring_edges2(rings: int, r_max: float) -> F64:
    """(R + 1,) squared ring edges, metres squared; read-only."""
    edges: F64 = np.square(np.linspace(0.0, r_max, rings + 1, dtype=np.float64))
    edges.flags.writeable = False
    return edges


@lru_cache(maxsize=64)
def sector_edges(sectors: int) -> F64:
    """(S + 1, 2) directions of the sector edges, float32 values held in float64; read-only."""
    angle = np.arange(sectors + 1) * (2.0 * np.pi / sectors)
    rays = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rays[np.abs(rays) < 1e-12] = 0.0  # the axes must be exact: points of raster maps lie on them
    rays[-1] = rays[0]
    edges = rays.astype(np.float32).astype(np.float64)
    edges.flags.writeable = False
    return edges


def polar_index(dx: F32, dy: F32, rings: int, sectors: int, r_max: float) -> I64:
    """Flat bin ``ring * S + sector`` of (N,) offsets in metres, -1 at and beyond ``r_max``."""
    x, y = dx.astype(np.float64) + 0.0, dy.astype(np.float64) + 0.0  # -0 + 0 is 0: arctan2 tells them apart
    r2 = x * x + y * y
    edge2 = ring_edges2(rings, r_max)
    inside = r2 < edge2[-1]
    ring = np.minimum(np.sqrt(np.where(inside, r2, 0.0)) * (rings / r_max), rings - 1).astype(np.int64)
    # the guesses are right to 1e-15 or so: only the edge next to them can be on the wrong side
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
