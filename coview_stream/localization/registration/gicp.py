"""GICP (Segal et al., RSS 2009): small_gicp's residuals in our Gauss-Newton, with our trimming and prior.

The one place that imports small_gicp (MIT; Koide, JOSS 2024). A pair costs r^T (C_map + R C_scan R^T)^-1 r / 2, with
r = T p - q and covariances that are flat along the surface around each point. small_gicp has no prior, does not trim
and does not separate ground from structure. So its ``align`` with one iteration only gives the Hessian and the gradient
at a pose, for one kind of point at a time. The rest is as for trimmed ICP (:func:`coview_kernels.align_planes`): the
``keep`` nearest pairs of either kind, equal weights for both kinds, and the prior in every step. Steps turn about a
pivot, a point of the source that moves with it (usually the sensor), along the map's axes.

The variance of a point's covariance along its surface is one square metre by definition, so a pair weighs at least 1/2
in every direction: a thousand pairs in a corridor claim 0.15 m along it, where the surfaces show nothing. That half is
subtracted from Hessian and gradient, which leaves a weight that is zero along surfaces.

small_gicp holds the interpreter's lock and aborts the interpreter on empty clouds and NaN, so none are passed to it.
Other threads wait some 10 ms a call, and a quarter of a second for the covariances of a new crop of the map (160,000
points, once per 16 m). So the global search, with its many places, keeps to trimmed ICP with either method, and
``serve`` registers in the processes of its engines only (:mod:`coview_stream.stream.node.engine_process`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

import coview_kernels as kernels
from coview_stream.config.localizer import MIN_PAIRS
from coview_stream.errors import require_library
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, boxminus, boxplus, norms, orthonormal, pose_from, skew

_NEIGHBOURS = 10  # of a point's covariance: small_gicp's default
_MIN_POINTS = 20  # fewer of a kind have no surfaces
_MAX_SHARE = 5.0  # as in trimmed ICP: a handful of points must not outweigh thousands
_ROUNDING = 1e-3  # metres: float32 must not lose the farthest kept pair
_TINY = 1e-6  # information: keeps open directions solvable
_ALONG = 0.5  # per square metre: weight of a pair in all directions, subtracted (see the module)

_INFORMATION = 4.0
"""Factor on small_gicp's Hessian that makes the configuration's ``inflation`` suit both methods.

