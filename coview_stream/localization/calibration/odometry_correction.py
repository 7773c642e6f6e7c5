"""Odometry as it is corrected: its scale and its heading, step by step."""

from __future__ import annotations

import numpy as np

from coview_stream.geometry.transforms import Pose, exp_so3, log_so3
from coview_stream.localization.calibration.calibration import Calibration


class OdometryCorrection:
    """Odometry with its scale and its heading corrected, step by step; what has been corrected stays as it is.

    Gravity stays odometry's: turns are about the vertical.
    """

    def __init__(self) -> None:
        self._before: Pose | None = None  # as it came
        self._position = np.zeros(3)
        self._turned = 0.0

    def correct(self, T_odom_body: Pose, calibration: Calibration) -> Pose:
        """Return the next pose (4, 4), odometry <- body, corrected."""
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
        """Go on from another pose (4, 4) than the newest corrected one; its roll and pitch stay odometry's."""
        assert self._before is not None  # there is a newest one
        now = self._corrected(self._before)
        self._turned += float(log_so3(T_odom_body[:3, :3] @ now[:3, :3].T)[2])
        self._position = T_odom_body[:3, 3].copy()
        return self._corrected(self._before)

    def _corrected(self, T_odom_body: Pose) -> Pose:
        T = np.eye(4)
        T[:3, :3] = exp_so3(np.array([0.0, 0.0, self._turned])) @ T_odom_body[:3, :3]
        T[:3, 3] = self._position
        return T
