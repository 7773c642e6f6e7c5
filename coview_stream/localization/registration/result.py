"""Result of a registration, and the prior that it may take in."""

from __future__ import annotations

from dataclasses import dataclass

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose

MIN_PAIRS = 50
"""Pairs of a scan's and a map's points that a registration needs, and points that a crop of the map needs. By hand."""


@dataclass(frozen=True)
class Prior:
    """A Gaussian belief about a pose.

    Attributes:
        T_map_source: (4, 4) mean.
        information: (6, 6) over (rx, ry, rz, x, y, z): a turn about the body's position, then a shift, both along the
            map's axes; radians and metres.
    """

    T_map_source: Pose
    information: Floats


@dataclass(frozen=True)
class Registration:
    """Pose that a registration found, and how it fits.

    Attributes:
        T_map_source: (4, 4) float64.
        information: (6, 6) as of a :class:`Prior`, that prior included, before inflation.
        rmse: root mean square of the kept point-to-plane residuals, metres.
        pairs: how many pairs were kept at the last iteration.
        iterations: over all scales.
        converged: the last step was below 2 mm and 0.006 degrees.
    """

    T_map_source: Pose
    information: Floats
    rmse: float
    pairs: int
    iterations: int
    converged: bool
