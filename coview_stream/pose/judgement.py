"""Whether a registration while tracking is believed, and if not, what speaks against it.

No single threshold decides. Evidence has to be good by itself (``AcceptanceConfig.keep_score``), but also as good as it
has been on the last metres: right places score 0.3 in one street and 0.7 in the next, and a wrong one 0.25. And it has
to agree with odometry, or odometry with it: a place that fits a metre from where the robot can be is another one, or
the robot is being carried.
"""

from __future__ import annotations

from dataclasses import dataclass

from coview_stream.config import AcceptanceConfig
from coview_stream.fix import Cause
from coview_stream.pose.verification import Evidence

_HABIT = 0.2  # of a new score in what is usual: the last five registrations


@dataclass(frozen=True)
class Judgement:
    """What became of one registration.

    Attributes:
        cause: what decided.
        reason: one clause for people.
        evidence: of the registered pose; None where nothing could be registered.
        innovation: squared Mahalanobis distance to the prediction; None likewise.
    """

    cause: Cause
    reason: str
    evidence: Evidence | None = None
    innovation: float | None = None

    @property
    def verified(self) -> bool:
        """Whether the registration is believed."""
        return self.cause is Cause.VERIFIED

    @property
    def score(self) -> float:
        """The evidence's score, 0 without any."""
        return self.evidence.score if self.evidence else 0.0


class Habit:
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

    def judge(self, evidence: Evidence, rule: AcceptanceConfig) -> tuple[Cause, str]:
        """Say whether evidence is good enough, and as good as usual; the cause and one clause."""
        if evidence.inside < rule.inside:
            return Cause.OFF_MAP, f"only {evidence.inside:.0%} of what is seen lies on the map"
        if evidence.ground < rule.keep_ground:
            return Cause.GROUND, f"only {evidence.ground:.0%} of the ground lies on the map's"
        usual = self.usual
        least = max(rule.keep_score, rule.keep_share * usual.score if usual else 0.0)
        if evidence.score >= least:
            return Cause.VERIFIED, "verified"
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
                Cause.FREE_SPACE,
                f"rays pass through {1 - evidence.free_space:.0%} of the map's points: {told}",
            )
        if worst == ground:
            return Cause.GROUND, f"{evidence.ground:.0%} of the ground lies on the map's: {told}"
        here = f"{evidence.near:.0%} of what stands above the ground is on the map"
        return Cause.FITNESS, f"{here}{f', {usual.near:.0%} usual here' if usual else ''}: {told}"
