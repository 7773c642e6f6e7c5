"""Staying localized: when to register, how far odometry is believed, and how poses are smoothed."""

# FOLDED coview_stream/config/tracking.py: """Is it true: the evidence that a place is found, kept and lost by."""

from __future__ import annotations

import math
from dataclasses import dataclass

from coview_stream.config.checks import counts, fraction, positive, require


@dataclass(frozen=True)
class TrackingConfig:
    """How a fix is kept: how often to register, with what, and how fast odometry is believed to drift.

    Register after ``distance`` metres of driving or ``turn`` radians of turning, or ``seconds`` (sensor time) whatever
    odometry says, for wheels slip, drivers hang and robots are carried; and, where odometry is bad, as soon as the pose
    has become uncertain by ``unsure_position`` metres or ``unsure_yaw`` radians, but not before ``least_distance``
    metres. Registered is the newest frame, and as many before it as it takes to ``min_points``, but none from before
    the last ``window`` metres once there are that many, and none once there are ``max_points``: older ones are smeared
    by the drift. (With odometry that drifts by 3 % the heading came out nearly ten times as well from one frame as from
    the last two metres'; seen once on worlds 5103 and 5106, no command prints it.)

    Drifts are random-walk sigmas per square root of a metre driven; ``turn_drift`` is yaw error per radian turned.
    They are where :class:`coview_stream.localization.tracking.odometry_noise.DriftEstimator` begins: it believes them like ``drift_trust`` metres
    of driving, and forgets what it has measured over ``drift_memory`` metres.
    """

    distance: float = 1.0
    seconds: float = 1.0
    least_distance: float = 0.3
    unsure_position: float = 0.03
    unsure_yaw: float = math.radians(0.2)
    window: float = 0.01
    min_points: int = 2500
    max_points: int = 50_000
    turn: float = math.radians(10)
    position_drift: float = 0.015
    height_drift: float = 0.004
    tilt_drift: float = math.radians(0.05)
    yaw_drift: float = math.radians(0.15)
    turn_drift: float = 0.02
    drift_trust: float = 6.0
    drift_memory: float = 40.0

    def __post_init__(self) -> None:
        positive(
            self,
            "distance",
            "seconds",
            "least_distance",
            "unsure_position",
            "unsure_yaw",
            "window",
            "turn",
            "position_drift",
            "height_drift",
            "tilt_drift",
            "yaw_drift",
            "turn_drift",
            "drift_trust",
            "drift_memory",
        )
        counts(self, "min_points", "max_points")


@dataclass(frozen=True)
class GraphConfig:
    """How poses are smoothed (see :mod:`coview_stream.localization.tracking.pose_graph`).

    The graph grows to ``restart`` keyframes and begins anew with the newest ``window`` of them. What it drops lives on
    in the belief that it left behind, so a longer window only lets old registrations be weighed again, and linearised
    again, in the light of later ones.
    ``huber`` is where, in standard deviations, a registration's pull stops growing. It is the norm of six residuals at
    once, which is 2.4 on average and exceeds 3.5 in one case of twenty; the usual 1.345 is meant for a single one. It
    must not be a kernel that lets go altogether: with an optimistic covariance that locks the map out for good.
    """

    window: int = 40
    restart: int = 120
    huber: float = 3.5

    def __post_init__(self) -> None:
        counts(self, "window", "restart", least=2)
        require(self.restart > self.window, self, "restart", f"greater than window ({self.window})")
        positive(self, "huber")


@dataclass(frozen=True)
class AcceptanceConfig:
    """What evidence makes a fix, keeps it, and loses it (see :mod:`coview_stream.localization.registration.verification`).

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
    a doubt that lasts ``patience_seconds``, lose the place (see :mod:`coview_stream.localization.tracking.monitor`). While the sensor
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
