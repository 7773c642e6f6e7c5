"""First hits of rays on triangles in NumPy; all rays of a block descend the tree together."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from coview_kernels.arrays import F32, F64, I64, Mask

if TYPE_CHECKING:
    from coview_kernels.rays import TriangleTree

EDGE = 1e-9  # share of a triangle's side, so that no ray passes between two triangles at their edge
SLACK = 1e-9  # metres, and share of a distance: more than rounding moves a side of a box
THIN = 1e-18  # least double area of a triangle seen along the ray, m2
LEAST = 1e-30  # replaces zeros of a direction

_BLOCK = 4096  # rays


def cast_rays(tree: TriangleTree, rays: F32) -> tuple[F32, I64]:
    """See :func:`coview_kernels.cast_rays`; ``rays`` are origins and directions (N, 6)."""
    distance, found = np.full(len(rays), np.inf, dtype=np.float32), np.full(len(rays), -1, dtype=np.int64)
    for begin in range(0, len(rays), _BLOCK):
        part = rays[begin : begin + _BLOCK].astype(np.float64)
        ray, place, t = _pairs(tree, part)
        order = np.lexsort((t, ray))
        first = order[np.diff(ray[order], prepend=-1) > 0]
        distance[begin + ray[first]], found[begin + ray[first]] = t[first], tree.rows[place[first]]
    return distance, found


def _pairs(tree: TriangleTree, rays: F64) -> tuple[I64, I64, F64]:
    """Return the pairs of a ray and a triangle on it, by its place in the tree, with the distances."""
    leaves = len(tree.axes)
    size = len(tree.rows) // leaves
    ray: I64 = np.arange(len(rays))
    node: I64 = np.ones_like(ray)
    while True:
        inside = _enter(tree.boxes[node].astype(np.float64), rays[ray])
        ray, node = ray[inside], node[inside]
        if not len(ray) or node[0] >= leaves:
            break
        ray, node = np.repeat(ray, 2), np.column_stack([2 * node, 2 * node + 1]).ravel()
    ray, place = np.repeat(ray, size), ((node - leaves)[:, None] * size + np.arange(size)).ravel()
    t = _met(tree.corners[place].astype(np.float64).reshape(-1, 3, 3), rays[ray])
    hit = np.isfinite(t)
    return ray[hit], place[hit], t[hit]


def _enter(boxes: F64, rays: F64) -> Mask:
    origin, towards = rays[:, :3], np.where(np.abs(rays[:, 3:]) > LEAST, rays[:, 3:], LEAST)
    one, other = (boxes[:, :3] - origin) / towards, (boxes[:, 3:] - origin) / towards
    near, far = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
    return np.asarray(np.maximum(near, 0.0) <= far + SLACK * (1.0 + np.abs(far)))


def _met(corners: F64, rays: F64) -> F64:
    """Return the distances (N,) of triangles (N, 3, 3) along rays (N, 6), inf without a hit (Moeller 1997)."""
    origin, towards = rays[:, :3], rays[:, 3:]
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    side = np.cross(towards, other)
    size = np.einsum("ij,ij->i", one, side)
    flat = np.abs(size) <= THIN
    size[flat] = 1.0
    gap = origin - corners[:, 0]
    turned = np.cross(gap, one)
    u, v, t = (np.einsum("ij,ij->i", *two) / size for two in ((gap, side), (towards, turned), (other, turned)))
    hit = ~flat & (u >= -EDGE) & (v >= -EDGE) & (u + v <= 1.0 + EDGE) & (t >= 0.0)
    return np.where(hit, t, np.inf)
