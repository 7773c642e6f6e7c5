"""Mounting error: the sensor leans, and sits beside where the robot takes it to be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.geometry.transforms import Pose, exp_so3, pose_from, rot_z
from coview_stream.sim.dirt.ranges import within


@dataclass(frozen=True)
class Mounting:
    """Mounting error that nobody calibrated: points are taken for the body's while they are the sensor's.

    Attributes:
        lean: angle between the vertical axes of sensor and body, degrees; the side it leans to is drawn.
        yaw: turn about the vertical, degrees, one sigma; no map shows it on a straight road.
        lever: distance between sensor and body, metres; its direction is drawn.

    Raises:
        ConfigError: a value out of its range.
    """

    lean: float = 2.0
    yaw: float = 0.0
    lever: float = 0.05

    def __post_init__(self) -> None:
        within(self, lean=(0.0, 30.0), yaw=(0.0, 180.0), lever=(0.0, 5.0))

    def draw(self, rng: np.random.Generator) -> Pose:
        """Draw the pose ``T_body_sensor`` (4, 4)."""
        towards, turn, offset = rng.uniform(0, 2 * np.pi), rng.normal(), rng.normal(size=3)
        axis = np.array([np.cos(towards), np.sin(towards), 0.0])
        R = exp_so3(np.radians(self.lean) * axis) @ rot_z(float(np.radians(self.yaw) * turn))
        return pose_from(R, self.lever * offset / np.linalg.norm(offset))
