"""Check of a single frame against the map, that asks for a registration before the next one is due.

A registration is due once a metre. A robot that is lifted and put down elsewhere, or carried with its wheels in the
air, would be at a wrong place until then. So of a few hundred points above the ground of every frame the share that
have a map point near them is compared with what has been usual. Below 0.7 of the usual share were fewer than one frame
in 100 at the right pose, more than half of them half a metre off it, and more than 98 in 100 anywhere else; that was
seen once, on the simulated worlds 5101, 5103, 5106 and 5108, and no command prints it. The check decides nothing else.
"""

from __future__ import annotations

import numpy as np

import coview_kernels as kernels
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, transform
from coview_stream.localization.registration.local_map import LocalMap

# set by hand
_REACH = 0.3  # metres: about the map's point spacing
_MIN_RANGE, _MAX_RANGE = 2.0, 35.0  # metres from the sensor
_HEIGHT = 1.0  # metres above the lowest of the ground nearby
_FLOOR_RADIUS = 10.0  # metres within which that is looked for
_POINTS = 400  # compared
_MIN_POINTS = 60  # fewer say nothing
_NEWEST_SHARE = 0.3  # of a new share in the usual one: about the last three registrations
_DROP = 0.7  # of the usual share: see the module


class DisplacementCheck:
    """The usual share of points on the map, which every frame's is compared with.

    Attributes:
        usual: share in [0, 1]; None before the first registration.
    """

    def __init__(self) -> None:
        self.usual: float | None = None

    def clear(self) -> None:
        """Forget what was usual."""
        self.usual = None

    def learn(self, points: Points, position: Floats, T: Pose, target: LocalMap) -> None:
        """Add a frame whose registration was verified; not others, or a slow error would become usual.

        Args:
            points: (N, 3) float32 of the frame, gravity-aligned frame, metres.
            position: (3,) the sensor's, same frame.
            T: (4, 4) map <- that frame, as registered.
            target: the map around it.
        """
        share = share_on_map(points, position, T, target)
        if share is not None:
            self.usual = share if self.usual is None else self.usual + _NEWEST_SHARE * (share - self.usual)

    def is_displaced(self, points: Points, position: Floats, T: Pose, target: LocalMap) -> bool:
        """Tell whether a frame lies on the map much less than usual; False if there is too little to tell by.

        Arguments are those of :meth:`learn`, ``T`` as predicted.
        """
        if self.usual is None:
            return False
        share = share_on_map(points, position, T, target)
        return share is not None and share < _DROP * self.usual


def share_on_map(points: Points, position: Floats, T: Pose, target: LocalMap) -> float | None:
    """Share of the points above the ground that have a map point near them; None if they are too few to tell.

    Arguments are those of :meth:`DisplacementCheck.learn`.
    """
    x, y = points[:, 0] - np.float32(position[0]), points[:, 1] - np.float32(position[1])
    square = x * x + y * y
    near = points[:, 2][square < _FLOOR_RADIUS**2]
    if len(near) < _MIN_POINTS:
        return None
    floor = np.partition(near, len(near) // 20)[len(near) // 20]
    between = (square > _MIN_RANGE**2) & (square < _MAX_RANGE**2)
    wanted = np.flatnonzero(between & (points[:, 2] > floor + _HEIGHT))
    if len(wanted) < _MIN_POINTS:
        return None
    some = wanted[np.linspace(0, len(wanted) - 1, min(_POINTS, len(wanted))).astype(np.int64)]
    distance, _ = kernels.nearest(target.grid, transform(T, points[some]), _REACH)
    return float((distance < _REACH).mean())
