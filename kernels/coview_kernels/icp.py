"""Eq. 13, all of it: trimmed point-to-plane ICP, coarse to fine, with weights against outliers and a prior.

Two things make it quick. The iterations run inside the kernel, so that a registration is one launch, seldom a few. And
a point's partner is looked up, not searched for, where it cannot have changed: a search also tells how far all other
map points are at least, and as long as the point has moved less than that leaves room for, the partner is the same
(the triangle inequality; exact). Late iterations, which move the cloud by centimetres, hardly search at all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from coview_kernels import check, reference, runtime
from coview_kernels.arrays import F32, F64, Mask
from coview_kernels.launch import Launch
from coview_kernels.nearest import PointGrid
from coview_kernels.reference.icp import Alignment, Plan, Scale

__all__ = ["Alignment", "Belief", "Scale", "align_planes"]

_BULK = 1500  # searches in one iteration that are worth another launch, to be spread over the threads
_CHUNKS = 4  # for each thread: points that must search far come in clusters
_TOTAL, _STATUS, _CONVERGED, _INFORMATION, _SUMS, _PAIRED = 14, 15, 16, 17, 53, 83
_LOST = 2
_CHUNK_COUNT = 9  # which argument it is
_BINS = 2048
_UNKNOWN = (0.0, 0.0, 0.0, -1.0, -1.0, 0.0)


class Belief(NamedTuple):
    """A Gaussian belief about the pose, fused with what the pairs say."""

    mean: npt.ArrayLike
    """(4, 4) ``T_target_source``."""
    information: npt.ArrayLike
    """(6, 6) over (rx, ry, rz, x, y, z): a rotation about the pivot, then a shift, along the target's axes."""


def align_planes(
    grid: PointGrid,
    normals: npt.ArrayLike,
    source: npt.ArrayLike,
    kind: npt.ArrayLike,
    T: npt.ArrayLike,
    pivot: npt.ArrayLike,
    scales: Sequence[Scale],
    *,
    keep: float,
    iterations: int,
    least: int = 50,
    prior: Belief | None = None,
) -> Alignment | None:
    """Register points to a map of points with normals.

    Each iteration pairs every point with its nearest map point below the scale's radius; of either kind of point it
    keeps the floor(keep * found) nearest pairs, at least one (and all that are as far as the last of them); and it
    takes a Gauss-Newton step on sum w r^2, where r = n . (T p - q) and w = share / (1 + (r / width)^2). The share is
    such that both kinds weigh the same, whatever their numbers, but 5 at most.

    Args:
        grid: the map, (K, 3).
        normals: (K, 3) float32, its unit normals.
        source: (N, 3) float32, source frame, metres. Rows with NaN or inf find no partner.
        kind: (N,) bool.
        T: (4, 4) ``T_target_source`` to begin with.
        pivot: (3,) source-frame point that rotations are about.
        scales: coarse to fine.
        keep: share of the pairs in (0, 1].
        iterations: at most, on each scale.
        least: pairs without which there is no answer.
        prior: belief to fuse.

    Returns:
        The pose with its evidence (see :class:`Alignment`), or None where too few points find a partner.

    Raises:
        ValueError: a shape is wrong, a pose not finite, or a setting out of its range; the message names it.
    """
    points = check.float32("source", source, None, 3)
    of = np.ascontiguousarray(kind, dtype=bool)
    check.same_shape("kind", of, "one value per point", (len(points),))
    planes = check.float32("normals", normals, len(grid.points), 3)
    if not 0 < keep <= 1:
        raise ValueError(f"keep must lie in (0, 1], got {keep}")
    if iterations < 1 or not len(scales):
        raise ValueError(f"at least one iteration and scale are needed, got {iterations} and {len(scales)}")
    if not all(math.isfinite(v) and v > 0 for pair in scales for v in pair):
        raise ValueError(f"scales must hold positive metres and radians, got {scales}")
    belief = None
    if prior is not None:
        mean = check.finite64("the prior's mean", prior.mean, 4, 4)
        belief = mean, check.finite64("the prior's information", prior.information, 6, 6)
    plan = Plan(
        check.finite64("T", T, 4, 4), check.finite64("pivot", pivot, 3), tuple(scales), keep, iterations, least,
        belief,
    )  # fmt: skip
    if not len(grid.points) or len(points) < least:
        return None
    return runtime.dispatch(_align, _twin, grid, planes, points, of, plan)


def _twin(grid: PointGrid, normals: F32, source: F32, kind: Mask, plan: Plan) -> Alignment | None:
    return reference.align_planes(grid.tree, normals, source, kind, plan)


def _align(grid: PointGrid, normals: F32, source: F32, kind: Mask, plan: Plan) -> Alignment | None:
    cells, workers, n = grid.cells, runtime.workers(), len(source)
    points = np.empty((n, 4), dtype=np.float32)
    points[:, :3], points[:, 3] = source, kind
    memory = np.empty((n, len(_UNKNOWN)))
    memory[:] = _UNKNOWN
    ranks = np.empty((2, 3 + _BINS), dtype=np.int32)
    system, state = np.empty((6, 7)), np.zeros(_PAIRED + 7)
    state[:12] = plan.T[:3].ravel()
    settings = _settings(cells.frame, plan, _BULK if workers > 1 else n + 1)
    launch = Launch(
        "icp", "align",
        settings, cells.starts, cells.rows, normals.reshape(-1), points.reshape(-1), memory.reshape(-1),
        ranks, system, state, 1,
    )  # fmt: skip
    while not state[_STATUS]:
        if workers > 1:
            launch.put(_CHUNK_COUNT, _CHUNKS * workers)
            launch()
            launch.put(_CHUNK_COUNT, 1)
            state[_PAIRED] = 1
        launch()
    if state[_STATUS] == _LOST or not np.isfinite(state[:12]).all():
        return None
    pose = np.eye(4)
    pose[:3] = state[:12].reshape(3, 4)
    information = state[_INFORMATION:_SUMS].reshape(6, 6).copy()
    squares, weights, pairs = state[_SUMS + 27 : _PAIRED]
    return Alignment(
        pose,
        information,
        math.sqrt(squares / weights),
        int(pairs),
        int(state[_TOTAL]),
        bool(state[_CONVERGED]),
    )


def _settings(frame: F64, plan: Plan, bulk: int) -> F64:
    """All numbers that the kernel does not change in one array, as every argument costs 5-10 us."""
    values = np.zeros(65 + 4 * len(plan.scales))
    values[:8] = frame
    values[8:14] = (
        plan.keep, plan.iterations, len(plan.scales), plan.least, plan.prior is not None, bulk,
    )  # fmt: skip
    values[14:17] = plan.pivot
    if plan.prior is not None:
        values[17:29], values[29:65] = plan.prior[0][:3].ravel(), plan.prior[1].ravel()
    values[65:] = np.ravel(plan.scales)
    return values
