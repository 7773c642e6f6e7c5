"""Odometry of the last seconds, at any moment."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, Poses, interpolate, inverse, log_so3, pose_from, rot_z

_VELOCITY_OVER = 0.2  # seconds over which a velocity is measured: the rotation of a shaking robot averages out
_REMEMBERED = 10.0  # seconds of odometry, longer than any queue of clouds


class Moment(NamedTuple):
    """Moment at which a cloud was measured, with the body's velocities then."""

    stamp: float  # of the cloud, seconds
    rates: Floats  # (3,) velocities x, y and rotation about z of the body, its axes; NaN if unknown


class OdometryHistory:
    """Odometry of the last seconds at any moment: interpolated, or extrapolated at constant velocity."""

    def __init__(self) -> None:
        self._stamps: list[float] = []
        self._poses: list[Pose] = []

    @classmethod
    def of(cls, stamps: Floats, poses: Poses) -> OdometryHistory:
        """Return the history of a whole run: poses (N, 4, 4) at increasing stamps (N,)."""
        history = cls()
        history._stamps, history._poses = stamps.tolist(), list(poses)
        return history

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp: float, T_odom_body: Pose) -> None:
        """Add a pose (4, 4) at a later stamp."""
        if len(self._stamps) > 2 and self._stamps[1] < stamp - _REMEMBERED:
            del self._stamps[0], self._poses[0]
        self._stamps.append(stamp)
        self._poses.append(T_odom_body)

    def at(self, stamp: float) -> Pose:
        """Return the pose (4, 4), odometry <- body, at a stamp; IndexError if no pose has been added."""
        k = bisect_left(self._stamps, stamp)
        if k < len(self._stamps) and self._stamps[k] == stamp:
            return self._poses[k]
        if len(self._stamps) < 2:
            return self._poses[0]
        if k == len(self._stamps):
            return self._beyond(stamp)
        before, after = self._around(stamp)
        share = (stamp - self._stamps[before]) / (self._stamps[after] - self._stamps[before])
        return interpolate(self._poses[before], self._poses[after], share)

    def rates(self, stamp: float) -> Floats:
        """Return the velocities (3,) x, y and rotation about z of the body at a stamp, in its axes; NaN if unknown."""
        if len(self._stamps) < 2:
            return np.full(3, np.nan)
        before, after = self._around(stamp)
        if before > 0 and after < len(self._stamps) - 1:  # average over both sides
            early = stamp - self._stamps[before] < self._stamps[after] - stamp
            before, after = (before - 1, after) if early else (before, after + 1)
        motion = inverse(self._poses[before]) @ self._poses[after]
        turned = float(log_so3(motion[:3, :3])[2])
        middle = rot_z(-0.5 * turned) @ motion[:3, 3]
        return np.append(middle[:2], turned) / (self._stamps[after] - self._stamps[before])

    def since_clouds(self, stamps: Floats, delay: float, scale: float) -> Poses:
        """Return the body's scaled motions (N, 4, 4) from the moments of late clouds to their stamps (N,).

        Where odometry is the late one (``delay`` below zero) the moments are the stamps.
        """
        if delay <= 0.0 or len(self._stamps) < 2:
            return np.tile(np.eye(4), (len(stamps), 1, 1))
        motions = np.linalg.inv(self.all_at(stamps - delay)) @ self.all_at(stamps)
        motions[:, :3, 3] *= 1.0 + scale
        return np.asarray(motions)

    def covers(self, begin: float, end: float) -> bool:
        """Return whether there is odometry from before ``begin`` until after ``end``, seconds."""
        return bool(self._stamps) and self._stamps[0] <= begin and self.reaches(end)

    def reaches(self, end: float) -> bool:
        """Return whether there is odometry after ``end``, seconds."""
        return bool(self._stamps) and end <= self._stamps[-1]

    def all_at(self, stamps: Floats) -> Poses:
        """Return the poses (N, 4, 4) at stamps (N,), interpolated, or extrapolated beyond the ends; needs two poses."""
        known = np.array(self._stamps)
        after = np.clip(np.searchsorted(known, stamps), 1, len(known) - 1)
        low, high = after.min() - 1, after.max()
        poses = np.array(self._poses[low : high + 1])
        share = (stamps - known[after - 1]) / (known[after] - known[after - 1])
        return interpolate(poses[after - 1 - low], poses[after - low], share)

    def noise_share(self, begins: Floats, ends: Floats) -> Floats:
        """Return the variances (N,) of motions from ``begins`` to ``ends`` (N,) by odometry's white noise.

        The unit is the variance of an equally long motion from stamp to stamp: interpolation averages a step's noise.
        """
        known = np.array(self._stamps)
        parts = np.diff(np.clip(known[None], begins[:, None], ends[:, None]), axis=1)
        return np.asarray((parts**2 / np.diff(known)).sum(axis=1) / (ends - begins))

    def _beyond(self, stamp: float) -> Pose:
        """Return the newest pose (4, 4), extrapolated to a later stamp along an arc."""
        begin = max(bisect_right(self._stamps, self._stamps[-1] - _VELOCITY_OVER) - 1, 0)
        motion = inverse(self._poses[begin]) @ self._poses[-1]
        times = (stamp - self._stamps[-1]) / (self._stamps[-1] - self._stamps[begin])
        turned = float(log_so3(motion[:3, :3])[2])
        moved = times * (rot_z(0.5 * (times - 1.0) * turned) @ motion[:3, 3])
        return np.asarray(self._poses[-1] @ pose_from(rot_z(times * turned), moved))

    def _around(self, stamp: float) -> tuple[int, int]:
        """Return the indices of the poses before and after a stamp, or of the nearest two."""
        after = min(max(bisect_left(self._stamps, stamp), 1), len(self._stamps) - 1)
        return after - 1, after
