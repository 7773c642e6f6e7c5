"""Loss monitor: the probability while tracking that the robot is elsewhere, and its consequences.

Two hypotheses are compared: the robot is at the tracked place, or it is not (odometry jumped, the robot was carried,
the place was wrong from the start). A registration weighs them by its log-likelihood ratio
(:mod:`coview_stream.localization.tracking.place_evidence`); driving makes the second slightly more probable. Poses are
reported while the second has a probability below the integrity risk; above one half the place is lost, which takes two
views at the default risk, as a single scan may show nothing of the right place. docs/integrity.md has the equations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from coview_stream.config import AcceptanceConfig, TrackingConfig
from coview_stream.geometry.protection import one_in
from coview_stream.localization.evidence.observation import Evidence
from coview_stream.localization.state import Event
from coview_stream.localization.tracking.place_evidence import Observation

# prior probabilities that a place becomes wrong; set by hand
PER_METRE = 1e-5  # once in 100 km odometry jumps, or the robot is displaced
_PER_SECOND = 1e-4  # in doubt, and since the last verified pose once lost: a blind robot may be driving elsewhere
_UNSEEN = 5e-4  # while the robot was out of contact
_NOTHING = 1e-3  # probability that a scan shows nothing of the right place: a lorry hides it, garbage
_NO_SCORE = 1e-6  # least score to divide by; it makes protection levels of kilometres
_OFF_MAP = 0.3  # share of the scan on the map below which the reason mentions it; decides nothing
_NEWEST_SHARE = 0.2  # weight of new shares in the usual ones: averages about five registrations


class RejectionReason(StrEnum):
    """Cause of a verdict on a registration while tracking; docs/reasons.md has the remedies."""

    VERIFIED = "verified"
    """Nothing speaks against the place."""
    BLIND = "blind"
    """Too few points: the sensor is covered, or nothing is within its reach."""
    OFF_MAP = "off-map"
    """The scan lies where the map has no data."""
    TILT = "tilt"
    """The pose leans against gravity."""
    FITNESS = "fitness"
    """Structure above the ground is not where the map has it."""
    GROUND = "ground"
    """The ground is not where the map has it."""
    FREE_SPACE = "free-space"
    """Rays passed through structure of the map."""
    ODOMETRY = "odometry"
    """The place fits, but contradicts the motion by odometry."""
    CONVENTIONS = "conventions"
    """Clouds or odometry come in other units or axes."""
    REPEATED = "repeated"
    """The lidar repeats itself: its clouds show no motion while odometry moves."""
    STOPPED = "stopped"
    """Odometry stands still while the lidar moves."""
    CLOCK = "clock"
    """Clouds are older than their stamps."""
    MOUNT = "mount"
    """The sensor was turned or shifted on its mount, or clouds come in another frame."""
    MIXED = "mixed"
    """Clouds of several places come in turns, or within one cloud."""


FAULTS = (
    RejectionReason.REPEATED, RejectionReason.CLOCK, RejectionReason.MOUNT, RejectionReason.MIXED,
    RejectionReason.STOPPED, RejectionReason.CONVENTIONS,
)  # fmt: skip
"""Causes that are faults of clouds or odometry."""

_AT_ONCE = (
    RejectionReason.BLIND, RejectionReason.ODOMETRY, RejectionReason.TILT, RejectionReason.REPEATED,
    RejectionReason.CLOCK, RejectionReason.MOUNT, RejectionReason.MIXED, RejectionReason.STOPPED,
)  # fmt: skip
"""Causes that stop poses at once, though they are no evidence of a wrong place."""


@dataclass(frozen=True)
class MatchVerdict:
    """Verdict on one registration. If it failed, there is no innovation; if none was tried, also no evidence."""

    cause: RejectionReason  # of the decision
    reason: str  # one clause for people
    evidence: Evidence | None = None  # at the registered pose
    innovation: float | None = None  # squared Mahalanobis distance to the prediction, 6 degrees of freedom
    observation: Observation | None = None  # likelihood of the scan at the pose, against chance and rivals

    @property
    def verified(self) -> bool:
        """Whether the registration by itself is believed."""
        return self.cause is RejectionReason.VERIFIED

    @property
    def score(self) -> float:
        """The evidence's score, 0 without any."""
        return self.evidence.score if self.evidence else 0.0

    @property
    def ratio(self) -> float:
        """Log-likelihood ratio of the place against all others; 0 without an observation."""
        return self.observation.against_elsewhere if self.observation else 0.0


class EvidenceBaseline:
    """Usual evidence of the last metres, for reasons in words and for the width of the protection level."""

    usual: Evidence | None = None  # running average; None before the first registration

    def learn(self, evidence: Evidence) -> None:
        """Add the evidence of a believed registration."""
        if self.usual is None:
            self.usual = evidence
            return
        before, now = vars(self.usual), vars(evidence)
        self.usual = Evidence(**{n: before[n] + _NEWEST_SHARE * (now[n] - before[n]) for n in now})

    def fallen(self, evidence: Evidence) -> float:
        """Return the ratio of the usual score to that of ``evidence``, 1 or more; finite, as messages carry it."""
        return 1.0 if self.usual is None else max(1.0, self.usual.score / max(evidence.score, _NO_SCORE))

    def explain(self, evidence: Evidence) -> tuple[RejectionReason, str]:
        """Return the cause of poor evidence, which is the share furthest below its usual value, and a clause."""
        usual = self.usual or Evidence(0.0, 0.0, 0.0, 0.0, 0.0)
        structure = evidence.near * evidence.covered / (usual.near * usual.covered or 0.25)
        ground = evidence.ground / (usual.ground or 1.0)
        space = evidence.free_space / (usual.free_space or 1.0)
        inside = evidence.inside / (usual.inside or 1.0)
        worst = min(structure, ground, space, inside)
        if worst >= 1.0 and evidence.inside >= _OFF_MAP:
            return RejectionReason.FITNESS, "the scan fits no better here than by chance"
        if worst == inside or evidence.inside < _OFF_MAP:
            return RejectionReason.OFF_MAP, f"only {evidence.inside:.0%} of the scan lies on the map"
        if worst == space:
            return RejectionReason.FREE_SPACE, f"rays pass through {1 - evidence.free_space:.0%} of the map's points"
        if worst == ground:
            return RejectionReason.GROUND, f"only {evidence.ground:.0%} of the ground lies on the map's"
        here = f"{evidence.near:.0%} of the points above the ground are on the map"
        return RejectionReason.FITNESS, f"{here}{f', {usual.near:.0%} usual here' if self.usual else ''}"


