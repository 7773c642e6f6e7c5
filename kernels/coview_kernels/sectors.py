"""Which ring and sector an offset falls into, decided the same way by every kernel.

An offset (dx, dy) is rounded to float32, so that its products are exact in float64. Both decisions then
compare exact numbers with a table, and neither fused multiply-add nor a vectorised sine can move a point
across an edge:

* ring k holds ``edge2[k] <= dx*dx + dy*dy < edge2[k + 1]``;
* sector k lies counter-clockwise of, or on, the ray ``edges[k]`` and clockwise of ``edges[k + 1]``; the rays
  are float32 directions, 6e-8 rad from 2 pi k / S at worst and exact on the axes.

So a point on a ring edge belongs to the outer ring, a point on a sector edge to the sector counter-clockwise
of it, and the centre itself to ring 0, sector 0.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from coview_kernels.arrays import F32, F64, I32, I64


@lru_cache(maxsize=64)
def ring_edges2(rings: int, r_max: float) -> F64:
    """(R + 1,) squared ring edges, metres squared; read-only."""
    edges: F64 = np.linspace(0.0, r_max, rings + 1) ** 2
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


@lru_cache(maxsize=64)
def sector_guesses(sectors: int, steps: int = 1024) -> I32:
    """(8, steps + 1) sector, give or take one, by octant and by the ratio of the smaller offset to the other.

    Octant is ``(|dy| > |dx|) + 2 (dx < 0) + 4 (dy < 0)``. Right while a sector is wider than a step: to some
    6000 sectors for 1024 steps. A kernel reads this instead of computing an angle; read-only.
    """
    ratio = np.minimum((np.arange(steps + 1) + 0.5) / steps, 1.0)
    one = np.ones_like(ratio)
    rows = []
    for octant in range(8):
        dx, dy = (ratio, one) if octant & 1 else (one, ratio)
        theta = np.arctan2(-dy if octant & 4 else dy, -dx if octant & 2 else dx) % (2.0 * np.pi)
        rows.append(np.minimum(theta * (sectors / (2.0 * np.pi)), sectors - 1))
    guesses = np.array(rows).astype(np.int32)
    guesses.flags.writeable = False
    return guesses


def polar_index(dx: F32, dy: F32, rings: int, sectors: int, r_max: float) -> I64:
    """Flat bin ``ring * S + sector`` of (N,) offsets in metres, -1 at and beyond ``r_max``."""
    x, y = dx.astype(np.float64), dy.astype(np.float64)
    ring = np.searchsorted(ring_edges2(rings, r_max), x * x + y * y, side="right") - 1

    theta = np.arctan2(y, x)
    theta[theta < 0] += 2.0 * np.pi
    guess = np.clip((theta * (sectors / (2.0 * np.pi))).astype(np.int64), 0, sectors - 1)
    edges = sector_edges(sectors)
    # the angle is right to 1e-15 or so: only an edge next to the guess can be on the wrong side
    lower, upper = edges[guess], edges[guess + 1]
    before = (lower[:, 0] * y < lower[:, 1] * x) & (lower[:, 0] * x + lower[:, 1] * y > 0)
    after = (upper[:, 0] * y >= upper[:, 1] * x) & (upper[:, 0] * x + upper[:, 1] * y > 0)
    sector = (guess - before + (after & ~before)) % sectors
    return np.where(ring < rings, ring * sectors + sector, -1).astype(np.int64)
