"""Planar motions (..., 3): x and y in metres along the level axes of the earlier pose, and the rotation in radians.

A planar pose is the motion from the origin.
"""

from __future__ import annotations

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, pose_from, rot_z, yaw_of


def planar_motion(T_before: Pose, T_now: Pose) -> Floats:
    """Return the motion (3,) between two poses (4, 4)."""
    return between(planar_pose(T_before), planar_pose(T_now))


def planar_pose(T: Pose) -> Floats:
    """Return position and heading (3,) of a pose (4, 4)."""
    return np.array([T[0, 3], T[1, 3], yaw_of(T)])


def planar_covariance(covariance: Floats, T: Pose) -> Floats:
    """Turn a covariance (6, 6) over (rx, ry, rz, x, y, z), map axes, into that (3, 3) of planar motions from ``T``."""
    R = rot_z(-yaw_of(T))
    return np.asarray(R @ covariance[np.ix_([3, 4, 2], [3, 4, 2])] @ R.T)


def spatial(motion: Floats) -> Pose:
    """Return a motion (3,) as a pose (4, 4)."""
    return pose_from(rot_z(float(motion[2])), [motion[0], motion[1], 0.0])


def compose(a: Floats, b: Floats) -> Floats:
    """Return motions ``a`` (..., 3), each followed by ``b`` (..., 3); turns in [-pi, pi)."""
    x, y = _turned(a[..., 2], b)
    return np.stack([a[..., 0] + x, a[..., 1] + y, _wrapped(a[..., 2] + b[..., 2])], axis=-1)


def inverted(a: Floats) -> Floats:
    """Return the inverse motions (..., 3)."""
    x, y = _turned(-a[..., 2], a)
    return np.stack([-x, -y, -a[..., 2]], axis=-1)


def between(before: Floats, now: Floats) -> Floats:
    """Return the motions (..., 3) from poses ``before`` to poses ``now`` (..., 3); turns in [-pi, pi)."""
    gap = now - before
    x, y = _turned(-before[..., 2], gap)
    return np.stack([x, y, _wrapped(gap[..., 2])], axis=-1)


def smoothly_between(at: Floats, stamps: Floats, poses: Floats) -> Floats:
    """Interpolate poses (N, 3) at stamps (N,) to moments (L,) by cubics, with speeds from differences: (L, 3).

    Headings must not be wrapped.
    """
    after = np.clip(np.searchsorted(stamps, at, side="right"), 1, len(stamps) - 1)
    span = (stamps[after] - stamps[after - 1])[:, None]
    s = (at - stamps[after - 1])[:, None] / span
    speed = np.gradient(poses, stamps, axis=0)
    start, end = poses[after - 1], poses[after]
    leaving, arriving = span * speed[after - 1], span * speed[after]
    cubic = leaving + arriving + 2.0 * (start - end)
    return np.asarray(start + s * (leaving + s * (end - start - leaving - cubic + s * cubic)))


def _turned(angle: Floats, v: Floats) -> tuple[Floats, Floats]:
    c, s = np.cos(angle), np.sin(angle)
    return c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]


def _wrapped(angle: Floats) -> Floats:
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)
