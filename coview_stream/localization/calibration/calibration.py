"""Calibration of sensor and odometry, and raw scans that are levelled by it when they are read."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from coview_stream.config.mount import Mount
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, exp_so3, pose_from, rotation_angle
from coview_stream.odometry.deskew import SweepCorrection

_LEAN, _SCALE, _TURN, _GROUND = math.radians(0.5), 0.01, math.radians(0.05), 0.1
"""Least corrections that are reported: radians, factor, radians per metre, metres."""
_MOVED_TILT, _MOVED_SCALE, _MOVED_TURN = math.radians(1.0), 0.02, math.radians(0.02)
"""Least sigmas of a calibration from before the node started."""


@dataclass(frozen=True)
class Calibration:
    """Corrections of a robot's clouds and odometry, with their standard deviations.

    Attributes:
        roll: radians about the body's x that level clouds in odometry's gravity.
        pitch: radians about the body's y, likewise.
        scale: factor that corrects odometry's distances, less one.
        turn: correction of odometry's heading, radians per metre driven.
        sigma_tilt: one sigma of roll and of pitch, radians.
        sigma_scale: one sigma of the scale.
        sigma_turn: one sigma of the turn, radians per metre.
        ground: height of the site's present ground above the survey's, metres.
    """

    roll: float = 0.0
    pitch: float = 0.0
    scale: float = 0.0
    turn: float = 0.0
    sigma_tilt: float = math.radians(4.0)
    sigma_scale: float = 0.03
    sigma_turn: float = math.radians(0.05)
    ground: float = 0.0

    @cached_property
    def R_body_cloud(self) -> Floats:
        """(3, 3) rotation that levels clouds."""
        return exp_so3(np.array([self.roll, self.pitch, 0.0]))

    @property
    def T_body_cloud(self) -> Pose:
        """(4, 4) the rotation as a transform."""
        return pose_from(self.R_body_cloud, np.zeros(3))

    @property
    def sweep(self) -> SweepCorrection:
        """The corrections that deskewing applies."""
        return SweepCorrection(self.R_body_cloud, self.scale)

    def leans_from(self, other: Calibration) -> float:
        """Return the angle between the levels of two calibrations, radians."""
        return rotation_angle(self.R_body_cloud.T @ other.R_body_cloud)

    def level(self, cloud: Points) -> Points:
        """Return a cloud (N, 3) in the body's axes, from the sensor's."""
        R = self.R_body_cloud
        return cloud if np.array_equal(R, np.eye(3)) else cloud @ R.T.astype(np.float32)

    def motion_covariance(self, step: Floats) -> Floats:
        """Covariance (6, 6) over (rx, ry, rz, x, y, z) of a motion by ``step`` (3,) metres, in the step's axes."""
        along = np.concatenate([np.zeros(3), step])
        spread = np.outer(along, along) * self.sigma_scale**2
        spread[2, 2] += (self.sigma_turn * float(np.linalg.norm(step))) ** 2
        return np.asarray(spread)

    def describe(self, mount: Mount | None = None) -> list[str]:
        """Return one clause of text per noticeable correction.

        Signs are as in ``--mount``; ``mount`` is already applied to the clouds.
        """
        clauses: list[str] = []
        leans = [
            f"{math.degrees(angle):.1f} deg in {name}"
            for name, angle in (("roll", self.roll), ("pitch", self.pitch))
            if abs(angle) >= _LEAN
        ]
        if leans:
            mount = mount or Mount()
            beyond = "" if mount == Mount() else " beyond its mount"
            remedy = f"set --mount={mount.turned(self.R_body_cloud).option} to silence this"
            clauses.append(f"sensor leans {' and '.join(leans)}{beyond}: corrected; {remedy}")
        if abs(self.scale) >= _SCALE:
            size = "short" if self.scale > 0 else "long"
            clauses.append(f"odometry measures {abs(self.scale):.1%} too {size}: corrected")
        if abs(self.turn) >= _TURN:
            side = "left" if self.turn < 0 else "right"
            clauses.append(f"odometry turns {abs(math.degrees(self.turn)):.2f} deg per metre too far {side}: corrected")
        if abs(self.ground) >= _GROUND:
            side = "above" if self.ground > 0 else "below"
            clauses.append(
                f"the ground lies {abs(self.ground):.2f} m {side} the survey's (grass, snow): heights follow the rest"
            )
        return clauses

    def doubted(self) -> Calibration:
        """Return the calibration with wider sigmas: the sensor may have been moved since."""
        return replace(
            self,
            sigma_tilt=max(self.sigma_tilt, _MOVED_TILT),
            sigma_scale=max(self.sigma_scale, _MOVED_SCALE),
            sigma_turn=max(self.sigma_turn, _MOVED_TURN),
        )

    def to_json(self, mount: Mount | None = None) -> dict[str, Any]:
        """Plain data: degrees, metres, factors, and the clauses of :meth:`describe`."""
        deg = math.degrees
        return {
            "roll_deg": round(deg(self.roll), 2),
            "pitch_deg": round(deg(self.pitch), 2),
            "tilt_sigma_deg": round(deg(self.sigma_tilt), 2),
            "odometry_scale": round(1.0 + self.scale, 4),
            "odometry_scale_sigma": round(self.sigma_scale, 4),
            "odometry_turn_deg_per_m": round(deg(self.turn), 3),
            "odometry_turn_sigma_deg_per_m": round(deg(self.sigma_turn), 3),
            "ground_offset_m": round(self.ground, 3),
            "says": self.describe(mount),
        }


class RawScan:
    """Points of a frame in the sensor's axes, with the frame's odometry; levelled when they are read.

    The newest reading is cached.

    Attributes:
        T_odom_body: (4, 4) odometry of the frame.
        calibration: the calibration of the frame's time.
    """

    def __init__(self, points: Points, T_odom_body: Pose, calibration: Calibration | None = None) -> None:
        """Hold points (N, 3) float32, one per voxel, odometry frame, levelled by ``calibration`` (default: none)."""
        self.T_odom_body = T_odom_body
        self.calibration = calibration or Calibration()
        self._newest = self.calibration.R_body_cloud, points
        self._raw: Points | None = None

    def __len__(self) -> int:
        """Return the number of points N."""
        return len(self._newest[1])

    @property
    def position(self) -> Floats:
        """(3,) sensor position in the odometry frame, metres."""
        return np.asarray(self.T_odom_body[:3, 3])

    def levelled(self, calibration: Calibration) -> Points:
        """Return the points (N, 3) in the odometry frame, levelled by a calibration."""
        R, points = self._newest
        level = calibration.R_body_cloud
        if np.array_equal(R, level):
            return points
        position = self.position.astype(np.float32)
        if self._raw is None:
            self._raw = (points - position) @ (self.T_odom_body[:3, :3] @ R).astype(np.float32)
        turn = (self.T_odom_body[:3, :3] @ level).astype(np.float32)
        self._newest = level, self._raw @ turn.T + position
        return self._newest[1]
