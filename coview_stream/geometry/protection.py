"""Protection level of a pose: the error in metres and in degrees that is exceeded at most once in a thousand poses.

A covariance gives the usual size of errors. Rare errors are larger than this Gaussian allows, as its scale is itself an
estimate: right on average over many places, too small at some. A Gaussian of unknown scale is a Student-t. So the
squared error over the trace of its covariance is taken as a squared factor times an F(h, n) variable: h is the
effective number of axes of the error (3 for a sphere, 1 for a needle; Satterthwaite's (tr C)^2 / tr C^2), and n, the
degrees of freedom of the tail, tells how well the scale is known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.distributions import f_quantile

RISK = 1e-3
"""Probability that an error exceeds its level: in space, in the plane, in height and in angle each."""

ALERT_METRES, ALERT_DEGREES = 1.0, 3.0
"""Alert limit: largest allowed error of a given pose; set by hand."""

TAILS = {"metres": (1.03, 3.9), "degrees": (0.6, 2.7), "horizontal": (1.03, 3.9), "vertical": (1.03, 3.9)}
"""Factor on the sigma, and degrees of freedom, set by hand, above the values of ``python -m bench protection``.

Split-conformal factors on campuses and sparse forests are 0.27 to 0.29, at a risk of 0.012, for which 82 blocks
suffice; on a town 0.22 to 0.35. On strongly changed maps one of 2,321 blocks had errors of four times the level, and a
risk of 1e-3 takes 999 blocks to calibrate: until then the factors stay this wide.
"""


LEVELS = ("m", "deg", "horizontal_m", "vertical_m")
"""Names of a level's numbers in messages and files."""


class OtherHeights(NamedTuple):
    """Heights of the robot other than the registered one, possible where the ground may have been changed.

    Their probabilities are known, so they need no heavy tail: their ``reach`` is added to the level.
    """

    variance: float = 0.0  # metres^2, part of the covariance
    reach: float = 0.0  # error of the height in metres, exceeded with probability RISK / 2 at most


NO_OTHER = OtherHeights()


@dataclass(frozen=True)
class ProtectionLevel:
    """Error relative to the map that a pose exceeds with probability 1e-3 at most.

    Attributes:
        metres: distance of the position, in space.
        degrees: angle of the rotation.
        horizontal: metres in the map's x, y plane.
        vertical: metres along its z.
        doubt: factor on the levels by the covariance.
        others: other possible heights.
    """

    metres: float
    degrees: float
    horizontal: float
    vertical: float
    doubt: float = 1.0
    others: OtherHeights = NO_OTHER

    def to_json(self) -> dict[str, float]:
        """Plain data for messages and ``result.json``."""
        values = (self.metres, self.degrees, self.horizontal, self.vertical)
        return {name: round(value, 4) for name, value in zip(LEVELS, values, strict=True)}


def protection_level(
    covariance: Floats, doubt: float = 1.0, risk: float = RISK, others: OtherHeights = NO_OTHER
) -> ProtectionLevel:
    """Return the level of a pose with a covariance (6, 6) over (x, y, z, roll, pitch, yaw), m2 and rad2.

    ``doubt``, 1 or more, is the factor by which errors may exceed their usual size, ``risk`` the probability that an
    error exceeds the level. The variance of ``others``, other possible heights, is part of the covariance.
    """
    known = np.array(covariance)
    known[2, 2] = max(known[2, 2] - others.variance, 0.0)
    metres, horizontal, vertical = (
        doubt * _quantile(known[axes, axes], *TAILS[name], risk)
        for name, axes in (("metres", slice(0, 3)), ("horizontal", slice(0, 2)), ("vertical", slice(2, 3)))
    )
    radians = doubt * _quantile(known[3:, 3:], *TAILS["degrees"], risk)
    degrees = min(180.0, float(np.degrees(radians)))
    return ProtectionLevel(metres + others.reach, degrees, horizontal, vertical + others.reach, doubt, others)


def axes_of(covariance: Floats) -> tuple[float, float]:
    """Return the trace of a covariance (K, K), and the effective number of axes of its errors, 1 to K."""
    trace, squares = float(np.trace(covariance)), float(np.sum(covariance * covariance))
    return trace, trace**2 / squares if squares > 0 else float(len(covariance))


def _quantile(covariance: Floats, factor: float, freedom: float, risk: float) -> float:
    """Norm that an error with a covariance (K, K) exceeds with probability ``risk``."""
    trace, axes = axes_of(covariance)
    return factor * float(np.sqrt(trace * f_quantile(axes, freedom, risk)))


LEAST = 1e-9
"""Least reported probability: the model of the evidence is no better."""


def one_in(probability: float) -> str:
    """Return a probability in words, rounded up to two digits: 1 in 60,000."""
    if probability >= 0.5:
        return "more likely than not"
    if probability < LEAST:
        return f"less than 1 in {1.0 / LEAST:,.0f}"
    number = 1.0 / probability * (1.0 + 1e-7)  # the rounding of 1 - confidence must not turn 10,000 into 9,900
    digits = 10 ** max(0, len(str(int(number))) - 2)
    return f"1 in {int(number // digits * digits):,}"
