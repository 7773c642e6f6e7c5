"""Circle on the ground, cut off where a map of several ends."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from coview_stream.geometry.arrays import Bools, Reals


@dataclass(frozen=True)
class Circle:
    """Circle in a horizontal plane.

    Attributes:
        x, y: its centre, metres.
        radius: metres.
        begin, end: of x, beyond which it holds nothing.
    """

    x: float
    y: float
    radius: float
    begin: float = -math.inf
    end: float = math.inf

    def holds(self, positions: Reals) -> Bools:
        """Tell which of positions (N, 2 or 3) lie within it, heights left out of account."""
        x = positions[:, 0]
        away = np.asarray(positions[:, :2], dtype=np.float64) - (self.x, self.y)
        return np.asarray(((away * away).sum(axis=1) <= self.radius**2) & (x >= self.begin) & (x < self.end))
