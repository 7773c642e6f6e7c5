"""The integrity risk that makes and keeps a fix, and limits beside it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from coview_stream.config.checks import check_types, positive, require

LEAST_RISK = 1e-6
"""Smaller risks are refused: errors below are not told apart, for the model of the evidence is not as good as that."""


@dataclass(frozen=True)
class AcceptanceConfig:
    """The evidence that makes a fix, keeps it, and loses it; docs/integrity.md has the equations.

    A place is given once the probability that it is wrong is below ``risk``, and while it stays there; it is given up
    once it is more probably wrong than right. The limits below it are no evidence, and set by hand.

    Attributes:
        risk: integrity risk: probability of being wrong above which no pose is given.
        max_tilt: radians by which a pose may lean against gravity.
        max_innovation: squared Mahalanobis distance to what odometry predicts, 6 degrees of freedom, above which the
            pose is withheld. 22 is exceeded by one in a thousand if all covariances are right, but their tails are not.
        max_doubt_s: seconds of doubt after which the map is searched again.
        max_blind_s: the same while the sensor is blind: odometry goes on, and nothing speaks against the place.
    """

    risk: float = 1e-4
    max_tilt: float = math.radians(15)
    max_innovation: float = 40.0
    max_doubt_s: float = 5.0
    max_blind_s: float = 60.0

    def __post_init__(self) -> None:
        check_types(self)
        require(LEAST_RISK <= self.risk < 0.5, self, "risk", "in [1e-6, 0.5)")
        positive(self, "max_tilt", "max_innovation", "max_doubt_s", "max_blind_s")
