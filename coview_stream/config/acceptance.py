"""Thresholds that accept, keep and drop a fix."""

from __future__ import annotations

import math
from dataclasses import dataclass

from coview_stream.config.checks import counts, fraction, positive, require


@dataclass(frozen=True)
class AcceptanceConfig:
    """The evidence that makes a fix, keeps it, and loses it.

    Evidence and its score: :mod:`coview_stream.localization.registration.verification`; how a search decides:
    :mod:`coview_stream.localization.search.acceptance`; how a fix is lost:
    :mod:`coview_stream.localization.tracking.monitor`.

    All are set by hand, and no command prints the figures that they were set by. Those of a search: single scans of
    three real and two simulated sensors, with earlier forms of the score, where 86 right places led by 0.04 to 0.8,
    four wrong ones by 0.07 at most and two that were 1.3 and 2.1 m off by 0.11; and 16 runs outside the map, one of
    which found a place at the map's edge (scores of 0.3 to 0.5, a lead of 0.3, a ground share below 0.65). Right
    places had a ground share of 0.8 or more after two keyframes. Learned features, on a dozen runs of another
    simulator: wrong places led by 1.2 at most, right ones by 1.5 to 3 some keyframes after they came first. What
    ``python -m bench accuracy`` and ``bench tracking`` print with all of them together is in docs/accuracy.md and
    docs/tracking.md.

    Attributes:
        score: minimum score of a hypothesis of a search for a keyframe to count for it.
        lead: minimum by which that score has to exceed every registered rival's.
        ground: minimum share of the robot's ground that has to lie on the map's.
        confirmations: keyframes that have to count for a hypothesis before it is accepted, none between them having
            found another place; and registrations that it takes to be believed again after a doubt of ``max_doubt_s``.
        agree_distance: metres within which keyframes agree.
        agree_angle: radians, likewise.
        evidence_sum: sum to which what their scores exceed ``evidence_floor`` by has to add up: weak evidence needs
            more driving.
        evidence_floor: score that adds nothing to that sum.
        learned_floor: in its place where learned features favour the same place above all others.
        learned_lead: robust standard deviations of the mean keyframe's votes by which learned features have to favour
            a place for ``learned_score`` and ``learned_ground`` to be enough.
        learned_score: in place of ``score`` then: crowns that changed fit badly even where they stand.
        learned_ground: in place of ``ground`` then.
        full_overlap: share of the points that lie where the map has been surveyed; where it is smaller, the sum grows
            by that much less: a few walls at the map's edge fit many a place.
        single_score: in place of ``score`` where one frame alone decides (``LocalizerConfig.stationary``).
        single_lead: in place of ``lead``, likewise.
        min_overlap: minimum share of the points where the map has been surveyed, in a search and while tracking.
        max_tilt: radians by which a pose may lean against gravity, likewise.
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

    score: float = 0.27
    lead: float = 0.1
    ground: float = 0.7
    confirmations: int = 3
    agree_distance: float = 1.5
    agree_angle: float = math.radians(3)
    evidence_sum: float = 1.2
    evidence_floor: float = 0.2
    learned_floor: float = 0.1
    learned_lead: float = 1.5
    learned_score: float = 0.17
    learned_ground: float = 0.6
    full_overlap: float = 0.6
    single_score: float = 0.45
    single_lead: float = 0.2
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
        fraction(self, "score", "lead", "ground", "single_score", "single_lead", "learned_score", "learned_ground")
        fraction(self, "full_overlap", "min_overlap")
        fraction(self, "tracking_min_score", "tracking_min_share", "tracking_min_ground")
        counts(self, "confirmations", "max_rejections")
        positive(self, "agree_distance", "agree_angle", "evidence_sum", "learned_lead", "max_tilt")
        positive(self, "max_innovation", "max_doubt_s", "max_blind_s")
        for name in ("evidence_floor", "learned_floor"):
            require(0 <= getattr(self, name) < 1, self, name, "in [0, 1)")
