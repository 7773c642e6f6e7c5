"""Deskewing: moves a sweep's points to their positions in the body frame at the frame's stamp."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, interpolate, inverse
from coview_stream.odometry.buffer import Segment

_STEPS = 128  # poses along the sweep: 0.8 ms of a 10 Hz sweep, a centimetre at 12 m/s
_INSTANT = 1e-4  # seconds; smaller time differences are ignored


@dataclass(frozen=True)
class SweepCorrection:
    """Calibration of sensor and odometry by which :func:`deskew` corrects the motion within a sweep."""

    R_body_cloud: Floats  # (3, 3) rotation that levels clouds of a leaning sensor
    scale: float = 0.0  # correction factor of odometry's distances, minus one


def deskew(
    points: Points,
    times: Floats,
    segment: Segment,
    stamp_ns: int,
    T_odom_body: Pose,
    correction: SweepCorrection | None = None,
) -> Points:
    """Return the points (N, 3) in the body frame at ``stamp_ns``; a leaning cloud stays leaning.

    Args:
        points: (N, 3) float32, each in the body frame at its own time, metres.
        times: (N,) seconds after ``stamp_ns`` (negative before), 0 if not finite; beyond the segment its end counts.
        segment: odometry that covers the sweep; with fewer than two samples nothing moves.
        stamp_ns: the frame's stamp.
        T_odom_body: (4, 4) odometry at that stamp.
        correction: of a leaning sensor and of odometry; default none.
    """
    if len(segment.stamps) < 2 or not len(points):
        return points
    at = (segment.stamps - stamp_ns) * 1e-9
    clipped = np.clip(np.where(np.isfinite(times), times, 0.0), at[0], at[-1])
    low, high = float(clipped.min()), float(clipped.max())
    if max(-low, high) < _INSTANT:
        return points
    grid = np.linspace(low, high, _STEPS)
    relative = inverse(T_odom_body) @ segment.poses
    k = np.clip(np.searchsorted(at, grid, side="right") - 1, 0, len(at) - 2)
    share = (grid - at[k]) / (at[k + 1] - at[k])
    body = interpolate(relative[k], relative[k + 1], share)
    if correction is not None:
        R = correction.R_body_cloud
        body[:, :3, 3] *= 1.0 + correction.scale
        body[:, :3, :3] = R.T @ body[:, :3, :3] @ R
        body[:, :3, 3] = body[:, :3, 3] @ R  # each row by the transposed rotation
    motion = body.astype(np.float32)
    step = np.rint((clipped - low) * ((_STEPS - 1) / max(high - low, _INSTANT))).astype(np.intp)
    moved = np.einsum("nij,nj->ni", motion[step, :3, :3], points) + motion[step, :3, 3]
    return np.asarray(moved, dtype=np.float32)
