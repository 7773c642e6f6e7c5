"""Small motions of a pose: the two tangents in use here, and what a graph needs of SE(3).

The repository's tangent is (rx, ry, rz, x, y, z) *along the map's axes*: the body turns about its own origin, then it
is shifted, ``R -> exp(r) R`` and ``t -> t + s``. A graph's is the *body's*, on the right, ``T -> T exp(xi)`` with
xi = (rotation, translation) along the body's axes; gtsam's Pose3 has the same. To first order, which is all that a
covariance says, both name the same motions: r = R xi_r and s = R xi_t. So a covariance goes from one to the other by
the rotation alone, diag(R, R) C diag(R, R)^T. (The whole adjoint, with its lever arm [t]x R, would belong to turning
about the map's origin.)

Radians and metres; poses are (4, 4).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.rotations import exp_so3, log_so3
from coview_stream.geometry.transforms import Pose, is_pose, orthonormal


def along_body(covariance: Floats, T_map_body: Pose) -> Floats:
    """Covariance (6, 6) in the body's tangent of one that is given along the map's axes."""
    return rotate_covariance(covariance, T_map_body[:3, :3].T)


def along_map(covariance: Floats, T_map_body: Pose) -> Floats:
    """Covariance (6, 6) along the map's axes of one that is given in the body's tangent."""
    return rotate_covariance(covariance, T_map_body[:3, :3])


def rotate_covariance(covariance: Floats, R: Floats) -> Floats:
    """Both halves of a covariance (6, 6) along axes that ``R`` (3, 3) turns into: diag(R, R) C diag(R, R)^T."""
    blocks = covariance.reshape(2, 3, 2, 3).transpose(0, 2, 1, 3)
    moved = (R @ blocks @ R.T).transpose(0, 2, 1, 3).reshape(6, 6)
    return np.asarray(0.5 * (moved + moved.T))


def boxminus(T_map_body: Pose, T_map_reference: Pose) -> Floats:
    """(6,) by which a pose differs from a reference, along the map's axes: see the module."""
    turn = log_so3(T_map_body[:3, :3] @ T_map_reference[:3, :3].T)
    return np.asarray(np.concatenate([turn, T_map_body[:3, 3] - T_map_reference[:3, 3]]))


def boxplus(T_map_body: Pose, step: Floats) -> Pose:
    """Return the pose that differs by ``step`` (6,) along the map's axes; undoes :func:`difference`."""
    moved: Pose = T_map_body.copy()
    moved[:3, :3] = exp_so3(step[:3]) @ T_map_body[:3, :3]
    moved[:3, 3] += step[3:]
    return moved


def cross(v: Floats) -> Floats:
    """Matrices (..., 3, 3) of the cross product with (..., 3)."""
    K = np.zeros((*v.shape[:-1], 3, 3))
    K[..., 2, 1], K[..., 0, 2], K[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    return np.asarray(K - np.swapaxes(K, -1, -2))


def adjoint(T: Pose) -> Floats:
    """Matrix (6, 6) with T exp(xi) = exp(Ad xi) T."""
    Ad = np.zeros((6, 6))
    Ad[:3, :3] = Ad[3:, 3:] = T[:3, :3]
    Ad[3:, :3] = cross(T[:3, 3]) @ T[:3, :3]
    return Ad


def checked_pose(name: str, T: npt.ArrayLike) -> Pose:
    """Return a rigid pose (4, 4) float64, orthonormal to the last digit; InputError for anything else."""
    pose = np.asarray(T, dtype=np.float64)
    if not is_pose(pose):
        raise InputError(f"{name} is not a finite rigid 4x4 transform; check where it comes from")
    return orthonormal(pose)


def checked_covariance(name: str, covariance: npt.ArrayLike) -> Floats:
    """Return a covariance (6, 6) float64, symmetric to the last digit; InputError unless it is positive definite."""
    C = np.asarray(covariance, dtype=np.float64)
    if C.shape != (6, 6) or not np.isfinite(C).all():
        raise InputError(f"{name} has shape {C.shape} or is not finite; expected a covariance (6, 6)")
    C = np.asarray(0.5 * (C + C.T))
    sigma = np.sqrt(np.clip(np.diag(C), 1e-300, None))
    if (np.diag(C) <= 0).any() or np.linalg.eigvalsh(C / np.outer(sigma, sigma))[0] < 1e-12:
        raise InputError(f"{name} is not positive definite; give every direction a variance")
    return C
