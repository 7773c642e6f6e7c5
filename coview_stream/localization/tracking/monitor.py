"""Whether a registration while tracking is believed, and if not, what speaks against it.

No single threshold decides. Evidence has to be good by itself (``AcceptanceConfig.keep_score``), but also as good as it
has been on the last metres: right places score 0.3 in one street and 0.7 in the next, and a wrong one 0.25. And it has
to agree with odometry, or odometry with it: a place that fits a metre from where the robot can be is another one, or
the robot is being carried.
"""

# FOLDED coview_stream/localization/tracking/monitor.py: """Doubt about the place while tracking: what begins it, what clears it, and when it is too much."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from coview_stream.config import AcceptanceConfig, TrackingConfig
from coview_stream.localization.registration.verification import Evidence

_HABIT = 0.2  # of a new score in what is usual: the last five registrations


@dataclass(frozen=True)
class MatchVerdict:
    """What became of one registration.

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
    """What evidence has been like on the last metres."""

    def __init__(self) -> None:
        self.usual: Evidence | None = None

    def clear(self) -> None:
        """Forget it: the place is another."""
        self.usual = None

    def learn(self, evidence: Evidence) -> None:
        """Take note of a registration that was believed."""
        if self.usual is None:
            self.usual = evidence
            return
        before, now = vars(self.usual), vars(evidence)
        self.usual = Evidence(**{name: before[name] + _HABIT * (now[name] - before[name]) for name in now})

    def judge(self, evidence: Evidence, rule: AcceptanceConfig) -> tuple[RejectionReason, str]:
        """Say whether evidence is good enough, and as good as usual; the cause and one clause."""
        if evidence.inside < rule.inside:
            return RejectionReason.OFF_MAP, f"only {evidence.inside:.0%} of what is seen lies on the map"
        if evidence.ground < rule.keep_ground:
            return RejectionReason.GROUND, f"only {evidence.ground:.0%} of the ground lies on the map's"
        usual = self.usual
        least = max(rule.keep_score, rule.keep_share * usual.score if usual else 0.0)
        if evidence.score >= least:
            return RejectionReason.VERIFIED, "verified"
        told = f"score {evidence.score:.2f}, {least:.2f} needed"
        # which part has fallen furthest below what it was
        structure = (
            evidence.near * evidence.covered / ((usual.near * usual.covered if usual else 0.0) or 0.25)
        )
        ground = evidence.ground / ((usual.ground if usual else 0.0) or 1.0)
        space = evidence.free_space / ((usual.free_space if usual else 0.0) or 1.0)
        worst = min(structure, ground, space)
        if worst == space:
            return (
                RejectionReason.FREE_SPACE,
                f"rays pass through {1 - evidence.free_space:.0%} of the map's points: {told}",
            )
        if worst == ground:
            return RejectionReason.GROUND, f"{evidence.ground:.0%} of the ground lies on the map's: {told}"
        here = f"{evidence.near:.0%} of what stands above the ground is on the map"
        return RejectionReason.FITNESS, f"{here}{f', {usual.near:.0%} usual here' if usual else ''}: {told}"


class RejectionReason(StrEnum):
    """What decided about a registration while tracking; docs/tracking.md says what an operator can do about each."""

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


_NEUTRAL = (
    RejectionReason.BLIND,
    RejectionReason.ODOMETRY,
)  # they begin a doubt, but do not speak against the place


class LossMonitor:
    """Weighs what speaks against the place since the newest registration that spoke for it.

    Every frame may clear a doubt, but only driving on with a place that does not fit adds to it: a covered frame loses
    nothing. While the sensor is blind there is no pose, but nothing speaks against the place where odometry goes on to.
    After a long doubt one registration is not enough, for the robot may stand elsewhere: it takes several, a metre or
    a second apart.

    Attributes:
        active: whether there is a doubt, and so no pose.
        hopeless: whether the place must be given up.
    """

    def __init__(self, rule: AcceptanceConfig, tracking: TrackingConfig) -> None:
        """Weigh by a rule; ``tracking`` says how far apart registrations tell something new."""
        self._rule = rule
        self._tracking = tracking
        self.clear()

    def clear(self) -> None:
        """Doubt nothing."""
        self.active = self.hopeless = False
        self._since: float | None = None  # stamp of the first doubtful registration
        self._seen_since = 0.0  # and of the first that was not blind
        self._against = self._proofs = 0
        self._against_at = 0.0  # metres driven at the newest that counts
        self._proof_at = (0.0, 0.0)  # metres driven and stamp likewise
        self._lasted = 0.0  # seconds, up to the first proof

    def begin(self) -> None:
        """Doubt from the next registration on, because of something that none of them knows of."""
        self.active = True

    def note(self, judgement: MatchVerdict, stamp: float, travelled: float) -> str:
        """Take note of a registration, made ``travelled`` metres into the drive; one clause about what it came to."""
        if judgement.verified:
            return self._spoken_for(judgement, stamp, travelled)
        self.active = True
        self._proofs = 0
        if self._since is None:
            self._since = self._seen_since = stamp
        blind = judgement.cause is RejectionReason.BLIND
        if blind:
            self._seen_since = stamp
        elif judgement.cause not in _NEUTRAL:
            self._count(travelled)
        rule = self._rule
        if self._against >= rule.patience:
            self.hopeless = True
            return f"{self._against} registrations rejected: {judgement.reason}"
        began = self._since if blind else self._seen_since
        if stamp - began >= (rule.patience_blind if blind else rule.patience_seconds):
            self.hopeless = True
            return f"in doubt for {stamp - self._since:.0f} s: {judgement.reason}"
        return judgement.reason

    def _count(self, travelled: float) -> None:
        """Count what speaks against the place, if it is not the same view again."""
        if not self._against or travelled - self._against_at >= self._tracking.distance:
            self._against += 1
            self._against_at = travelled

    def _spoken_for(self, judgement: MatchVerdict, stamp: float, travelled: float) -> str:
        if not self._proofs:
            self._lasted = 0.0 if self._since is None else stamp - self._since
        if self._lasted >= self._rule.patience_seconds:
            driven, waited = travelled - self._proof_at[0], stamp - self._proof_at[1]
            apart = driven >= self._tracking.distance or waited >= self._tracking.seconds
            if not self._proofs or apart:
                self._proofs += 1
                self._proof_at = travelled, stamp
            needed = self._rule.confirmations
            if self._proofs < needed:
                return f"verified {self._proofs} of {needed} times after {self._lasted:.0f} s of doubt"
        self.clear()
        return judgement.reason
