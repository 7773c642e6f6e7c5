"""Rotations as matrices, quaternions and rotation vectors.

SciPy has them too, but importing it takes half a second of the two in which a node should be ready; the tests compare.
All take single rotations or stacks. Quaternions are x, y, z, w.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from coview_stream.geometry.arrays import Floats, Reals

_SMALL = 1e-8  # radians: below, the sine is the angle


def nearest_rotation(R: Reals) -> Floats:
    """Return the rotations (..., 3, 3) nearest to matrices (..., 3, 3) that are nearly rotations."""
    U, _, Vt = np.linalg.svd(np.asarray(R, dtype=np.float64))
    return np.asarray(U @ Vt)


def skew(v: Floats) -> Floats:
    """Return the matrices (..., 3, 3) of the cross product with (..., 3)."""
    K = np.zeros((*v.shape, 3))
    K[..., 2, 1], K[..., 0, 2], K[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    return np.asarray(K - np.swapaxes(K, -1, -2))


def exp_so3(rotvec: npt.ArrayLike) -> Floats:
    """Return the rotations (..., 3, 3) about axes (..., 3) by their length, radians (Rodrigues' formula)."""
    v = np.asarray(rotvec, dtype=np.float64)
    angle = np.sqrt((v * v).sum(axis=-1))[..., None, None]
    small = angle < _SMALL
    safe = np.where(small, 1.0, angle)
    sine = np.where(small, 1.0, np.sin(safe) / safe)
    cosine = np.where(small, 0.5, 2.0 * (np.sin(0.5 * safe) / safe) ** 2)
    K = skew(v)
    return np.asarray(np.eye(3) + sine * K + cosine * (K @ K))


def log_so3(R: Reals) -> Floats:
    """Return rotation vectors (..., 3), axis times angle in [0, pi], of rotation matrices (..., 3, 3)."""
    turn = matrix_to_quat(R)
    turn *= np.where(turn[..., 3:] < 0, -1.0, 1.0)
    sine = np.linalg.norm(turn[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, turn[..., 3:])
    return np.asarray(
        turn[..., :3] * np.where(sine < _SMALL, 2.0, angle / np.where(sine < _SMALL, 1.0, sine))
    )


def quat_to_matrix(quaternions: npt.ArrayLike) -> Floats:
    """Return rotation matrices (..., 3, 3) of quaternions (..., 4) of any length but zero."""
    q = np.asarray(quaternions, dtype=np.float64)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    R = np.empty((*q.shape[:-1], 3, 3))
    R[..., 0, 0] = 1 - 2 * (y * y + z * z)
    R[..., 1, 1] = 1 - 2 * (x * x + z * z)
    R[..., 2, 2] = 1 - 2 * (x * x + y * y)
    R[..., 0, 1], R[..., 1, 0] = 2 * (x * y - z * w), 2 * (x * y + z * w)
    R[..., 0, 2], R[..., 2, 0] = 2 * (x * z + y * w), 2 * (x * z - y * w)
    R[..., 1, 2], R[..., 2, 1] = 2 * (y * z - x * w), 2 * (y * z + x * w)
    return R


def matrix_to_quat(R: Reals) -> Floats:
    """Return unit quaternions (..., 4) of rotation matrices (..., 3, 3); the largest component is positive."""
    M = np.asarray(R, dtype=np.float64)
    xx, yy, zz = M[..., 0, 0], M[..., 1, 1], M[..., 2, 2]
    x, y, z = M[..., 2, 1] - M[..., 1, 2], M[..., 0, 2] - M[..., 2, 0], M[..., 1, 0] - M[..., 0, 1]
    xy, xz, yz = M[..., 0, 1] + M[..., 1, 0], M[..., 0, 2] + M[..., 2, 0], M[..., 1, 2] + M[..., 2, 1]
    # row k is 4 q_k q: each is right, the one of the largest component is right to the last digit
    rows = np.stack(
        [
            np.stack([1 + xx - yy - zz, xy, xz, x], axis=-1),
            np.stack([xy, 1 - xx + yy - zz, yz, y], axis=-1),
            np.stack([xz, yz, 1 - xx - yy + zz, z], axis=-1),
            np.stack([x, y, z, 1 + xx + yy + zz], axis=-1),
        ],
        axis=-2,
    )
    largest = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    chosen = np.take_along_axis(rows, largest[..., None, None], axis=-2)[..., 0, :]
    return np.asarray(chosen / np.linalg.norm(chosen, axis=-1, keepdims=True))


def slerp(start: Reals, end: Reals, share: npt.ArrayLike) -> Floats:
    """Return rotations (..., 3, 3), the ``share`` (...) of the way from ``start`` to ``end``, the short way round."""
    rotvec = log_so3(np.swapaxes(start, -1, -2) @ end)
    return np.asarray(start @ exp_so3(np.asarray(share, dtype=np.float64)[..., None] * rotvec))
