"""Verification while tracking: whether a registration is believed, and when too much has spoken against the place.

No single threshold decides. Evidence has to be good by itself (``AcceptanceConfig.tracking_min_score``), but also as
good as it has been on the last metres: right places score 0.3 in one street and 0.7 in the next, and a wrong one 0.25.
And it has to agree with odometry, or odometry with it: a place that fits a metre from where the robot can be is another
one, or the robot is being carried.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from coview_stream.config import AcceptanceConfig, TrackingConfig
from coview_stream.localization.registration.verification import Evidence
from coview_stream.localization.state import Event

_NEWEST_SHARE = 0.2  # of a new score in the baseline: about the last five registrations; set by hand


class RejectionReason(StrEnum):
    """Reason of a verdict on a registration while tracking; docs/tracking.md says what an operator can do about it."""

    VERIFIED = "verified"
    """Nothing speaks against the place."""
    BLIND = "blind"
    """Too few points: the sensor is covered, or nothing is within its reach."""
    OFF_MAP = "off-map"
    """The robot sees what the map does not cover."""
    TILT = "tilt"
    """The pose leans against gravity."""
    FITNESS = "fitness"
    """What stands above the ground is not where the map has it."""
    GROUND = "ground"
    """The ground is not where the map has it."""
    FREE_SPACE = "free-space"
    """Rays passed through what the map shows."""
    ODOMETRY = "odometry"
    """The place fits, but not where odometry says that the robot has moved."""


_NEUTRAL = (RejectionReason.BLIND, RejectionReason.ODOMETRY)
"""Reasons that cost the pose, but do not speak against the place."""


@dataclass(frozen=True)
class MatchVerdict:
    """The verdict on one registration.

    Attributes:
        cause: what decided.
        reason: one clause for people.
        evidence: of the registered pose; None where nothing could be registered.
        innovation: squared Mahalanobis distance to the prediction; None likewise.
    """

    cause: RejectionReason
    reason: str
    evidence: Evidence | None = None
    innovation: float | None = None

    @property
    def verified(self) -> bool:
        """Whether the registration is believed."""
        return self.cause is RejectionReason.VERIFIED

    @property
    def score(self) -> float:
        """The evidence's score, 0 without any."""
        return self.evidence.score if self.evidence else 0.0


class EvidenceBaseline:
    """The usual evidence of the last metres, which new evidence is compared with.

    Attributes:
        usual: running average; None before the first registration.
    """

    def __init__(self) -> None:
        self.usual: Evidence | None = None

    def clear(self) -> None:
        """Forget it: the place is another."""
        self.usual = None

    def learn(self, evidence: Evidence) -> None:
        """Add the evidence of a registration that was believed."""
        if self.usual is None:
            self.usual = evidence
            return
        before, now = vars(self.usual), vars(evidence)
        self.usual = Evidence(**{n: before[n] + _NEWEST_SHARE * (now[n] - before[n]) for n in now})

    def fallen(self, evidence: Evidence) -> float:
        """Return how many times better what is usual is than ``evidence``: 1 at least."""
        return max(1.0, self.usual.score / evidence.score) if self.usual and evidence.score > 0 else 1.0

    def judge(self, evidence: Evidence, rule: AcceptanceConfig) -> tuple[RejectionReason, str]:
        """Return whether evidence is good enough, and as good as usual: the cause and one clause."""
        if evidence.inside < rule.min_overlap:
            return RejectionReason.OFF_MAP, f"only {evidence.inside:.0%} of what is seen lies on the map"
        if evidence.ground < rule.tracking_min_ground:
            return RejectionReason.GROUND, f"only {evidence.ground:.0%} of the ground lies on the map's"
        usual = self.usual
        needed = max(rule.tracking_min_score, rule.tracking_min_share * usual.score if usual else 0.0)
        if evidence.score >= needed:
            return RejectionReason.VERIFIED, "verified"
        return self._fallen_furthest(evidence, f"score {evidence.score:.2f}, {needed:.2f} needed")

    def _fallen_furthest(self, evidence: Evidence, told: str) -> tuple[RejectionReason, str]:
        """Return the part of the evidence that has fallen furthest below what is usual."""
        usual = self.usual
        structure = evidence.near * evidence.covered / ((usual.near * usual.covered if usual else 0.0) or 0.25)
        ground = evidence.ground / ((usual.ground if usual else 0.0) or 1.0)
        space = evidence.free_space / ((usual.free_space if usual else 0.0) or 1.0)
        worst = min(structure, ground, space)
        if worst == space:
            reason = f"rays pass through {1 - evidence.free_space:.0%} of the map's points: {told}"
            return RejectionReason.FREE_SPACE, reason
        if worst == ground:
            return RejectionReason.GROUND, f"{evidence.ground:.0%} of the ground lies on the map's: {told}"
        here = f"{evidence.near:.0%} of what stands above the ground is on the map"
        return RejectionReason.FITNESS, f"{here}{f', {usual.near:.0%} usual here' if usual else ''}: {told}"


