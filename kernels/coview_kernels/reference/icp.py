"""Trimmed point-to-plane ICP in plain NumPy, with SciPy's k-d tree; point-to-point where the map has no surface."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from coview_kernels.arrays import F32, F64, Mask
from coview_kernels.reference.nearest import nearest

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

SCATTER = 2.0
"""Distance between points that form no surface, in widths of the weights; set by hand."""

_MAX_SHARE = 5.0  # a handful of points must not outweigh thousands
_FIRST_BIN, _BINS = 107 << 6, 2048  # of squared distances: 64 per octave, from 2^-20 square metres up


class Scale(NamedTuple):
    """One scale of a registration."""

    radius: float
    """Largest distance to a partner (exclusive), metres."""
    width: float
    """Width of the Cauchy weights, metres."""
    shift: float = 1e-3
    """The scale ends with a step that is shorter than this, metres, ..."""
    turn: float = 5e-5
    """... and turns by less than this, radians."""
    every: int = 1
    """Every n-th point of each kind is used."""
    keep: float = 1.0
    """Share of the pairs of each kind that is kept, the nearest, in (0, 1]."""


class Plan(NamedTuple):
    """Arguments of :func:`coview_kernels.align_planes`, checked."""

    T: F64
    pivot: F64
    scales: tuple[Scale, ...]
    iterations: int
    min_pairs: int
    prior: tuple[F64, F64] | None


class Registration(NamedTuple):
    """Registered pose, its information matrix, and the fit of the points."""

    T_map_source: F64
    """(4, 4)."""
    information: F64
    """(6, 6) over (rx, ry, rz, x, y, z) about the moved pivot before the last step, including the prior."""
    rmse: float
    """Weighted root mean square of the kept residuals before the last step, metres."""
    pairs: int
    """Number of pairs kept at the last step."""
    iterations: int
    """Total over all scales."""
    converged: bool
    """Whether the last step was small enough to stop."""


def align_planes(tree: cKDTree, normals: F32, source: F32, kind: Mask, plan: Plan) -> Registration | None:
    """See :func:`coview_kernels.align_planes`; ``tree`` holds the map."""
    T, total, answer = plan.T, 0, None
    for scale in plan.scales:
        part = np.zeros(len(source), dtype=bool)
        for group in (kind, ~kind):
            part[np.flatnonzero(group)[:: scale.every]] = True
        for _ in range(plan.iterations):
            step = _step(tree, normals, source[part], kind[part], plan, T, scale)
            if step is None:
                return None
            increment, information, rmse, pairs = step
            T = _moved(T, increment, T[:3, :3] @ plan.pivot + T[:3, 3])
            total += 1
            turn, shift = np.linalg.norm(increment[:3]), np.linalg.norm(increment[3:])
            converged = bool(shift < scale.shift and turn < scale.turn)
            answer = Registration(T, information, rmse, pairs, total, converged)
            if converged:
                break
    return answer


def _step(
    tree: cKDTree, normals: F32, source: F32, kind: Mask, plan: Plan, T: F64, scale: Scale
) -> tuple[F64, F64, float, int] | None:
    """Take one Gauss-Newton step: increment (6,), information (6, 6), rmse and number of pairs."""
    distance, partner = nearest(tree, source, scale.radius, T)
    found = np.flatnonzero(np.isfinite(distance))
    pairs = partner[found]
    gap = source[found].astype(np.float64) @ T[:3, :3].T + T[:3, 3] - tree.data[pairs]
    share = _shares(np.einsum("ij,ij->i", gap, gap).astype(np.float32), kind[found], scale.keep, len(source))
    chosen = np.flatnonzero(share)
    if len(chosen) < plan.min_pairs:
        return None
    share, gap, pairs = share[chosen], gap[chosen], pairs[chosen]
    about = T[:3, :3] @ plan.pivot + T[:3, 3]
    H, b, mean_square = _normal_equations(gap + tree.data[pairs] - about, gap, normals[pairs], share, scale.width)
    information, gradient = H / (mean_square + 1e-6), b / (mean_square + 1e-6)
    if plan.prior is not None:
        mean, belief = plan.prior
        R = T[:3, :3] @ mean[:3, :3].T
        turn = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        shift = about - (mean[:3, :3] @ plan.pivot + mean[:3, 3])
        information = information + belief
        gradient = gradient + belief @ np.concatenate([turn, shift])
    increment = np.asarray(-np.linalg.solve(information + 1e-6 * np.eye(6), gradient), dtype=np.float64)
    return increment, information, float(np.sqrt(mean_square)), len(chosen)


def _normal_equations(arm: F64, gap: F64, normals: F32, share: F64, width: float) -> tuple[F64, F64, float]:
    """Return H (6, 6) = sum w J^T J, b (6,) = sum w J^T r, and the mean of r^2, for points at ``arm`` from the pivot.

    Along its partner's normal a pair has J = (arm x n, n), r = n . gap and w = p share / (1 + (r / width)^2), where the
    planarity p is the length of the partner's given normal. The rest, 1 - p, constrains all three directions:
    J = (arm x e, e) and r = e . gap for each axis e, with w = (1 - p) share / (4 + (|gap| / width)^2).
    """
    planarity = np.minimum(np.linalg.norm(normals.astype(np.float64), axis=1), 1.0)
    n = normals / np.maximum(planarity, 1e-9)[:, None]
    residual = np.einsum("ij,ij->i", gap, n)
    weight = share * planarity / (1.0 + (residual / width) ** 2)
    J = np.concatenate([np.cross(arm, n), n], axis=1)
    H: F64 = J.T @ (weight[:, None] * J)
    b: F64 = J.T @ (weight * residual)
    squares, total = weight @ (residual * residual), weight.sum()
    length = np.einsum("ij,ij->i", gap, gap)
    loose = share * (1.0 - planarity) / (SCATTER**2 + length / width**2)
    for axis in np.eye(3):
        J = np.concatenate([np.cross(arm, axis), np.broadcast_to(axis, arm.shape)], axis=1)
        H += J.T @ (loose[:, None] * J)
        b += J.T @ (loose * (gap @ axis))
    squares, total = squares + loose @ length, total + 3.0 * loose.sum()
    # BLAS rounds the two halves differently
    return 0.5 * (H + H.T), b, float(squares / total)


def _shares(squares: F32, kind: Mask, keep: float, points: int) -> F64:
    """Return weights (M,) of pairs by their squared distances, 0 for trimmed pairs, with equal sums for both kinds."""
    share = np.zeros(len(squares))
    bins = np.clip((squares.view(np.int32) >> 17) - _FIRST_BIN, 0, _BINS - 1)
    for group in (kind, ~kind):
        index = np.flatnonzero(group)
        if len(index):
            number = max(1, int(keep * len(index)))
            kept = index[bins[index] <= np.partition(bins[index], number - 1)[number - 1]]
            share[kept] = min(0.5 * points / len(kept), _MAX_SHARE)
    return share


def _moved(T: F64, increment: F64, about: F64) -> F64:
    """``Trans(about) exp(increment) Trans(-about) T``."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(increment[:3]).as_matrix()
    moved = np.eye(4)
    moved[:3, :3] = turn @ T[:3, :3]
    moved[:3, 3] = turn @ (T[:3, 3] - about) + about + increment[3:]
    return moved
