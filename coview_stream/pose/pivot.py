"""Gauss-Newton about a pivot: turns about a moved point of the source, usually the sensor, along the map's axes.

What a registration needs beside its pairs: another library's Hessian in our tangent, a prior's pull, the step.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_stream.geometry import Pose
from coview_stream.pose.tangent import Matrix6, Vector6, cross, difference, shifted

_TINY = 1e-6  # information: keeps what has none solvable


def about_pivot(H: Matrix6, b: Vector6, T: Pose, pivot: npt.NDArray[np.float64]) -> tuple[Matrix6, Vector6]:
    """Hessian and gradient of small_gicp in our tangent.

    small_gicp perturbs on the right, T exp(d), d = (turn, shift) along the source's axes about its origin. We turn by r
    about the moved pivot R p + t, then shift by s, along the map's axes. Both move alike to first order for
    d = J (r, s) with J = [[R^T, 0], [[p]x R^T, R^T]], so that H becomes J^T H J and b becomes J^T b.
    """
    R = T[:3, :3]
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = R.T
    J[3:, :3] = cross(np.asarray(pivot, dtype=np.float64)) @ R.T
    turned = J.T @ H @ J
    return np.asarray(0.5 * (turned + turned.T)), np.asarray(J.T @ b)


def fused_step(
    information: Matrix6,
    gradient: Vector6,
    T: Pose,
    pivot: npt.NDArray[np.float64],
    prior: kernels.Belief | None,
) -> tuple[Vector6, Matrix6]:
    """Gauss-Newton's step (6,) to the most probable pose by pairs and prior, and the information of both (6, 6)."""
    if prior is not None:
        away = difference(_with_pivot(T, pivot), _with_pivot(prior.mean, pivot))
        belief = np.asarray(prior.information, dtype=np.float64)
        information, gradient = information + belief, gradient + belief @ away
    step = -np.linalg.solve(information + _TINY * np.eye(6), gradient)
    return np.asarray(step, dtype=np.float64), information


def moved(T: Pose, step: Vector6, pivot: npt.NDArray[np.float64]) -> Pose:
    """Return the pose turned about its moved pivot and shifted, by ``step`` (6,) along the map's axes."""
    there = shifted(_with_pivot(T, pivot), step)
    there[:3, 3] -= there[:3, :3] @ pivot
    return there


def _with_pivot(T: npt.ArrayLike, pivot: npt.NDArray[np.float64]) -> Pose:
    there: Pose = np.array(T, dtype=np.float64)
    there[:3, 3] += there[:3, :3] @ pivot
    return there


def pulls(
    moved_points: npt.NDArray[np.float64], gap: npt.NDArray[np.float64], about: npt.NDArray[np.float64]
) -> tuple[Matrix6, Vector6]:
    """Hessian and gradient of |gap|^2 / 2 of pairs: points (N, 3) in the map, gaps (N, 3), the moved pivot (3,)."""
    a = moved_points - about
    H, b = np.zeros((6, 6)), np.zeros(6)
    H[:3, :3] = np.einsum("ij,ij->", a, a) * np.eye(3) - a.T @ a
    H[:3, 3:] = cross(a.sum(axis=0))
    H[3:, :3] = -H[:3, 3:]
    H[3:, 3:] = len(a) * np.eye(3)
    b[:3], b[3:] = np.cross(a, gap).sum(axis=0), gap.sum(axis=0)
    return H, b
