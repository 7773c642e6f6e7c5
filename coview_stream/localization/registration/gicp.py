"""GICP (Segal et al., RSS 2009): small_gicp's residuals in our Gauss-Newton, with our trimming and prior.

The one place that imports small_gicp (MIT; Koide, JOSS 2024). A pair costs r^T (C_map + R C_scan R^T)^-1 r / 2, with
r = T p - q and covariances that are flat along the surface around each point. small_gicp has no prior, does not trim
and does not tell ground from structure, so it only does what is slow: its ``align`` with one iteration is asked for
the Hessian and the gradient at the pose it is given, of either kind of point by itself. The rest is as for trimmed ICP
(:func:`coview_kernels.align_planes`): of either kind the ``keep`` nearest pairs, both kinds weighing the same, and the
prior in every step, so that a direction that the map does not show is the prior's from the first step on. Steps turn
about a pivot, a point of the source that moves with it (usually the sensor), along the map's axes.

A covariance's variance along its surface is one square metre by definition, so the weight of a pair is at least 1/2 in
every direction: a thousand pairs in a corridor claim to know where along it they are to 0.15 m, of which the surfaces
say nothing. That half is taken out again, from Hessian and gradient, which leaves a weight that is positive
semi-definite and zero along surfaces.

small_gicp holds the interpreter's lock while it works and aborts the interpreter on empty clouds and NaN. Nothing of
that kind is passed to it. What else would run in this process waits meanwhile: some 10 ms a call, and a quarter of a
second for the covariances of a new crop of the map (160,000 points), of which there is one every 16 m. That is why
the global search, which looks at many places, keeps to trimmed ICP with either method. ``serve`` registers only in the
processes of its engines (:mod:`coview_stream.stream.node.engine_process`), so that the process that publishes poses
never imports small_gicp.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_stream.config.localizer import MIN_PAIRS
from coview_stream.errors import require_library
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, boxminus, boxplus, norms, orthonormal, skew

# set by hand
_NEIGHBOURS = 10  # that a point's covariance is made of; small_gicp's own choice
_MIN_POINTS = 20  # fewer of a kind have no surfaces
_MAX_SHARE = 5.0  # as trimmed ICP: a handful of points must not outweigh thousands
_ROUNDING = 1e-3  # metres: the farthest pair that is kept must not be lost to float32
_TINY = 1e-6  # information: keeps what has none solvable

_ALONG = 0.5
"""Times the identity, what every pair's weight holds in all directions, per square metre: see the module."""