class Ruling(NamedTuple):
    """Consequence of a registration for the place, given the earlier ones."""

    event: Event | None  # for the robot's state; None for no change
    reason: str  # one clause
    wrong: float  # probability that the place is wrong
    believed: bool  # whether the registration may correct the pose


class LossMonitor:
    """Odds that the place is wrong, updated by each registration.

    Evidence against the place adds up by views: of registrations within ``TrackingConfig.distance`` the newest counts.
    Evidence for the place does not add up, as a place that fits by chance continues to fit: one view has to outweigh
    all evidence against it.
    """

    def __init__(self, rule: AcceptanceConfig, tracking: TrackingConfig) -> None:
        self._rule = rule
        self._tracking = tracking
        self.begin(0.0)

    def begin(self, error: float) -> None:
        """Start at a place that is wrong with probability ``error``."""
        self._odds = self._before = error / (1.0 - error)  # now, and before the current view
        self._verified: tuple[float, float, float] | None = None  # odds, stamp and metres driven at the last verified
        self._viewed_at = -math.inf  # metres driven at the start of the view
        self._newest: tuple[float, float] | None = None  # stamp and metres driven, of the newest registration
        self._since: float | None = None  # stamp of the first doubted registration
        self._seen_since = 0.0  # stamp of the newest blind registration of the doubt, else of its first
        self._required = False  # whether a registration has to be believed before the next pose

    def odds(self, stamp: float, travelled: float) -> float:
        """Return the odds that the robot is not where odometry leads from the last verified pose.

        Evidence of later scans does not count, as buildings that have moved speak against the right place, too.
        """
        if self._verified is None:
            return self._odds
        odds, then, driven = self._verified
        return max(odds, PER_METRE) + PER_METRE * max(travelled - driven, 0.0) + _PER_SECOND * max(stamp - then, 0.0)

    def require_verification(self) -> None:
        """Start a doubt, as the robot may have been carried unseen."""
        if not self._required:
            self._required = True
            self._before, self._odds = self._before + _UNSEEN, self._odds + _UNSEEN

    def verify(self, verdict: MatchVerdict, stamp: float, travelled: float) -> Ruling:
        """Return the consequence for the place of a registration at ``travelled`` metres."""
        waited, driven = (0.0, 0.0) if self._newest is None else (stamp - self._newest[0], travelled - self._newest[1])
        self._newest = stamp, travelled
        prior = PER_METRE * max(driven, 0.0) + _PER_SECOND * max(waited, 0.0) * (self._since is not None)
        # repeated fits of a standing robot do not make it certain: at any view the place may have become wrong
        self._before = max(self._before + prior, PER_METRE * self._tracking.distance)
        self._odds += prior
        if verdict.observation is not None:
            if travelled - self._viewed_at >= self._tracking.distance:
                self._viewed_at = travelled
                # evidence against the place stays; evidence for it is not counted twice
                self._before = max(self._before, self._odds)
            ratio = float(np.logaddexp(math.log1p(-_NOTHING) + verdict.ratio, math.log(_NOTHING)))
            self._odds = self._before * math.exp(-ratio)
        wrong = self._odds / (1.0 + self._odds)
        if self._odds >= 1.0:
            return Ruling(Event.PLACE_GIVEN_UP, f"more probably elsewhere: {verdict.reason}", wrong, False)
        certain = wrong < self._rule.risk
        if verdict.verified and certain:
            self._before, self._since, self._required = self._odds, None, False
            self._verified = self._odds, stamp, travelled
            return Ruling(Event.MATCH_VERIFIED, verdict.reason, wrong, True)
        in_doubt = self._required or self._since is not None
        if certain and not in_doubt and verdict.cause not in _AT_ONCE and verdict.ratio <= 0.0:
            return Ruling(None, f"odometry alone: {verdict.reason}", wrong, False)
        return self._doubt(verdict, stamp, wrong)

    def _doubt(self, verdict: MatchVerdict, stamp: float, wrong: float) -> Ruling:
        """Stop the poses; after some time give up the place."""
        if self._since is None:
            self._since = self._seen_since = stamp
        blind = verdict.cause is RejectionReason.BLIND
        if blind:
            self._seen_since = stamp
        began, longest = (self._since, self._rule.max_blind_s) if blind else (self._seen_since, self._rule.max_doubt_s)
        if stamp - began >= longest:
            reason = f"in doubt for {stamp - self._since:.0f} s: {verdict.reason}"
            return Ruling(Event.PLACE_GIVEN_UP, reason, wrong, False)
        reason = verdict.reason
        if verdict.verified or verdict.cause not in _AT_ONCE:
            reason = f"{'it fits again' if verdict.verified else verdict.reason}: wrong {one_in(wrong)}"
        return Ruling(Event.MATCH_REJECTED, reason, wrong, False)
