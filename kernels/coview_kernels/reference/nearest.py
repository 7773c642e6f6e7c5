"""Nearest neighbours by SciPy's k-d tree."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from coview_kernels.arrays import F32, F64, I64

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


def nearest(tree: cKDTree, queries: F32, radius: float, T: F64 | None = None) -> tuple[F64, I64]:
    """See :func:`coview_kernels.nearest`; ``tree`` holds the cloud."""
    moved = queries.astype(np.float64)
    finite = np.isfinite(moved).all(axis=1)
    moved[~finite] = 0.0
    if T is not None:
        moved = moved @ T[:3, :3].T + T[:3, 3]
    distance, index = tree.query(moved, distance_upper_bound=radius)
    distance[~finite], index[~finite] = np.inf, tree.n
    return distance, index
