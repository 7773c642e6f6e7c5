"""What is known of a robot's place between two lidar frames: a verified correction of its odometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from coview_stream.fix import Fix, State
from coview_stream.geometry import Pose
from coview_stream.pose.covariance import angles_first, carried_along
from coview_stream.pose.drift import Drift
from coview_stream.stream.messages import PoseMessage
from coview_stream.stream.odometry import OdometryBuffer

_NS = 1_000_000_000


@dataclass(frozen=True)
class Correction:
    """The newest ``T_map_odom``, and how far odometry had driven when it was right.

    Attributes:
        T_map_odom: (4, 4) map <- odometry, source frame of the map.
        T_map_body: (4, 4) map <- body at the frame that it comes from.
        covariance: (6, 6) over (x, y, z, roll, pitch, yaw), map axes, at that frame.
        confidence: in [0, 1].
        verified_ns: stamp of the newest registration that spoke for it.
        travelled: metres that odometry had driven at the frame.
        turned: radians that it had turned.
        drift: how fast it seems to drift.
    """

    T_map_odom: Pose
    T_map_body: Pose
    covariance: npt.NDArray[np.float64]
    confidence: float
    verified_ns: int
    travelled: float
    turned: float
    drift: Drift

    @classmethod
    def of(cls, fix: Fix, stamp_ns: int, travelled: float, turned: float) -> Correction:
        """Take over a fix that has a pose; ``stamp_ns`` is its frame's."""
        if fix.T_map_odom is None or fix.T_map_body is None or fix.covariance is None or fix.drift is None:
            raise ValueError("a fix without a pose corrects nothing")
        verified = stamp_ns if fix.evidence is None else min(stamp_ns, round(fix.evidence.stamp * _NS))
        return cls(
            fix.T_map_odom, fix.T_map_body, fix.covariance, fix.confidence, verified, travelled, turned, fix.drift
        )  # fmt: skip

    def age(self, stamp_ns: int) -> float:
        """Seconds of sensor time from the newest registration to ``stamp_ns``."""
        return max(0.0, (stamp_ns - self.verified_ns) / _NS)

    def pose(self, odometry: OdometryBuffer, robot: str, map_sha256: str) -> PoseMessage | None:
        """Newest odometry, corrected, with its own stamp and what it may have drifted meanwhile; None before any."""
        newest = odometry.newest
        if newest is None:
            return None
        driven = max(0.0, odometry.travelled - self.travelled)
        turned = max(0.0, odometry.turned - self.turned)
        T_map_body = self.T_map_odom @ newest.T_odom_body
        shift = T_map_body[:3, 3] - self.T_map_body[:3, 3]
        carried = angles_first(carried_along(angles_first(self.covariance), shift))
        return PoseMessage(
            stamp_ns=newest.stamp_ns,
            robot=robot,
            state=State.TRACKING.value,
            T_map_body=T_map_body,
            covariance=carried + self.drift.reported(driven, turned),
            confidence=self.confidence,
            map_sha256=map_sha256,
            age=self.age(newest.stamp_ns),
        )