_INFORMATION = 4.0
"""Times small_gicp's Hessian, so that the configuration's ``inflation`` suits both methods.

Measured once, by no command of this repository, on simulated drives against the truth (nine worlds of
``python -m bench tracking --seeds 5100``, 30 places each, starts off by 0.12 m and 0.3 degrees, no prior, no floors)
and restated for the inflation of 3: the mean squared Mahalanobis error per degree of freedom of trimmed ICP is 1.0 to
1.2 in towns and on a campus, 2.5 in a sparse forest, 2.8 in a town that has changed; GICP's, with this factor, 0.4 to
0.6, 1.6 to 2.4 and 0.6. So in no kind of world is GICP less honest than trimmed ICP. What is missing where it exceeds
1 is the error that neighbouring registrations share, which :mod:`coview_stream.localization.tracking.shared_error`
adds. The residual would be no better guide: 0.05 of what small_gicp expects, in all of them.
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
    target: Surfaces,
    grid: kernels.PointGrid,
    normals: Points,
    T_map_source: Pose,
    pivot: Floats,
    scales: list[kernels.Scale],
    *,
    keep: float,
    iterations: int,
    prior: kernels.Belief | None = None,
) -> kernels.Alignment | None:
    """Register the points of a scan, those above the ground and those on it.

    Args:
        kinds: either kind of point that the scan has enough of.
        target: the map.
        grid: the same points, to be searched.
        normals: (K, 3) of these points, of any length.
        T_map_source: (4, 4) initial guess.
        pivot: (3,) source-frame point that rotations are about.
        scales: coarse to fine.
        keep: share of the pairs in (0, 1].
        iterations: at most, on each scale.
        prior: belief to fuse, about the same pivot.

    Returns:
        The result, or None where fewer than 50 points find a partner.

    Raises:
        ValueError: the initial guess or the prior is not finite.
        DependencyError: there is no small_gicp.
    """
    if not all(np.isfinite(a).all() for a in (T_map_source, pivot, *(prior or ()))):
        raise ValueError("T_map_source, its pivot or the prior is not finite")
    T, total, answer = np.array(T_map_source, dtype=np.float64), 0, None
    for scale in scales:
        for _ in range(iterations):
            pairs = _pairs(kinds, target, grid, normals, T, pivot, scale.radius, keep)
            if pairs is None:
                return None
            step, information = fused_step(pairs.information, pairs.gradient, T, pivot, prior)
            T = retract(T, step, pivot)
            if not np.isfinite(T).all():
                return None
            total += 1
            turn, shift = np.linalg.norm(step[:3]), np.linalg.norm(step[3:])
            converged = bool(shift < scale.shift and turn < scale.turn)
            answer = kernels.Alignment(T, information, pairs.rmse, pairs.kept, total, converged)
            if converged:
                break
    return None if answer is None else kernels.Alignment(orthonormal(T), *answer[1:])


class _Pairs(NamedTuple):
    """System of all kept pairs at one pose: information (6, 6), gradient (6,), their number and residual, metres."""

    information: Floats
    gradient: Floats
    kept: int
    rmse: float


def _pairs(
    clouds: list[Surfaces],
    target: Surfaces,
    grid: kernels.PointGrid,
    normals: Points,
    T: Pose,
    pivot: Floats,
    radius: float,
    keep: float,
) -> _Pairs | None:
    """Find pairs at a pose and sum up what they say, both kinds weighing the same; None where they are too few."""
    gicp, moved_pivot = library(), T[:3, :3] @ pivot + T[:3, 3]
    H, b, pairs, squares, weights = np.zeros((6, 6)), np.zeros(6), 0, 0.0, 0.0
    points = sum(len(kind.points) for kind in clouds)
    for kind in clouds:
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
    return _Pairs(H, b, pairs, float(np.sqrt(squares / weights))) if pairs >= MIN_PAIRS else None


def about_pivot(H: Floats, b: Floats, T: Pose, pivot: Floats) -> tuple[Floats, Floats]:
    """Hessian and gradient of small_gicp in our tangent.

    small_gicp perturbs on the right, T exp(d), d = (turn, shift) along the source's axes about its origin. We turn by r
    about the moved pivot R p + t, then shift by s, along the map's axes. Both move alike to first order for
    d = J (r, s) with J = [[R^T, 0], [[p]x R^T, R^T]], so that H becomes J^T H J and b becomes J^T b.
    """
    R = T[:3, :3]
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = R.T
    J[3:, :3] = skew(np.asarray(pivot, dtype=np.float64)) @ R.T
    H_pivot = J.T @ H @ J
    return np.asarray(0.5 * (H_pivot + H_pivot.T)), np.asarray(J.T @ b)


def fused_step(
    information: Floats, gradient: Floats, T: Pose, pivot: Floats, prior: kernels.Belief | None
) -> tuple[Floats, Floats]:
    """Gauss-Newton's step (6,) to the most probable pose by pairs and prior, and the information of both (6, 6)."""
    if prior is not None:
        away = boxminus(_with_pivot(T, pivot), _with_pivot(prior.mean, pivot))
        belief = np.asarray(prior.information, dtype=np.float64)
        information, gradient = information + belief, gradient + belief @ away
    step = -np.linalg.solve(information + _TINY * np.eye(6), gradient)
    return np.asarray(step, dtype=np.float64), information


def retract(T: Pose, step: Floats, pivot: Floats) -> Pose:
    """Return the pose turned about its moved pivot and shifted, by ``step`` (6,) along the map's axes."""
    there = boxplus(_with_pivot(T, pivot), step)
    there[:3, 3] -= there[:3, :3] @ pivot
    return there


def _with_pivot(T: npt.ArrayLike, pivot: Floats) -> Pose:
    there: Pose = np.array(T, dtype=np.float64)
    there[:3, 3] += there[:3, :3] @ pivot
    return there


def point_to_point_system(moved_points: Floats, gap: Floats, pivot: Floats) -> tuple[Floats, Floats]:
    """Hessian and gradient of |gap|^2 / 2 of pairs: points (N, 3) in the map, gaps (N, 3), the moved pivot (3,)."""
    a = moved_points - pivot
    H, b = np.zeros((6, 6)), np.zeros(6)
    H[:3, :3] = np.einsum("ij,ij->", a, a) * np.eye(3) - a.T @ a
    H[:3, 3:] = skew(a.sum(axis=0))
    H[3:, :3] = -H[:3, 3:]
    H[3:, 3:] = len(a) * np.eye(3)
    b[:3], b[3:] = np.cross(a, gap).sum(axis=0), gap.sum(axis=0)
    return H, b
