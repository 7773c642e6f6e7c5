"""SE(3): small motions of a pose in two tangents, and the covariances along them.

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

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.rotations import exp_so3, log_so3, skew
from coview_stream.geometry.transforms import Pose


def along_body(covariance: Floats, T_map_body: Pose) -> Floats:
    """Turn a covariance (6, 6) along the map's axes into one in the body's tangent."""
    return rotate_covariance(covariance, T_map_body[:3, :3].T)


def along_map(covariance: Floats, T_map_body: Pose) -> Floats:
    """Turn a covariance (6, 6) in the body's tangent into one along the map's axes."""
    return rotate_covariance(covariance, T_map_body[:3, :3])


def rotate_covariance(covariance: Floats, R: Floats) -> Floats:
    """Rotate both halves of a covariance (6, 6) by ``R`` (3, 3): diag(R, R) C diag(R, R)^T."""
    blocks = covariance.reshape(2, 3, 2, 3).transpose(0, 2, 1, 3)
    moved = (R @ blocks @ R.T).transpose(0, 2, 1, 3).reshape(6, 6)
    return np.asarray(0.5 * (moved + moved.T))


def boxminus(T_map_body: Pose, T_map_reference: Pose) -> Floats:
    """Return the step (6,) by which a pose differs from a reference, along the map's axes."""
    turn = log_so3(T_map_body[:3, :3] @ T_map_reference[:3, :3].T)
    return np.asarray(np.concatenate([turn, T_map_body[:3, 3] - T_map_reference[:3, 3]]))


def boxplus(T_map_body: Pose, step: Floats) -> Pose:
    """Return the pose that differs by ``step`` (6,) along the map's axes; undoes :func:`boxminus`."""
    moved: Pose = T_map_body.copy()
    moved[:3, :3] = exp_so3(step[:3]) @ T_map_body[:3, :3]
    moved[:3, 3] += step[3:]
    return moved


def adjoint(T: Pose) -> Floats:
    """Return the matrix (6, 6) with T exp(xi) = exp(Ad xi) T."""
    Ad = np.zeros((6, 6))
    Ad[:3, :3] = Ad[3:, 3:] = T[:3, :3]
    Ad[3:, :3] = skew(T[:3, 3]) @ T[:3, :3]
    return Ad
