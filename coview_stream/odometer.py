"""Odometry while tracking: how far it has driven since when, and how wrong registrations show it to be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from coview_stream.config import TrackingConfig
from coview_stream.geometry import Pose, inverse, yaw_of
from coview_stream.pose.drift import Drift, DriftEstimator, worth_learning
from coview_stream.pose.tangent import Matrix6, difference

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
    variances: npt.NDArray[np.float64]
    mark: _Mark


class Odometer:
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

    def learn(self, T_map_body: Pose, covariance: Matrix6) -> None:
        """Take note of where a registration at the newest keyframe was believed to be, by the map alone."""
        before, now = self._registered, self._keyframe
        variances = np.diag(covariance)
        if before is not None:
            driven, turned = now.travelled - before.mark.travelled, now.turned - before.mark.turned
            if not worth_learning(driven, turned):
                return
            step = inverse(before.mark.T_odom_body) @ now.T_odom_body
            gap = difference(T_map_body, before.T_map_body @ step)
            noise = _OWN_NOISE * (variances + before.variances)
            self._rates.add(gap, noise, driven, turned)
        self._registered = _Registered(T_map_body, variances, now)

    def unlearn(self) -> None:
        """Compare the next registration with none before it; the rates stay."""
        self._registered = None