class LossMonitor:
    """Count of what has spoken against the place since the newest registration that spoke for it.

    Every verified registration may end the doubt, but only driving on with a place that does not fit adds to it: a
    covered frame loses nothing. While the sensor is blind there is no pose, but nothing speaks against the place where
    odometry goes on to. After a long doubt one registration is not enough, for the robot may stand elsewhere: it takes
    several, a metre or a second apart.
    """

    def __init__(self, rule: AcceptanceConfig, tracking: TrackingConfig) -> None:
        """Decide by ``rule``; ``tracking`` says how far apart registrations tell something new."""
        self._rule = rule
        self._tracking = tracking
        self.clear()

    def clear(self) -> None:
        """Forget what has spoken against the place."""
        self._since: float | None = None  # stamp of the first rejected registration
        self._seen_since = 0.0  # and of the first that was not blind
        self._rejections = self._confirmations = 0
        self._rejected_at = 0.0  # metres driven at the newest rejection that counts
        self._confirmed_at = (0.0, 0.0)  # metres driven and stamp of the newest confirmation that counts
        self._lasted = 0.0  # seconds from the first rejection to the first confirmation

    def verify(self, verdict: MatchVerdict, stamp: float, travelled: float) -> tuple[Event | None, str]:
        """Return what a registration at ``travelled`` metres means for the place (None: nothing), and one clause."""
        if verdict.verified:
            return self._verified(verdict, stamp, travelled)
        self._confirmations = 0
        if self._since is None:
            self._since = self._seen_since = stamp
        blind = verdict.cause is RejectionReason.BLIND
        if blind:
            self._seen_since = stamp
        elif verdict.cause not in _NEUTRAL:
            self._count_rejection(travelled)
        rule = self._rule
        if self._rejections >= rule.max_rejections:
            return Event.PLACE_GIVEN_UP, f"{self._rejections} registrations rejected: {verdict.reason}"
        began = self._since if blind else self._seen_since
        if stamp - began >= (rule.max_blind_s if blind else rule.max_doubt_s):
            return Event.PLACE_GIVEN_UP, f"in doubt for {stamp - self._since:.0f} s: {verdict.reason}"
        return Event.MATCH_REJECTED, verdict.reason

    def _count_rejection(self, travelled: float) -> None:
        """Count a rejection, if it is not the same view again."""
        if not self._rejections or travelled - self._rejected_at >= self._tracking.distance:
            self._rejections += 1
            self._rejected_at = travelled

    def _verified(self, verdict: MatchVerdict, stamp: float, travelled: float) -> tuple[Event | None, str]:
        """Clear the doubt; after a long one, only once several registrations have."""
        if not self._confirmations:
            self._lasted = 0.0 if self._since is None else stamp - self._since
        if self._lasted >= self._rule.max_doubt_s:
            driven, waited = travelled - self._confirmed_at[0], stamp - self._confirmed_at[1]
            apart = driven >= self._tracking.distance or waited >= self._tracking.seconds
            if not self._confirmations or apart:
                self._confirmations += 1
                self._confirmed_at = travelled, stamp
            needed = self._rule.confirmations
            if self._confirmations < needed:
                after = f"after {self._lasted:.0f} s of doubt"
                return None, f"verified {self._confirmations} of {needed} times {after}"
        self.clear()
        return Event.MATCH_VERIFIED, verdict.reason
