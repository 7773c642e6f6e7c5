"""Doubt about the place while tracking: what begins it, what clears it, and when it is too much."""

from __future__ import annotations

from coview_stream.config import AcceptanceConfig
from coview_stream.fix import Cause
from coview_stream.pose.judgement import Judgement


class Doubt:
    """Counts what speaks against the place since the newest registration that spoke for it.

    Every frame may clear a doubt, but only driving on with a place that does not fit adds to it: a covered frame loses
    nothing. Sight alone adds nothing either: while the sensor is blind there is no pose, but nothing speaks against the
    place where odometry goes on to. After a long doubt one registration is not enough: the robot may stand elsewhere.

    Attributes:
        active: whether there is a doubt, and so no pose.
        hopeless: whether the place must be given up.
    """

    def __init__(self, rule: AcceptanceConfig, distance: float) -> None:
        """Count by a rule what is at least ``distance`` metres apart."""
        self._rule = rule
        self._distance = distance
        self.clear()

    def clear(self) -> None:
        """Doubt nothing."""
        self._count = self._confirmed = 0
        self._since = self._seen_since = 0.0  # stamps of the first, and of the first that was not blind
        self._at = self._confirmed_at = 0.0  # metres driven at the newest of either kind
        self.hopeless = False

    @property
    def active(self) -> bool:
        """See the class."""
        return self._count > 0

    def begin(self, stamp: float, travelled: float) -> None:
        """Doubt, because of something that no registration knows of; nothing new if there is a doubt already."""
        if not self._count:
            self._count, self._at, self._confirmed = 1, travelled, 0
            self._since = self._seen_since = stamp

    def note(self, judgement: Judgement, stamp: float, travelled: float) -> str:
        """Take note of a registration, made ``travelled`` metres into the drive; one clause about what it came to."""
        if judgement.verified:
            return self._spoken_for(judgement, stamp, travelled)
        self._confirmed = 0
        if not self._count:
            self.begin(stamp, travelled)
        elif travelled - self._at >= self._distance and judgement.cause not in (Cause.BLIND, Cause.ODOMETRY):
            self._count += 1
            self._at = travelled
        blind = judgement.cause is Cause.BLIND
        if blind:
            self._seen_since = stamp
        rule = self._rule
        if self._count >= rule.patience:
            self.hopeless = True
            return f"{self._count} registrations rejected: {judgement.reason}"
        if stamp - (self._since if blind else self._seen_since) >= (
            rule.patience_blind if blind else rule.patience_seconds
        ):
            self.hopeless = True
            return f"in doubt for {stamp - self._since:.0f} s: {judgement.reason}"
        return judgement.reason

    def _spoken_for(self, judgement: Judgement, stamp: float, travelled: float) -> str:
        rule, lasted = self._rule, stamp - self._since
        if self._count and lasted >= rule.patience_seconds:
            if not self._confirmed or travelled - self._confirmed_at >= self._distance:
                self._confirmed, self._confirmed_at = self._confirmed + 1, travelled
            if self._confirmed < rule.confirmations:
                return (
                    f"verified {self._confirmed} of {rule.confirmations} times after {lasted:.0f} s of doubt"
                )
        self.clear()
        return judgement.reason
