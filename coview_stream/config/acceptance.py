"""The integrity risk that makes a fix, and thresholds that keep and drop it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from coview_stream.config.checks import counts, fraction, positive, require

LEAST_RISK = 1e-9
"""Smaller risks are refused: errors below are not told apart, for the model of the evidence is not as good as that."""


@dataclass(frozen=True)
class AcceptanceConfig:
    """The evidence that makes a fix, keeps it, and loses it.

    Evidence and its score: :mod:`coview_stream.localization.registration.verification`; how a search decides:
    :mod:`coview_stream.localization.search.acceptance`; how a fix is lost:
    :mod:`coview_stream.localization.tracking.monitor`.

    ``risk`` and ``max_tilt`` are what a search is decided by. The others are set by hand, and no command prints the
    figures that they were set by; what ``python -m bench tracking`` prints with all of them together is in
    docs/tracking.md.

    Attributes:
        risk: integrity risk: a search gives a place once the probability that it is wrong is smaller.
        confirmations: registrations that it takes to be believed again after a doubt of ``max_doubt_s``.
        min_overlap: minimum share of the points where the map has been surveyed, while tracking.
        max_tilt: radians by which a pose may lean against gravity, in a search and while tracking.
        tracking_min_score: while tracking, a registration with a lower score is rejected.
        tracking_min_share: so is one whose score is below this share of what has been usual on the last metres.
        tracking_min_ground: so is one with less of the robot's ground on the map's.
        max_innovation: squared Mahalanobis distance to what odometry predicts, 6 degrees of freedom, above which the
            pose is withheld. 22 is exceeded by one in a thousand if all covariances are right, but their tails are not.
        max_rejections: rejected registrations, ``TrackingConfig.distance`` apart, that lose the place.
        max_doubt_s: seconds of doubt that lose it.
        max_blind_s: seconds for which odometry goes on, without a pose given, while the sensor is blind: nothing speaks
            against the place then.
    """

    risk: float = 1e-4
    confirmations: int = 3
    min_overlap: float = 0.3
    max_tilt: float = math.radians(8)
    tracking_min_score: float = 0.17
    tracking_min_share: float = 0.65
    tracking_min_ground: float = 0.5
    max_innovation: float = 40.0
    max_rejections: int = 2
    max_doubt_s: float = 10.0
    max_blind_s: float = 60.0

    def __post_init__(self) -> None:
        require(LEAST_RISK <= self.risk < 0.5, self, "risk", "in [1e-9, 0.5)")
        fraction(self, "min_overlap")
        fraction(self, "tracking_min_score", "tracking_min_share", "tracking_min_ground")
        counts(self, "confirmations", "max_rejections")
        positive(self, "max_tilt", "max_innovation", "max_doubt_s", "max_blind_s")
