"""MODULE DOCSTRING."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose

if TYPE_CHECKING:
    pass


MIN_PAIRS = 50


@dataclass(frozen=True)
class Prior:
    """A Gaussian belief about the pose: mean (4, 4) and information (6, 6) over (rx, ry, rz, x, y, z).

    The tangent is a rotation about the body's position, then a shift, both along the map's axes.
    """

    T_map_source: Pose
    information: Floats


@dataclass(frozen=True)
class Registration:
    """What a registration found, with its evidence.

    Attributes:
        T_map_source: (4, 4) float64.
        information: (6, 6) over (rx, ry, rz, x, y, z) about ``centre``, the prior included, before inflation.
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
