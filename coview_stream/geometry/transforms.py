"""Rigid transforms in 3-D: rotations, poses as 4x4 float64 matrices, and small motions with their covariances.

``T_target_source`` maps coordinates of the *source* frame into the *target* frame: ``p_target = T_target_source @
p_source``. Metres and radians throughout; quaternions are x, y, z, w. Rotations come single or in stacks; SciPy has
them too, but its import takes half a second of a node's start, which should take two.

A small motion of a pose has six numbers (rx, ry, rz, x, y, z) *along the map's axes*: the body rotates about its own
origin, then is shifted, ``R -> exp(r) R`` and ``t -> t + s``. A pose graph's tangent is the *body's*, on the right:
``T -> T exp(xi)`` with xi = (rotation, translation) along the body's axes. To first order, which is all that a
covariance describes, both are the same motions: r = R xi_r and s = R xi_t. So a covariance is converted by the rotation
alone, diag(R, R) C diag(R, R)^T. (The whole adjoint, with its lever arm [t]x R, is for rotations about the map origin.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from coview_stream.geometry.arrays import Bools, Floats, Reals

_Real = TypeVar("_Real", np.float32, np.float64)

Pose = npt.NDArray[np.float64]
"""A 4x4 float64 rigid transform."""

Poses = npt.NDArray[np.float64]
"""(N, 4, 4) float64 rigid transforms."""

Points = npt.NDArray[np.float32]
"""(N, 3) float32 coordinates near the origin of their frame, metres."""

_SMALL = 1e-8  # radians, below which the sine equals the angle
_ROWS = 16_384  # of a product that wakes no BLAS thread, which would then spin for milliseconds


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
    """Return the rotations (..., 3, 3) of rotation vectors (..., 3), radians (Rodrigues' formula)."""
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
    M = np.asarray(R, dtype=np.float64)
    axis = 0.5 * (M[..., [2, 0, 1], [1, 2, 0]] - M[..., [1, 2, 0], [2, 0, 1]])  # times the sine of the angle
    sine, cosine = np.sqrt((axis * axis).sum(axis=-1)), 0.5 * (np.trace(M, axis1=-2, axis2=-1) - 1.0)
    if (cosine > -0.9).all():  # near half a turn the sine loses the axis
        small = sine < _SMALL
        return np.asarray(axis * np.where(small, 1.0, np.arctan2(sine, cosine) / np.where(small, 1.0, sine))[..., None])
    turn = matrix_to_quat(R)
    turn *= np.where(turn[..., 3:] < 0, -1.0, 1.0)
    sine = np.linalg.norm(turn[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, turn[..., 3:])
    return np.asarray(turn[..., :3] * np.where(sine < _SMALL, 2.0, angle / np.where(sine < _SMALL, 1.0, sine)))


def quat_to_matrix(quaternions: npt.ArrayLike) -> Floats:
    """Return rotation matrices (..., 3, 3) of quaternions (..., 4), x y z w, of any nonzero length."""
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
    """Return unit quaternions (..., 4), x y z w, of rotations (..., 3, 3); the largest component is positive."""
    M = np.asarray(R, dtype=np.float64)
    xx, yy, zz = M[..., 0, 0], M[..., 1, 1], M[..., 2, 2]
    x, y, z = M[..., 2, 1] - M[..., 1, 2], M[..., 0, 2] - M[..., 2, 0], M[..., 1, 0] - M[..., 0, 1]
    xy, xz, yz = M[..., 0, 1] + M[..., 1, 0], M[..., 0, 2] + M[..., 2, 0], M[..., 1, 2] + M[..., 2, 1]
    # row k is 4 q_k q: all are right, but that of the largest component is the most exact
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
    """Return rotations (..., 3, 3) at a ``share`` (...) of the path from ``start`` to ``end``, the short way round."""
    rotvec = log_so3(np.swapaxes(start, -1, -2) @ end)
    return np.asarray(start @ exp_so3(np.asarray(share, dtype=np.float64)[..., None] * rotvec))


def pose_from(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> Pose:
    """Return the pose (4, 4) of a rotation matrix (3, 3) and a translation (3,) in metres."""
    T = np.eye(4)
    T[:3, :3] = np.asarray(rotation, dtype=np.float64)
    T[:3, 3] = np.asarray(translation, dtype=np.float64)
    return T


def inverse(T: Pose) -> Pose:
    """Return the inverse of a rigid transform (4, 4), without a general matrix inversion."""
    R_t = T[:3, :3].T
    return pose_from(R_t, -R_t @ T[:3, 3])


def transform(T: Pose, points: npt.NDArray[_Real]) -> npt.NDArray[_Real]:
    """Apply ``T`` to (N, 3) points, in the points' own precision."""
    R = T[:3, :3].astype(points.dtype)
    t = T[:3, 3].astype(points.dtype)
    moved = np.empty(points.shape, points.dtype)
    for start in range(0, len(points), _ROWS):
        part = slice(start, start + _ROWS)
        np.matmul(points[part], R.T, out=moved[part])
    moved += t
    return moved


def norms(points: npt.NDArray[_Real], origin: npt.NDArray[_Real] | None = None) -> npt.NDArray[_Real]:
    """Return the distances (N,) of points (N, 3) from ``origin`` (3,), default zero, in the points' precision."""
    # by columns: np.linalg.norm along the short axis takes ten times as long for the same numbers
    x, y, z = (points[:, d].copy() if origin is None else points[:, d] - origin[d] for d in range(3))
    x *= x
    y *= y
    z *= z
    x += y
    x += z
    return np.asarray(np.sqrt(x))


def rot_z(yaw: float) -> Floats:
    """Return the rotation matrix (3, 3) about z by ``yaw`` radians."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def yaw_of(T: Pose) -> float:
    """Return the heading of a pose about z, radians in (-pi, pi]."""
    return float(np.arctan2(T[1, 0], T[0, 0]))


def wrap_angle(angle: float) -> float:
    """Return the same angle in [-pi, pi), radians."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def rotation_angle(T: Pose) -> float:
    """Return the angle of the rotation part, radians in [0, pi]."""
    # near zero the sine stays precise, while the cosine (eq. 15) loses all precision
    (a, b, c), (d, e, f), (g, h, i) = T[:3, :3].tolist()
    sine = 0.5 * math.hypot(h - f, c - g, d - b)
    return math.atan2(sine, 0.5 * (a + e + i - 1.0))


def tilt_of(T: Pose) -> float:
    """Return the angle between the vertical axes of two frames, radians."""
    return float(np.arccos(np.clip(T[2, 2], -1.0, 1.0)))


def orthonormal(T: Pose) -> Pose:
    """Return ``T`` with the nearest exact rotation, as repeated products accumulate rounding errors."""
    return pose_from(nearest_rotation(T[:3, :3]), T[:3, 3])


def is_pose(T: Reals) -> bool:
    """Return whether ``T`` is a finite rigid transform (4, 4): rotation orthonormal to 1e-3, last row 0 0 0 1."""
    if T.shape != (4, 4) or not np.isfinite(T).all():
        return False
    R = T[:3, :3]
    rotates = np.abs(R @ R.T - np.eye(3)).max() < 1e-3 and np.linalg.det(R) > 0
    return bool(rotates and np.abs(T[3] - (0.0, 0.0, 0.0, 1.0)).max() < 1e-6)


def why_no_pose(T: Reals) -> str:
    """Return a clause on why a matrix is not a pose (:func:`is_pose`), with the remedy."""
    if T.shape != (4, 4):
        flaw = f"it has shape {T.shape}; give a 4x4 matrix"
    elif not np.isfinite(T).all():
        flaw = "it holds NaN or infinite numbers; leave such frames out"
    elif is_pose(T.T):
        flaw = "it is transposed, with its translation in the last row; give its transpose, whose T[:3, 3] it is"
    elif np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() >= 1e-3:
        flaw = "its rotation is not orthonormal; check the order of the quaternion (x, y, z, w)"
    elif np.linalg.det(T[:3, :3]) < 0:
        flaw = "it mirrors (determinant -1); axes have to be right-handed"
    else:
        flaw = f"its last row is {T[3].tolist()}; give 0 0 0 1"
    return f"is not a rigid transform: {flaw}"


def interpolate(T_start: Poses, T_end: Poses, share: npt.ArrayLike) -> Poses:
    """Return poses (..., 4, 4) at a ``share`` (...) of the path from ``T_start`` to ``T_end`` (..., 4, 4).

    The rotation has a constant rate, the short way round, and the position moves along a straight line. Shares outside
    [0, 1] extrapolate.
    """
    part = np.asarray(share, dtype=np.float64)
    poses = np.array(T_start, dtype=np.float64)
    poses[..., :3, :3] = slerp(T_start[..., :3, :3], T_end[..., :3, :3], part)
    poses[..., :3, 3] += part[..., None] * (T_end[..., :3, 3] - T_start[..., :3, 3])
    return poses


def pose_to_tum(T: Pose) -> Floats:
    """Return (7,) x y z qx qy qz qw of a pose."""
    return np.concatenate([T[:3, 3], matrix_to_quat(T[:3, :3])])


def pose_from_tum(row: npt.ArrayLike) -> Pose:
    """Return the pose of (7,) x y z qx qy qz qw; the quaternion need not be normalised."""
    values = np.asarray(row, dtype=np.float64)
    return pose_from(quat_to_matrix(values[3:]), values[:3])


def to_local(T_odom_body: Pose, anchor: Floats) -> Pose:
    """Return the same pose with the odometry frame's origin moved to ``anchor`` (3,), near which float32 is exact."""
    return pose_from(T_odom_body[:3, :3], T_odom_body[:3, 3] - anchor)


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
    """Return the step (6,) from a reference to a pose, along the map's axes."""
    turn = log_so3(T_map_body[:3, :3] @ T_map_reference[:3, :3].T)
    return np.asarray(np.concatenate([turn, T_map_body[:3, 3] - T_map_reference[:3, 3]]))


def boxplus(T_map_body: Pose, step: Floats) -> Pose:
    """Return the pose moved by ``step`` (6,) along the map's axes; undoes :func:`boxminus`."""
    moved: Pose = T_map_body.copy()
    moved[:3, :3] = exp_so3(step[:3]) @ T_map_body[:3, :3]
    moved[:3, 3] += step[3:]
    return moved


def relative(T_map_a: Poses, T_map_b: Poses) -> Poses:
    """Return poses (..., 4, 4) of b in the frames of a."""
    R_t = np.swapaxes(T_map_a[..., :3, :3], -1, -2)
    T = np.zeros(np.broadcast_shapes(T_map_a.shape, T_map_b.shape))
    T[..., :3, :3] = R_t @ T_map_b[..., :3, :3]
    T[..., :3, 3:] = R_t @ (T_map_b[..., :3, 3:] - T_map_a[..., :3, 3:])
    T[..., 3, 3] = 1.0
    return T


def moved(T: Poses, xi: Floats) -> Poses:
    """Return poses (..., 4, 4) moved along their bodies' axes by xi (..., 6): T exp(xi), to first order."""
    out = T.copy()
    out[..., :3, :3] = T[..., :3, :3] @ exp_so3(xi[..., :3])
    out[..., :3, 3:] += T[..., :3, :3] @ xi[..., 3:, None]
    return out


def adjoint(T: Poses) -> Floats:
    """Return the matrices (..., 6, 6) with T exp(xi) = exp(Ad xi) T."""
    Ad = np.zeros((*T.shape[:-2], 6, 6))
    Ad[..., :3, :3] = Ad[..., 3:, 3:] = T[..., :3, :3]
    Ad[..., 3:, :3] = skew(T[..., :3, 3]) @ T[..., :3, :3]
    return Ad


def log_se3(T: Poses) -> tuple[Floats, Floats]:
    """Return the logarithms xi (..., 6) of poses (..., 4, 4), and their derivatives D (..., 6, 6).

    log(T exp(d)) = xi + D d to first order: D is the inverse of the right Jacobian, I + ad/2 + a ad^2 + b ad^4 with
    ad [u, v] = [xi, (u, v)] (Bullo and Murray, "Proportional derivative control on the Euclidean group", ECC 1995).
    """
    turn = log_so3(T[..., :3, :3])
    angle = np.sqrt((turn * turn).sum(axis=-1))[..., None, None]
    small = angle < 0.03  # radians, below which the next terms of the series are 1e-5 of its first
    half = 0.5 * np.where(small, 1.0, angle)
    slope, bend = half / np.tan(half), (half / np.sin(half)) ** 2
    mean = 0.5 * (slope - bend)
    a1 = np.where(small, 1 / 12 + angle**2 / 720, (1.0 - slope) / (4.0 * half**2))
    a2 = np.where(small, 1 / 12, (2.0 * (1.0 - slope) + mean) / (4.0 * half**2))
    b = np.where(small, -1 / 720, (1.0 - slope + mean) / (16.0 * half**4))
    K = skew(turn)
    shift = (np.eye(3) - 0.5 * K + a1 * (K @ K)) @ T[..., :3, 3:]
    ad = np.zeros((*T.shape[:-2], 6, 6))
    ad[..., :3, :3] = ad[..., 3:, 3:] = K
    ad[..., 3:, :3] = skew(shift[..., 0])
    squared = ad @ ad
    return np.concatenate([turn, shift[..., 0]], axis=-1), np.eye(6) + 0.5 * ad + a2 * squared + b * squared @ squared


@dataclass(frozen=True)
class Circle:
    """Circle in a horizontal plane, metres, cut to x from ``begin`` to ``end``."""

    x: float
    y: float
    radius: float
    begin: float = -math.inf
    end: float = math.inf

    def holds(self, positions: Reals) -> Bools:
        """Return a mask of the positions (N, 2 or 3) within the circle, regardless of height."""
        x = positions[:, 0]
        away = np.asarray(positions[:, :2], dtype=np.float64) - (self.x, self.y)
        return np.asarray(((away * away).sum(axis=1) <= self.radius**2) & (x >= self.begin) & (x < self.end))


def position_of(T: Pose) -> Floats:
    """Return the position (3,) of a pose, metres; a copy."""
    return np.array(T[:3, 3], dtype=np.float64)


def quaternion_of(T: Pose) -> Floats:
    """Return the unit quaternion (4,) x y z w of a pose."""
    return matrix_to_quat(T[:3, :3])


def stddev_of(covariance: Floats) -> Floats:
    """Return one sigma (6,) of x, y, z, roll, pitch, yaw, metres and radians; NaN for an unknown variance."""
    return np.asarray(np.sqrt(np.diag(covariance)))


def pose_fields(T: Pose, covariance: Floats | None) -> dict[str, Any]:
    """Return a pose as plain data: position, orientation (quaternion) and row-major covariance, None if unknown."""
    known = covariance is not None and not np.isnan(covariance).any()
    return {
        "position": position_of(T).tolist(),
        "orientation": quaternion_of(T).tolist(),
        "covariance": np.ravel(covariance).tolist() if known and covariance is not None else None,
    }


def place_fields(T: Pose) -> dict[str, Any]:
    """Return a pose as plain data: position and orientation (quaternion)."""
    return {"position": position_of(T).tolist(), "orientation": quaternion_of(T).tolist()}


def pose_in_words(T: Pose, covariance: Floats | None) -> str:
    """Return a pose in half a line: ``x 12.30, y 4.00, z 1.70 m, yaw 12.3 deg, sigma 0.02 m``."""
    x, y, z = T[:3, 3].tolist()
    sigma = math.nan if covariance is None else math.sqrt(abs(float(np.trace(covariance[:3, :3]))))
    spread = "" if math.isnan(sigma) else f", sigma {sigma:.2g} m"
    return f"x {x:.2f}, y {y:.2f}, z {z:.2f} m, yaw {math.degrees(yaw_of(T)):.1f} deg{spread}"
