"""Doubt about the place while tracking: what begins it, what clears it, and when it is too much."""

from __future__ import annotations

from coview_stream.config import AcceptanceConfig, TrackingConfig
from coview_stream.fix import Cause
from coview_stream.pose.judgement import Judgement

_NEUTRAL = (Cause.BLIND, Cause.ODOMETRY)  # they begin a doubt, but do not speak against the place


class Doubt:
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

    def note(self, judgement: Judgement, stamp: float, travelled: float) -> str:
        """Take note of a registration, made ``travelled`` metres into the drive; one clause about what it came to."""
        if judgement.verified:
            return self._spoken_for(judgement, stamp, travelled)
        self.active = True
        self._proofs = 0
        if self._since is None:
            self._since = self._seen_since = stamp
        blind = judgement.cause is Cause.BLIND
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

    def _spoken_for(self, judgement: Judgement, stamp: float, travelled: float) -> str:
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
