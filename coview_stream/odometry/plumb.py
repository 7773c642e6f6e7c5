"""Up as the surfaces around a lidar have it: walls are vertical, and the ground has a normal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.geometry.arrays import Floats, Indices, Reals
from coview_stream.odometry.gravity import Ground, ground_plane, wall_evidence

# set by hand
_WIDE = float(np.radians(10.0))  # sigma of the up direction that walls are looked for about
_UNSEEN = float(np.radians(30.0))  # sigma of what walls say along the way that they all face


@dataclass(frozen=True)
class Plumb:
    """What the surfaces around say in level axes, for a filter.

    Attributes:
        walls: (2,) x and y of the unit vector that walls are parallel to; None without walls.
        covariance: (2, 2) of it, radians squared, but for a factor.
        ground: (2,) x and y of the ground's unit normal; None without ground.
    """

    walls: Floats | None
    covariance: Floats
    ground: Floats | None

    def rows(self) -> tuple[Floats, Indices]:
        """Return the measurement (4,), zeros where there is none, and the indices of those that there are (K,)."""
        y = np.concatenate([np.zeros(2) if part is None else part for part in (self.walls, self.ground)])
        return y, np.flatnonzero(np.repeat([self.walls is not None, self.ground is not None], 2))


@dataclass(frozen=True)
class Surfaces:
    """Walls and ground around one frame, in its body frame.

    Attributes:
        walls: (3,) unit vector that the walls are parallel to; None without walls.
        information: (3, 3) of it, 1 / radians squared.
        ground: None without ground.
    """

    walls: Floats | None
    information: Floats
    ground: Ground | None

    @classmethod
    def around(cls, points: Reals, up: Floats, near: Ground | None) -> Surfaces:
        """Look at a frame (N, 3), metres, whose up (3,) is good to some degrees; ``near``: the last ground seen."""
        walls, information, count = wall_evidence(points, up, _WIDE)
        found = ground_plane(points, near)
        return cls(walls if count else None, information, None if isinstance(found, str) else found)

    def seen(self, R: Floats) -> Plumb:
        """Return the same in axes that are level but for a small tilt; ``R`` (3, 3), those axes <- body."""
        information = (R @ self.information @ R.T)[:2, :2] + np.eye(2) / _UNSEEN**2
        return Plumb(
            None if self.walls is None else (R @ self.walls)[:2],
            np.asarray(np.linalg.inv(information), dtype=np.float64),
            None if self.ground is None else (R @ self.ground.up)[:2],
        )
