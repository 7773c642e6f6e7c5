"""Is it true: the evidence that a place is found, kept and lost by."""

from __future__ import annotations

import math
from dataclasses import dataclass

from coview_stream.config.checks import counts, fraction, positive, require


@dataclass(frozen=True)
class AcceptanceConfig:
    """What evidence makes a fix, keeps it, and loses it (see :mod:`coview_stream.pose.verification`).

    A hypothesis counts when its score is at least ``score``, leads every registered rival's by ``lead``, and at least
    ``ground`` of the robot's ground lies on the map's. It is accepted when it has counted for ``confirmations``
    keyframes that agree within ``agree_distance`` and ``agree_angle``, none between them having found another place,
    and what its scores exceed ``proof_floor`` by adds up to ``proof``: weak evidence needs more driving. One frame
    alone (``stationary``) must reach ``single_score`` and ``single_lead``. Where learned features favour the same place
    above all others, what exceeds ``favoured_floor`` counts; where less than ``inside_fully`` of the points lie on the
    map, it counts by that share: a few walls at the map's edge fit many a place. And where they favour it by
    ``favoured_lead`` robust standard deviations of the mean keyframe's votes, ``favoured_score`` and
    ``favoured_ground`` are enough: crowns that changed fit badly even where they stand. Seen by hand on a dozen runs of
    another simulator: wrong places led by 1.2 at most, right ones by 1.5 to 3 some keyframes after they came first.

    Set by hand on few scans, with earlier forms of the score, and no command prints these figures: single scans of
    three real and two simulated sensors, where 86 right places led by 0.04-0.8, four wrong ones by 0.07 at most and
    two that were 1.3-2.1 m off by 0.11; and 16 runs outside the map, one of which found a place at the map's edge
    (scores of 0.3-0.5, a lead of 0.3, a ground share below 0.65). Right places had a ground share of 0.8 or more after
    two keyframes.
    While tracking a registration is rejected if it scores below ``keep_score``, below ``keep_share`` of what was usual
    on the last metres, or below ``keep_ground``; if less than ``inside`` of the points lie where the map has been
    surveyed; or if odometry would have to be off by a squared Mahalanobis distance of ``keep_innovation`` (6 degrees of
    freedom; 22 is exceeded by one in a thousand if all covariances are right, but their tails are not). Meanwhile there
    is no pose. One that is not rejected clears the doubt; ``patience`` that are, ``TrackingConfig.distance`` apart, or
    a doubt that lasts ``patience_seconds``, lose the place (see :mod:`coview_stream.pose.judgement`). While the sensor
    is blind nothing speaks against it: for ``patience_blind`` seconds odometry goes on without a pose given, and after
    more than ``patience_seconds`` it takes ``confirmations`` registrations to be believed again.
    """

    score: float = 0.27
    lead: float = 0.1
    ground: float = 0.7
    confirmations: int = 3
    proof: float = 1.2
    proof_floor: float = 0.2
    favoured_floor: float = 0.1
    favoured_lead: float = 1.5
    favoured_score: float = 0.17
    favoured_ground: float = 0.6
    inside_fully: float = 0.6
    single_score: float = 0.45
    single_lead: float = 0.2
    agree_distance: float = 1.5
    agree_angle: float = math.radians(3)
    keep_score: float = 0.17
    keep_share: float = 0.65
    keep_innovation: float = 40.0
    keep_ground: float = 0.5
    inside: float = 0.3
    patience: int = 2
    patience_seconds: float = 10.0
    patience_blind: float = 60.0
    most_tilt: float = math.radians(8)

    def __post_init__(self) -> None:
        fraction(
            self,
            "score",
            "lead",
            "single_score",
            "single_lead",
            "keep_score",
            "keep_share",
            "inside",
            "ground",
            "keep_ground",
        )
        counts(self, "confirmations", "patience")
        positive(self, "agree_distance", "agree_angle", "most_tilt", "proof", "keep_innovation")
        positive(self, "patience_seconds", "patience_blind")
        fraction(self, "inside_fully", "favoured_score", "favoured_ground")
        positive(self, "favoured_lead")
        require(0 <= self.favoured_floor < 1, self, "favoured_floor", "in [0, 1)")
        require(0 <= self.proof_floor < 1, self, "proof_floor", "in [0, 1)")
