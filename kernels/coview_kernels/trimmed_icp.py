"""Eq. 13: the two numerical steps of trimmed ICP between which the nearest-neighbour search sits, in NumPy.

For those who build a registration of their own; :func:`coview_kernels.align_planes` does all of it in one kernel.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from coview_kernels import check, reference
from coview_kernels.arrays import F32, F64


def normal_equations(
    source: npt.ArrayLike,
    target: npt.ArrayLike,
    normals: npt.ArrayLike | None,
    weights: npt.ArrayLike,
    T: npt.ArrayLike,
    centre: npt.ArrayLike,
) -> tuple[F64, F64, float]:
    """Gauss-Newton normal equations of weighted point pairs, in one pass.

    Residual of a pair: n . (T p - q), point to plane, or the vector T p - q where ``normals`` is None. The
    increment xi = (rx, ry, rz, x, y, z), radians and metres, acts on the left about ``centre``: ``T_new =
    Trans(centre) exp(xi) Trans(-centre) T``, with xi = -solve(H, b). Turning about the middle of the cloud
    keeps rotation and translation apart and H well conditioned far from the origin; callers pass the mean of
    T p.

    Args:
        source: (N, 3) float32 points p, source frame, metres.
        target: (N, 3) float32 partners q, target frame.
        normals: (N, 3) float32 unit normals at q, or None for point to point.
        weights: (N,) float32. Rows with weight 0, or with NaN or inf anywhere, contribute nothing.
        T: (4, 4) ``T_target_source``.
        centre: (3,) target frame, metres.

    Returns:
        H (6, 6) = sum w J^T J, b (6,) = sum w J^T r and cost = sum w r^2, all float64.

    Raises:
        ValueError: shapes disagree, or ``T`` or ``centre`` is not finite.
    """
    p = check.float32("source", source, None, 3)
    q = check.float32("target", target, len(p), 3)
    n = None if normals is None else check.float32("normals", normals, len(p), 3)
    w = check.float32("weights", weights, len(p))
    pose, middle = check.finite64("T", T, 4, 4), check.finite64("centre", centre, 3)
    return reference.normal_equations(p, q, n, w, pose, middle)


def trim(distances: npt.ArrayLike, keep: float) -> F32:
    """Weight 1 for the floor(keep * N) smallest distances, at least one, and 0 for the others.

    Distances that are not finite are never kept, though they count in N; of equal distances at the border any
    may be kept. NumPy's partition is the implementation.

    Args:
        distances: (N,) metres, or their squares.
        keep: share of the N pairs in (0, 1]; the paper's overlap, 0.6.

    Returns:
        (N,) float32.

    Raises:
        ValueError: not one axis, or ``keep`` outside (0, 1].
    """
    d = check.float32("distances", distances, None)
    if not 0 < keep <= 1:
        raise ValueError(f"keep must lie in (0, 1], got {keep}")
    weights = np.zeros(len(d), dtype=np.float32)
    finite = np.flatnonzero(np.isfinite(d))
    if len(finite) == 0:
        return weights
    number = max(1, int(keep * len(d)))
    if number < len(finite):
        finite = finite[np.argpartition(d[finite], number - 1)[:number]]
    weights[finite] = 1.0
    return weights
