"""First hits of rays on triangles, by a tree of boxes: each level halves the triangles of a box.

The nodes are numbered as in a heap: 1 is the root, 2 n and 2 n + 1 are the children of n, and all leaves, equally
full, are on the last level. A ray needs no stack, because siblings and parents follow from the number.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from coview_kernels import reference, runtime
from coview_kernels.arrays import F32, I32, I64, as_float32, as_int32
from coview_kernels.warm_up import SAMPLE, compiled_by


class TriangleTree(NamedTuple):
    """Triangles for :func:`cast_rays`, sorted by :func:`triangle_tree`."""

    boxes: F32
    """(2 L, 6) least and greatest x, y, z of each node of a tree with L leaves; the first row is not used."""
    axes: I32
    """(L,) axis along which the children of a node lie side by side, the first child lower."""
    corners: F32
    """(M, 9) corners of the triangles by leaf; some triangles appear twice to fill the leaves."""
    rows: I32
    """(M,) rows of these triangles among the given triangles."""


def triangle_tree(vertices: npt.ArrayLike, triangles: npt.ArrayLike) -> TriangleTree:
    """Sort triangles into a tree.

    Args:
        vertices: (V, 3) float32, metres.
        triangles: (K, 3) int32, rows of vertices; K at least 1.

    Raises:
        ValueError: an array has the wrong shape, NaN or inf, there is no triangle, or a row does not exist.
    """
    points, corners = as_float32("vertices", vertices, None, 3), as_int32("triangles", triangles, None, 3)
    if not len(corners) or not np.isfinite(points).all():
        raise ValueError("vertices hold NaN or inf, or there is no triangle")
    if corners.min() < 0 or corners.max() >= len(points):
        raise ValueError(f"triangles name vertices beyond {len(points)}")
    levels = max(0, (len(corners) // 2).bit_length() - 1)  # two to four triangles per leaf
    leaves = 1 << levels
    rows = np.resize(np.arange(len(corners), dtype=np.int32), leaves * -(-len(corners) // leaves))
    centres = points[corners].mean(axis=1)
    axes = np.zeros(leaves, dtype=np.int32)
    for level in range(levels):  # halve each node's triangles along its longest side
        nodes = centres[rows].reshape(1 << level, -1, 3)
        axis = (nodes.max(axis=1) - nodes.min(axis=1)).argmax(axis=1)
        axes[1 << level : 2 << level] = axis
        along = np.take_along_axis(nodes, axis[:, None, None], axis=2)[..., 0]
        order = along.argpartition(along.shape[1] // 2, axis=1)
        rows = np.take_along_axis(rows.reshape(1 << level, -1), order, axis=1).ravel()
    inside = points[corners[rows]]
    boxes = np.zeros((2 * leaves, 6), dtype=np.float32)
    shape = (leaves, -1, 3)
    boxes[leaves:, :3], boxes[leaves:, 3:] = inside.reshape(shape).min(axis=1), inside.reshape(shape).max(axis=1)
    for level in reversed(range(levels)):
        children = boxes[2 << level : 4 << level].reshape(1 << level, 2, 6)
        boxes[1 << level : 2 << level, :3] = children[..., :3].min(axis=1)
        boxes[1 << level : 2 << level, 3:] = children[..., 3:].max(axis=1)
    return TriangleTree(boxes, axes, np.ascontiguousarray(inside.reshape(-1, 9)), rows)


def cast_rays(tree: TriangleTree, origins: npt.ArrayLike, directions: npt.ArrayLike) -> tuple[F32, I64]:
    """Return the distance (N,) to the first triangle on each ray, and its row (N,); inf and -1 without a hit.

    Args:
        tree: the triangles; rays hit both sides.
        origins: (N, 3) float32, metres.
        directions: (N, 3) float32 of unit length.

    Raises:
        ValueError: an array has the wrong shape, or the numbers of origins and directions differ.
    """
    rays = np.hstack([as_float32("origins", origins, None, 3), as_float32("directions", directions, None, 3)])
    return runtime.dispatch(_cast, reference.cast_rays, tree, np.ascontiguousarray(rays))


def _cast(tree: TriangleTree, rays: F32) -> tuple[F32, I64]:
    distance, found = np.empty(len(rays), dtype=np.float32), np.empty(len(rays), dtype=np.int32)
    if len(rays):
        native = runtime.kernels("rays")
        native.cast(tree.boxes.reshape(-1), tree.axes, tree.corners.reshape(-1), rays.reshape(-1), distance, found)
    return distance, np.where(found < 0, -1, tree.rows[found]).astype(np.int64)


compiled_by("cast_rays", lambda: cast_rays(triangle_tree(np.eye(3), [[0, 1, 2]]), SAMPLE, SAMPLE))
