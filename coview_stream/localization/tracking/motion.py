"""Odometry while tracking: how far it has driven since when, and how wrong registrations show it to be."""

# FOLDED coview_stream/localization/tracking/motion.py: """The newest frames' points: what a registration is made of."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from coview_stream.config import TrackingConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.se3 import boxminus
from coview_stream.geometry.transforms import Points, Pose, inverse, yaw_of
from coview_stream.localization.tracking.odometry_noise import Drift, DriftEstimator, worth_learning

_OWN_NOISE = 0.4  # of two neighbouring registrations' variances, in their difference; the rest they share


@dataclass(frozen=True)
class _Mark:
    """Odometry at one moment: pose (4, 4), metres driven and radians turned so far."""

    T_odom_body: Pose
    travelled: float
    turned: float


@dataclass(frozen=True)
class _Registered:
    """A registration that was believed: the pose (4, 4) as the map alone has it, its variances (6,), and when."""

    T_map_body: Pose
    variances: Floats
    mark: _Mark


class OdometryTracker:
    """Counts what odometry drives and turns, altogether and since the newest keyframe, and measures its drift.

    Attributes:
        travelled: metres driven.
        pose: (4, 4) the newest; None before the first, and where odometry may have jumped.
    """

    def __init__(self, config: TrackingConfig) -> None:
        self.travelled = 0.0
        self.pose: Pose | None = None
        self._turned = 0.0
        self._keyframe = _Mark(np.eye(4), 0.0, 0.0)
        self._rates = DriftEstimator(config)
        self._registered: _Registered | None = None

    def move(self, T_odom_body: Pose) -> None:
        """Take in the pose (4, 4) of a frame."""
        if self.pose is not None:
            self.travelled += float(np.linalg.norm(T_odom_body[:3, 3] - self.pose[:3, 3]))
            # about the vertical: a robot that shakes does not turn
            self._turned += abs(yaw_of(inverse(self.pose) @ T_odom_body))
        self.pose = T_odom_body

    def break_off(self) -> None:
        """Count nothing up to the next pose: odometry may have jumped."""
        self.pose = None

    def mark(self, T_odom_body: Pose) -> None:
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
        """How fast odometry seems to drift."""
        return self._rates.drift

    def learn(self, T_map_body: Pose, covariance: Floats) -> None:
        """Take note of where a registration at the newest keyframe was believed to be, by the map alone."""
        before, now = self._registered, self._keyframe
        variances = np.diag(covariance)
        if before is not None:
            driven, turned = now.travelled - before.mark.travelled, now.turned - before.mark.turned
            if not worth_learning(driven, turned):
                return
            step = inverse(before.mark.T_odom_body) @ now.T_odom_body
            gap = boxminus(T_map_body, before.T_map_body @ step)
            noise = _OWN_NOISE * (variances + before.variances)
            self._rates.add(gap, noise, driven, turned)
        self._registered = _Registered(T_map_body, variances, now)

    def unlearn(self) -> None:
        """Compare the next registration with none before it; the rates stay."""
        self._registered = None


MAX_FRAMES = 40


@dataclass(frozen=True)
class _BufferedScan:
    travelled: float
    points: Points  # (N, 3) odometry frame


class ScanBuffer:
    """Points of at most 40 frames, odometry frame, newest last."""

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._frames: deque[_BufferedScan] = deque(maxlen=MAX_FRAMES)

    def add(self, points: Points, travelled: float) -> None:
        """Take in a frame (N, 3), seen after ``travelled`` metres."""
        self._frames.append(_BufferedScan(travelled, points))

    def clear(self) -> None:
        """Forget them all."""
        self._frames.clear()

    def keep(self, most: int) -> None:
        """Forget all but the newest ``most``."""
        while len(self._frames) > most:
            self._frames.popleft()

    @property
    def newest(self) -> Points | None:
        """(N, 3) points of the newest frame, odometry frame."""
        return self._frames[-1].points if self._frames else None

    def window(self) -> Points:
        """Points of the newest frames: of the last metres, more if they are too few."""
        parts: list[Points] = []
        count = 0
        for frame in reversed(self._frames):
            old = self._frames[-1].travelled - frame.travelled > self._config.window
            if count >= self._config.max_points or (old and count >= self._config.min_points):
                break
            parts.append(frame.points)
            count += len(frame.points)
        return np.concatenate(parts) if parts else np.empty((0, 3), dtype=np.float32)
