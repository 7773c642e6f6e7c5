"""Trimmed point-to-plane ICP (eq. 13), coarse to fine, with robust weights and a prior.

Where the map's points form no surface, as in a crown or a hedge, a normal means nothing, and a pair constrains all
three directions, each less precisely. The length of the map's normals weighs the two cases.

An iteration is one prepared launch, with its searches spread over the threads. A search also returns a lower bound of
the distances of all other map points. While the point has moved less than this bound allows, its partner is the same
(exactly, by the triangle inequality) and is not searched. Late iterations, with steps of centimetres, hardly search.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from coview_kernels import reference, runtime
from coview_kernels.arrays import F32, F64, I64, Mask, as_finite64, as_float32, check_same_shape
from coview_kernels.launch import Launch
from coview_kernels.nearest import SAMPLE_GRID, PointGrid
from coview_kernels.reference.icp import SCATTER, Plan, Registration, Scale
from coview_kernels.warm_up import SAMPLE, compiled_by

__all__ = ["SCATTER", "Prior", "Registration", "Scale", "align_planes"]

_TOTAL, _STATUS, _CONVERGED, _INFORMATION, _SUMS = 14, 15, 16, 17, 53
_LOST = 2
_BINS = 2048
_FAR = 1e18  # metres: coordinate of a missing partner


class Prior(NamedTuple):
    """A Gaussian prior of the pose, by its information matrix, which may leave directions free."""

    T_map_source: F64
    """(4, 4) mean."""
    information: F64
    """(6, 6) over (rx, ry, rz, x, y, z): a rotation about the pivot, then a shift, in map axes."""


def align_planes(
    grid: PointGrid,
    normals: npt.ArrayLike,
    source: npt.ArrayLike,
    kind: npt.ArrayLike,
    T: npt.ArrayLike,
    pivot: npt.ArrayLike,
    scales: Sequence[Scale],
    *,
    iterations: int,
    min_pairs: int = 50,
    prior: Prior | None = None,
) -> Registration | None:
    """Register points to a map of points with normals.

    An iteration pairs every point with its nearest map point within the scale's radius. For each kind of point it keeps
    the floor(keep * pairs) nearest pairs, at least one, and all pairs as far as the last of these, to a hundredth.
    (Coarse scales should keep all: far from convergence, the nearest pairs support a wrong pose.) Then it takes a
    Gauss-Newton step on sum w r^2 + v |T p - q|^2, where r = n . (T p - q) with the unit normal n,
    w = P share / (1 + (r / width)^2) and v = (1 - P) share / (4 + (|T p - q| / width)^2), and P is the planarity. The
    share, 5 at most, gives both kinds the same total weight for any numbers of points. A coarse scale may use every
    n-th point of each kind; the next scale continues from its result.

    Args:
        grid: the map, (K, 3).
        normals: (K, 3) float32, its unit normals times the planarity around each point, 1 on a surface, 0 in scatter.
        source: (N, 3) float32, source frame, metres. Rows with NaN or inf find no partner.
        kind: (N,) bool, the kind of each point, as above or on the ground.
        T: (4, 4) initial ``T_map_source``.
        pivot: (3,) source-frame centre of rotations.
        scales: coarse to fine.
        iterations: maximum on each scale.
        min_pairs: least number of kept pairs of a step, at least 1.
        prior: fused with the normal equations of the pairs.

    Returns:
        The pose with its evidence, or None if too few points find a partner.

    Raises:
        ValueError: a shape is wrong, a pose not finite, or a setting out of its range; the message names it.
    """
    points = as_float32("source", source, None, 3)
    of = np.ascontiguousarray(kind, dtype=bool)
    check_same_shape("kind", of, "one value per point", (len(points),))
    planes = as_float32("normals", normals, len(grid.points), 3)
    if iterations < 1 or not len(scales):
        raise ValueError(f"at least one iteration and scale are needed, got {iterations} and {len(scales)}")
    if not all(math.isfinite(v) and v > 0 for scale in scales for v in scale):
        raise ValueError(f"scales must hold positive numbers, got {scales}")
    if any(scale.keep > 1 for scale in scales):
        raise ValueError(f"a scale's keep must lie in (0, 1], got {scales}")
    shares = [scale.every for scale in scales]
    if any(a % b for a, b in itertools.pairwise(shares)):
        raise ValueError(
            f"a scale's points must be among the next one's: each every a multiple of the next, got {shares}"
        )
    if min_pairs < 1:
        raise ValueError(f"min_pairs must be at least 1, got {min_pairs}")
    belief = None
    if prior is not None:
        mean = as_finite64("the prior's mean", prior.T_map_source, 4, 4)
        belief = mean, as_finite64("the prior's information", prior.information, 6, 6)
    plan = Plan(
        as_finite64("T", T, 4, 4), as_finite64("pivot", pivot, 3), tuple(scales), iterations, min_pairs,
        belief,
    )  # fmt: skip
    if not len(grid.points) or len(points) < min_pairs:
        return None
    return runtime.dispatch_here(
        lambda: "cells" in vars(grid) and _launch.ready(),
        lambda: _align(grid, planes, points, of, plan),
        lambda: reference.align_planes(grid.tree, planes, points, of, plan),
    )


_WHOLES = np.zeros(1, dtype=np.int32)
_REALS = np.zeros(1, dtype=np.float32)
_launch = Launch(
    *("icp", "align", np.zeros(1), _WHOLES, _WHOLES, _REALS, _REALS, _WHOLES, np.zeros(1), _REALS, _WHOLES),
    *(np.zeros((6, 7)), np.zeros(1), 1),
)
"""One launch for all calls, as only one call of native code runs at a time."""


def _align(grid: PointGrid, normals: F32, source: F32, kind: Mask, plan: Plan) -> Registration | None:
    cells, chunks, n = grid.cells, runtime.workers(), len(source)
    memory, partners = np.full(4 * n, -1.0), np.full(6 * n, _FAR, dtype=np.float32)
    bins = np.empty(n + 2 * chunks * _BINS, dtype=np.int32)
    system, state = np.empty((6, 7)), np.zeros(_SUMS + 36)
    order, numbers = _by_scale(kind, plan.scales)
    state[:12] = plan.T[:3].ravel()
    arguments = (
        _settings(cells.frame, plan, numbers), cells.starts, cells.rows, normals.reshape(-1),
        source[order].reshape(-1), kind[order].astype(np.int32), memory, partners, bins, system, state, chunks,
    )  # fmt: skip
    for index, value in enumerate(arguments):
        _launch.put(index, value)
    while not state[_STATUS]:
        _launch()
    if state[_STATUS] == _LOST or not np.isfinite(state[:12]).all():
        return None
    pose = np.eye(4)
    pose[:3] = state[:12].reshape(3, 4)
    information = state[_INFORMATION:_SUMS].reshape(6, 6).copy()
    squares, weights, pairs = state[_SUMS + 27 : _SUMS + 30]
    return Registration(
        pose, information, math.sqrt(squares / weights), int(pairs), int(state[_TOTAL]), bool(state[_CONVERGED])
    )


def _by_scale(kind: Mask, scales: Sequence[Scale]) -> tuple[I64, I64]:
    """Return the order (N,) of the points by the first scale that uses them, and the number of points of each scale."""
    first = np.full(len(kind), len(scales))
    groups = np.flatnonzero(kind), np.flatnonzero(~kind)
    for k in reversed(range(len(scales))):
        for group in groups:
            first[group[:: scales[k].every]] = k
    parts = [np.flatnonzero(first == k) for k in range(len(scales) + 1)]
    return np.concatenate(parts), np.cumsum([len(part) for part in parts[:-1]])


def _settings(frame: F64, plan: Plan, numbers: I64) -> F64:
    """Return all constants of the kernel in one array, as every array that changes costs 3 us."""
    values = np.zeros(63 + 6 * len(plan.scales))
    values[:8] = frame
    values[8:12] = plan.iterations, len(plan.scales), plan.min_pairs, plan.prior is not None
    values[12:15] = plan.pivot
    if plan.prior is not None:
        values[15:27], values[27:63] = plan.prior[0][:3].ravel(), plan.prior[1].ravel()
    values[63:] = [v for scale, n in zip(plan.scales, numbers, strict=True) for v in (*scale[:4], n, scale.keep)]
    return values


def _compile() -> None:
    arguments = SAMPLE_GRID, SAMPLE, SAMPLE, np.ones(2), np.eye(4), np.zeros(3), [Scale(1.0, 1.0)]
    align_planes(*arguments, iterations=1, min_pairs=1)


compiled_by("align_planes", _compile)
