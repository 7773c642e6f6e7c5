"""Rigid transforms in 3-D, as 4x4 float64 matrices.

``T_target_source`` maps coordinates of the *source* frame into the *target* frame:
``p_target = T_target_source @ p_source``. Metres and radians throughout.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import numpy.typing as npt

from coview_stream.geometry.arrays import Floats, Reals
from coview_stream.geometry.rotations import matrix_to_quat, nearest_rotation, quat_to_matrix, slerp

_Real = TypeVar("_Real", np.float32, np.float64)

Pose = npt.NDArray[np.float64]
"""A 4x4 float64 rigid transform."""

Poses = npt.NDArray[np.float64]
"""(N, 4, 4) float64 rigid transforms."""

Points = npt.NDArray[np.float32]
"""(N, 3) float32 coordinates near the origin of their frame, metres."""


def pose_from(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> Pose:
    """Return the pose (4, 4) of a rotation matrix (3, 3) and a translation (3,) in metres."""
    T = np.eye(4)
    T[:3, :3] = np.asarray(rotation, dtype=np.float64)
    T[:3, 3] = np.asarray(translation, dtype=np.float64)
    return T


def inverse(T: Pose) -> Pose:
    """Invert a rigid transform, without a general matrix inversion."""
    R_t = T[:3, :3].T
    return pose_from(R_t, -R_t @ T[:3, 3])


def transform(T: Pose, points: npt.NDArray[_Real]) -> npt.NDArray[_Real]:
    """Apply ``T`` to (N, 3) points, in the points' own precision."""
    R = T[:3, :3].astype(points.dtype)
    t = T[:3, 3].astype(points.dtype)
    moved: npt.NDArray[_Real] = points @ R.T + t
    return moved


def norms(points: npt.NDArray[_Real], origin: npt.NDArray[_Real] | None = None) -> npt.NDArray[_Real]:
    """Return the distances (N,) of points (N, 3) from ``origin`` (3,), by default zero, in the points' precision."""
    # by columns: np.linalg.norm along the short axis takes ten times as long, for the same numbers
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
    # the sine keeps its precision near zero, where the cosine of eq. 15 has none left
    R = T[:3, :3]
    sine = 0.5 * np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return float(np.arctan2(sine, 0.5 * (np.trace(R) - 1.0)))


def tilt_of(T: Pose) -> float:
    """Return the angle between the vertical axes of two frames, radians."""
    return float(np.arccos(np.clip(T[2, 2], -1.0, 1.0)))


def orthonormal(T: Pose) -> Pose:
    """Return ``T`` with its rotation projected back onto SO(3) (drift from repeated products)."""
    return pose_from(nearest_rotation(T[:3, :3]), T[:3, 3])


def is_pose(T: Reals) -> bool:
    """Whether ``T`` is a finite 4x4 rigid transform (rotation orthonormal to 1e-3)."""
    if T.shape != (4, 4) or not np.isfinite(T).all():
        return False
    R = T[:3, :3]
    return bool(np.abs(R @ R.T - np.eye(3)).max() < 1e-3 and np.linalg.det(R) > 0)


def interpolate(T_start: Poses, T_end: Poses, share: npt.ArrayLike) -> Poses:
    """Return poses (..., 4, 4), the ``share`` (...) of the way from ``T_start`` to ``T_end`` (..., 4, 4).

    The rotation turns at a constant rate the short way round, the position moves along a straight line. Shares outside
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
    """Return the same pose with the odometry frame's origin moved to ``anchor`` (3,), where float32 stays exact."""
    return pose_from(T_odom_body[:3, :3], T_odom_body[:3, 3] - anchor)


def to_map_origin(T_map_local: Pose, anchor: Floats, origin: Floats) -> Pose:
    """Return ``T_map_odom`` in the source's frame from the localizer's: undo both shifts, in float64."""
    shifted = T_map_local @ inverse(pose_from(np.eye(3), anchor))
    return pose_from(shifted[:3, :3], shifted[:3, 3] + origin)
