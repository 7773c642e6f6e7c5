"""Preparation of frames: the checks of a frame, and its odometry corrected by the calibration."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass

import numpy as np

import coview_kernels as kernels
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import (
    Points,
    Pose,
    exp_so3,
    interpolate,
    inverse,
    log_so3,
    pose_from,
    rot_z,
    to_local,
)
from coview_stream.geometry.validation import validate_cloud, validate_odometry
from coview_stream.localization.calibration.calibration import Calibration, RawScan
from coview_stream.localization.calibration.estimator import CalibrationEstimator
from coview_stream.localization.calibration.frame_motion import FrameMotion, Variances
from coview_stream.localization.witness.first_motions import Conventions

# sigmas of roll and pitch of a registered place
_LEADER_TILT = math.radians(1.0)  # that leads the search, if it is the right one
_PLACE_TILT = math.radians(0.5)  # that is accepted
_VELOCITY_OVER = 0.2  # seconds that a velocity is measured over; a robot that shakes does not turn
_REMEMBERED = 4.0  # seconds of odometry; no queue of clouds is longer


@dataclass(frozen=True)
class PreparedFrame:
    """One frame, checked and corrected.

    Attributes:
        cloud: (N, 3) float32, the sensor's own axes.
        T_odom_body: (4, 4) corrected odometry of the cloud's moment, about the anchor.
        T_odom_raw: (4, 4) odometry as it came, of the stamp.
        stamp: seconds.
        scan: one point per voxel.
    """

    cloud: Points
    T_odom_body: Pose
    T_odom_raw: Pose
    stamp: float
    scan: RawScan


class FramePreparation:
    """Preparation of a robot's frames, and the estimate of its calibration.

    Attributes:
        estimator: of the calibration; learns from registrations too.
        conventions: judge of units and axes.
        anchor: (3,) origin of the odometry in use: near it float32 is exact; None before the first frame.
    """

    def __init__(self, config: LocalizerConfig) -> None:
        self.estimator = CalibrationEstimator(config.sensor_leans)
        self.conventions = Conventions()
        self.anchor: Floats | None = None
        self._odometry = OdometryCorrection()
        self._history = OdometryHistory()
        self._motion = FrameMotion(config.registration, config.keyframe.distance)
        self._newest: float | None = None  # stamp of the newest frame
        self._limits = config.keyframe.voxel, config.keyframe.range_min

    @property
    def calibration(self) -> Calibration:
        """The present calibration."""
        return self.estimator.calibration

    def restart(self) -> None:
        """Go on in another frame of odometry, with the same calibration."""
        self.estimator.begin_odometry()
        self.conventions.clear()
        self._odometry, self._history = OdometryCorrection(), OdometryHistory()
        self._motion.clear()
        self.anchor = self._newest = None

    def forget_odometry(self) -> None:
        """Connect the next frame with none before it: odometry may have jumped."""
        self.forget_keyframe()
        self.anchor = None

    def forget_keyframe(self) -> None:
        """Measure no motion from the newest keyframe to the next."""
        self._motion.clear()

    def prepare(self, cloud: Points, T_odom_body: Pose, stamp: float, drift: Variances | None = None) -> PreparedFrame:
        """Check and correct a frame.

        Args:
            cloud: as of :meth:`coview_stream.localization.localizer.Localizer.step`.
            T_odom_body: likewise.
            stamp: likewise.
            drift: of odometry, to correct a keyframe's motion by its registration to the last keyframe. None while a
                place is known, as registrations to the map measure the motion better.

        Raises:
            CloudError, RunError: the frame is unusable; nothing has changed.
        """
        raw, T_raw = validate_cloud(cloud), validate_odometry(T_odom_body, stamp, self._newest)
        delay = self.calibration.delay
        before = None if self._newest is None else self._history.at(self._newest - delay)
        self._history.add(stamp, T_raw)
        T = self._odometry.correct(self._history.at(stamp - delay), self.calibration, before)
        rates = self._history.rates(stamp - delay)
        self._newest = stamp
        if drift is not None or not self.conventions.plausible:
            self.conventions.add(raw, T_raw)
        if self.anchor is None:
            self.anchor = T[:3, 3].copy()
        T = to_local(T, self.anchor)
        if drift is not None and self._motion.is_due(T):
            T = self._motion.refine(self._voxels(raw, np.eye(4)), T, self.estimator, drift, rates)
            self._odometry.move_to(pose_from(T[:3, :3], T[:3, 3] + self.anchor))
        points = self._voxels(raw, T @ self.calibration.T_body_cloud)
        return PreparedFrame(raw, T, T_raw, stamp, RawScan(points, T, self.calibration, rates))

    def since_cloud(self, stamp: float) -> Pose:
        """Return the body's motion (4, 4) from the moment of a cloud, which may be late, to its stamp, corrected.

        Where odometry is late instead the cloud's moment is the stamp.
        """
        calibration = self.calibration
        if calibration.delay <= 0.0:
            return np.eye(4)
        motion = inverse(self._history.at(stamp - calibration.delay)) @ self._history.at(stamp)
        motion[:3, 3] *= 1.0 + calibration.scale
        return motion

    def learn_place(self, T_map_cloud: Pose, T_odom_body: Pose, probability: float | None = None) -> Pose:
        """Learn the tilt from a place of the search; return its ``T_map_odom`` (4, 4) by the new calibration.

        Args:
            T_map_cloud: (4, 4) registered pose of a keyframe's cloud in the sensor's own axes.
            T_odom_body: (4, 4) corrected odometry of the keyframe.
            probability: of a place that leads the search; None for an accepted place.
        """
        if probability is None:
            self.estimator.measure_attitude(T_map_cloud, T_odom_body, _PLACE_TILT**2)
        else:
            self.estimator.suppose_attitude(T_map_cloud, T_odom_body, _LEADER_TILT**2, probability)
        return T_map_cloud @ inverse(T_odom_body @ self.calibration.T_body_cloud)

    def _voxels(self, cloud: Points, T: Pose) -> Points:
        return kernels.transform_unique(cloud, T, *self._limits)[0]


class OdometryHistory:
    """Odometry of the last seconds, read at any moment: interpolated, and beyond its ends at constant velocities."""

    def __init__(self) -> None:
        self._stamps: list[float] = []
        self._poses: list[Pose] = []

    def add(self, stamp: float, T_odom_body: Pose) -> None:
        """Add a pose (4, 4) at a later stamp."""
        if len(self._stamps) > 2 and self._stamps[1] < stamp - _REMEMBERED:
            del self._stamps[0], self._poses[0]
        self._stamps.append(stamp)
        self._poses.append(T_odom_body)

    def at(self, stamp: float) -> Pose:
        """Return the pose (4, 4), odometry <- body, at a stamp; IndexError before the first pose."""
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
        if before > 0 and after < len(self._stamps) - 1:  # a mean over both sides
            early = stamp - self._stamps[before] < self._stamps[after] - stamp
            before, after = (before - 1, after) if early else (before, after + 1)
        motion = inverse(self._poses[before]) @ self._poses[after]
        turned = float(log_so3(motion[:3, :3])[2])
        middle = rot_z(-0.5 * turned) @ motion[:3, 3]
        return np.append(middle[:2], turned) / (self._stamps[after] - self._stamps[before])

    def _beyond(self, stamp: float) -> Pose:
        """Return the newest pose (4, 4), moved on to a later stamp on an arc."""
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


class OdometryCorrection:
    """Correction of odometry's scale and heading, step by step; turns are about the vertical.

    A corrected step does not change when the calibration does.
    """

    def __init__(self) -> None:
        self._before: Pose | None = None  # not corrected
        self._position = np.zeros(3)
        self._turned = 0.0

    def correct(self, T_odom_body: Pose, calibration: Calibration, before: Pose | None = None) -> Pose:
        """Return the next pose (4, 4), odometry <- body, corrected; ``before`` replaces the previous one."""
        if self._before is not None and before is not None:
            self._before = before
        if self._before is None:
            self._position = T_odom_body[:3, 3].copy()
        else:
            step = T_odom_body[:3, 3] - self._before[:3, 3]
            turn = calibration.turn * float(np.linalg.norm(step))
            middle = exp_so3(np.array([0.0, 0.0, self._turned + 0.5 * turn]))
            self._position = self._position + (1.0 + calibration.scale) * (middle @ step)
            self._turned += turn
        self._before = T_odom_body
        return self._corrected(T_odom_body)

    def move_to(self, T_odom_body: Pose) -> Pose:
        """Go on from another pose (4, 4) than the newest corrected pose; roll and pitch stay odometry's."""
        assert self._before is not None  # there is a newest one
        now = self._corrected(self._before)
        self._turned += float(log_so3(T_odom_body[:3, :3] @ now[:3, :3].T)[2])
        self._position = T_odom_body[:3, 3].copy()
        return self._corrected(self._before)

    def _corrected(self, T_odom_body: Pose) -> Pose:
        return pose_from(exp_so3(np.array([0.0, 0.0, self._turned])) @ T_odom_body[:3, :3], self._position)
