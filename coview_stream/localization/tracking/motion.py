"""Motion while tracking: how far odometry has driven since the newest keyframe, and the newest frames' points."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from coview_stream.config import TrackingConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.se3 import boxminus
from coview_stream.geometry.transforms import Points, Pose, inverse, yaw_of
from coview_stream.localization.tracking.odometry_noise import Drift, DriftEstimator, worth_learning

MAX_FRAMES = 40
"""Frames whose points are held; set by hand."""

_OWN_NOISE = 0.4
"""Share of two neighbouring registrations' variances that is in their difference; the rest they have in common.

Seen once on the simulated drives of ``python -m bench tracking --seeds 5100``; no command prints it.
"""


@dataclass(frozen=True)
class _Mark:
    """Odometry at one moment: pose (4, 4), metres driven and radians turned so far."""

    T_odom_body: Pose
    travelled: float
    turned: float


@dataclass(frozen=True)
class _Registered:
    """A verified registration: the pose (4, 4) as the map alone has it, its variances (6,), and where odometry was."""

    T_map_body: Pose
    variances: Floats
    mark: _Mark


class OdometryTracker:
    """Metres and radians of odometry, altogether and since the newest keyframe, and its drift as measured.

    Attributes:
        travelled: metres driven.
        pose: (4, 4) the newest; None before the first, and where odometry may have jumped.
    """

    def __init__(self, config: TrackingConfig) -> None:
        self.travelled = 0.0
        self.pose: Pose | None = None
        self._turned = 0.0
        self._keyframe = _Mark(np.eye(4), 0.0, 0.0)
        self._estimator = DriftEstimator(config)
        self._registered: _Registered | None = None

    def add_pose(self, T_odom_body: Pose) -> None:
        """Add the pose (4, 4) of a frame."""
        if self.pose is not None:
            self.travelled += float(np.linalg.norm(T_odom_body[:3, 3] - self.pose[:3, 3]))
            # about the vertical: a robot that shakes does not turn
            self._turned += abs(yaw_of(inverse(self.pose) @ T_odom_body))
        self.pose = T_odom_body

    def forget_pose(self) -> None:
        """Count nothing up to the next pose: odometry may have jumped."""
        self.pose = None

    def set_keyframe(self, T_odom_body: Pose) -> None:
        """Take the newest frame as a keyframe."""
        self._keyframe = _Mark(T_odom_body, self.travelled, self._turned)

    def since_keyframe(self) -> tuple[float, float]:
        """Return metres driven and radians turned since the newest keyframe."""
        return self.travelled - self._keyframe.travelled, self._turned - self._keyframe.turned

    def motion(self, T_odom_body: Pose) -> Pose:
        """Return the motion (4, 4) of the body since the newest keyframe."""
        return inverse(self._keyframe.T_odom_body) @ T_odom_body

    @property
    def drift(self) -> Drift:
        """Rates of odometry's drift, as measured so far."""
        return self._estimator.drift

    def learn(self, T_map_body: Pose, covariance: Floats) -> None:
        """Learn the drift from a verified registration at the newest keyframe.

        Args:
            T_map_body: (4, 4) as the map alone has it.
            covariance: (6, 6) of that.
        """
        before, now = self._registered, self._keyframe
        variances = np.diag(covariance)
        if before is not None:
            driven, turned = now.travelled - before.mark.travelled, now.turned - before.mark.turned
            if not worth_learning(driven, turned):
                return
            step = inverse(before.mark.T_odom_body) @ now.T_odom_body
            gap = boxminus(T_map_body, before.T_map_body @ step)
            noise = _OWN_NOISE * (variances + before.variances)
            self._estimator.add(gap, noise, driven, turned)
        self._registered = _Registered(T_map_body, variances, now)

    def forget_registration(self) -> None:
        """Compare the next registration with none before it; the rates stay."""
        self._registered = None


@dataclass(frozen=True)
class _BufferedScan:
    """A frame's points (N, 3), odometry frame, and the metres driven when it was seen."""

    travelled: float
    points: Points


class ScanBuffer:
    """Points of at most 40 frames, odometry frame, newest last."""

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._frames: deque[_BufferedScan] = deque(maxlen=MAX_FRAMES)

    def add(self, points: Points, travelled: float) -> None:
        """Add a frame (N, 3), seen after ``travelled`` metres."""
        self._frames.append(_BufferedScan(travelled, points))

    def clear(self) -> None:
        """Forget them all."""
        self._frames.clear()

    def keep_newest(self, count: int) -> None:
        """Forget all but the newest ``count`` frames."""
        while len(self._frames) > count:
            self._frames.popleft()

    @property
    def newest(self) -> Points | None:
        """(N, 3) points of the newest frame, odometry frame."""
        return self._frames[-1].points if self._frames else None

    def window(self) -> Points:
        """Points (N, 3) of the newest frames, as :class:`coview_stream.config.TrackingConfig` has it; perhaps none."""
        parts: list[Points] = []
        count = 0
        for frame in reversed(self._frames):
            old = self._frames[-1].travelled - frame.travelled > self._config.window
            if count >= self._config.max_points or (old and count >= self._config.min_points):
                break
            parts.append(frame.points)
            count += len(frame.points)
        return np.concatenate(parts) if parts else np.empty((0, 3), dtype=np.float32)