Measured once, by no command of this repository, on simulated drives against the truth (nine worlds of
``python -m bench tracking --seeds 5100``, 30 places each, starts off by 0.12 m and 0.3 degrees, no prior, no floors),
for an inflation of 3: the mean squared Mahalanobis error per degree of freedom of trimmed ICP is 1.0 to 1.2 in towns
and on a campus, 2.5 in a sparse forest, 2.8 in a town that has changed; GICP's 0.4 to 0.6, 1.6 to 2.4 and 0.6.
Above 1, the error that neighbouring registrations share is missing
(:mod:`coview_stream.localization.tracking.shared_error` adds it). The residual is no guide: 0.05 of the value that
small_gicp expects, everywhere.
"""


class Surfaces(NamedTuple):
    """Points (N, 3) as small_gicp takes them, with the covariance of the surface around each."""

    points: Points
    cloud: Any
    tree: Any


def library() -> Any:
    """Return the module ``small_gicp``; DependencyError where it is missing."""
    return require_library("small_gicp", "small-gicp>=1.0.1", "registration by GICP")


def surfaces(points: Points) -> Surfaces | None:
    """Prepare points (N, 3), all but those with NaN or inf; None where they are too few to have surfaces."""
    gicp = library()
    whole = np.isfinite(points).all(axis=1)
    rows = np.ascontiguousarray(points if whole.all() else points.compress(whole, axis=0))
    if len(rows) < _MIN_POINTS:
        return None
    cloud = gicp.PointCloud(rows.astype(np.float64))
    tree = gicp.KdTree(cloud, num_threads=1)
    gicp.estimate_covariances(cloud, tree, num_neighbors=_NEIGHBOURS, num_threads=1)
    return Surfaces(rows, cloud, tree)


def register_surfaces(
    kinds: list[Surfaces],
    T_map_source: Pose,
    target: Surfaces,
    grid: kernels.PointGrid,
    normals: Points,
    pivot: Floats,
    scales: list[kernels.Scale],
    *,
    iterations: int,
    prior: kernels.Prior | None = None,
) -> kernels.Registration | None:
    """Register a scan by GICP; None where fewer than 50 points find a partner.

    ``kinds`` are the points above the ground and on it; other arguments as for :func:`coview_kernels.align_planes`.

    Raises:
        ValueError: the initial guess or the prior is not finite.
        DependencyError: there is no small_gicp.
    """
    if not all(np.isfinite(a).all() for a in (T_map_source, pivot, *(prior or ()))):
        raise ValueError("T_map_source, its pivot or the prior is not finite")
    T, total, answer = np.array(T_map_source, dtype=np.float64), 0, None
    for scale in scales:
        for _ in range(iterations):
            pairs = _pairs(kinds, target, grid, normals, T, pivot, scale.radius, scale.keep)
            if pairs is None:
                return None
            H, b, count, rmse = pairs
            step, information = fused_step(H, b, T, pivot, prior)
            T = retract(T, step, pivot)
            if not np.isfinite(T).all():
                return None
            total += 1
            turn, shift = np.linalg.norm(step[:3]), np.linalg.norm(step[3:])
            converged = bool(shift < scale.shift and turn < scale.turn)
            answer = kernels.Registration(T, information, rmse, count, total, converged)
            if converged:
                break
    return None if answer is None else answer._replace(T_map_source=orthonormal(T))


def _pairs(
    kinds: list[Surfaces],
    target: Surfaces,
    grid: kernels.PointGrid,
    normals: Points,
    T: Pose,
    pivot: Floats,
    radius: float,
    keep: float,
) -> tuple[Floats, Floats, int, float] | None:
    """Return Hessian (6, 6), gradient (6,), number and rmse of the kept pairs at a pose; None where they are too few.

    Both kinds of point weigh the same.
    """
    gicp, moved_pivot = library(), T[:3, :3] @ pivot + T[:3, 3]
    H, b, pairs, squares, weights = np.zeros((6, 6)), np.zeros(6), 0, 0.0, 0.0
    points = sum(len(kind.points) for kind in kinds)
    for kind in kinds:
        distance, partner = kernels.nearest(grid, kind.points, radius, T)
        distances = distance[np.isfinite(distance)]
        if not len(distances):
            continue
        number = max(1, int(keep * len(distances)))
        farthest = min(radius, float(np.partition(distances, number - 1)[number - 1]) + _ROUNDING)
        answer = gicp.align(
            target.cloud, kind.cloud, target.tree, T, registration_type="GICP",
            max_correspondence_distance=farthest, num_threads=1, max_iterations=1,
        )  # fmt: skip
        near = np.flatnonzero(distance <= farthest)
        moved = kind.points[near] @ T[:3, :3].T + T[:3, 3]
        gap = moved - grid.points[partner[near]]
        normal = normals[partner[near]]
        residual = np.einsum("ij,ij->i", gap, normal) / np.maximum(norms(normal), np.float32(1e-6))
        weight = min(0.5 * points / len(near), _MAX_SHARE)
        H_kind, b_kind = about_pivot(answer.H, answer.b, T, pivot)
        H_along, b_along = point_to_point_system(moved, gap, moved_pivot)
        H = H + weight * _INFORMATION * (H_kind - _ALONG * H_along)
        b = b + weight * _INFORMATION * (b_kind - _ALONG * b_along)
        pairs += len(near)
        squares, weights = squares + weight * float(residual @ residual), weights + weight * len(near)
    return (H, b, pairs, float(np.sqrt(squares / weights))) if pairs >= MIN_PAIRS else None


def about_pivot(H: Floats, b: Floats, T: Pose, pivot: Floats) -> tuple[Floats, Floats]:
    """Return small_gicp's Hessian and gradient in our tangent.

    small_gicp perturbs on the right, T exp(d), d = (turn, shift) along the source's axes about its origin. We turn by r
    about the moved pivot R p + t, then shift by s, along the map's axes. To first order d = J (r, s) with
    J = [[R^T, 0], [[p]x R^T, R^T]], so H becomes J^T H J and b becomes J^T b.
    """
    R = T[:3, :3]
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = R.T
    J[3:, :3] = skew(np.asarray(pivot, dtype=np.float64)) @ R.T
    H_pivot = J.T @ H @ J
    return np.asarray(0.5 * (H_pivot + H_pivot.T)), np.asarray(J.T @ b)


def fused_step(
    information: Floats, gradient: Floats, T: Pose, pivot: Floats, prior: kernels.Prior | None
) -> tuple[Floats, Floats]:
    """Return Gauss-Newton's step (6,) by pairs and prior, and the information of both (6, 6)."""
    if prior is not None:
        away = boxminus(_with_pivot(T, pivot), _with_pivot(prior.T_map_source, pivot))
        information, gradient = information + prior.information, gradient + prior.information @ away
    step = -np.linalg.solve(information + _TINY * np.eye(6), gradient)
    return np.asarray(step, dtype=np.float64), information


def retract(T: Pose, step: Floats, pivot: Floats) -> Pose:
    """Return the pose turned about its moved pivot and shifted, by ``step`` (6,) along the map's axes."""
    there = boxplus(_with_pivot(T, pivot), step)
    there[:3, 3] -= there[:3, :3] @ pivot
    return there


def _with_pivot(T: Pose, pivot: Floats) -> Pose:
    return pose_from(T[:3, :3], T[:3, 3] + T[:3, :3] @ pivot)


def point_to_point_system(moved_points: Floats, gap: Floats, pivot: Floats) -> tuple[Floats, Floats]:
    """Return Hessian and gradient of |gap|^2 / 2 for points (N, 3) in the map, gaps (N, 3) and the moved pivot (3,)."""
    a = moved_points - pivot
    H = np.zeros((6, 6))
    H[:3, :3] = np.einsum("ij,ij->", a, a) * np.eye(3) - a.T @ a
    H[:3, 3:] = skew(a.sum(axis=0))
    H[3:, :3] = -H[:3, 3:]
    H[3:, 3:] = len(a) * np.eye(3)
    return H, np.concatenate([np.cross(a, gap).sum(axis=0), gap.sum(axis=0)])
