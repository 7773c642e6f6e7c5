"""Scheduling of regular and of shared work. Pure: the time is given, so that a test can play it."""

from __future__ import annotations

from collections.abc import Sequence


class RoundRobin:
    """Order in which robots are served by one engine: who has waited longest first.

    Every second time the urgent ones come first; no robot is passed over for long.

    Args:
        count: of robots; they are numbered from 0.
    """

    def __init__(self, count: int) -> None:
        self._last_turn = [0] * count
        self._turns = 0

    def order(self, urgent: Sequence[bool] | None = None) -> list[int]:
        """Return the robots in the order in which they may be served now."""
        preferred = urgent if self._turns % 2 == 0 else None

        def rank(k: int) -> tuple[bool, int]:
            return preferred is not None and not preferred[k], self._last_turn[k]

        return sorted(range(len(self._last_turn)), key=rank)

    def serve(self, k: int) -> None:
        """Count the turn that robot ``k`` has now."""
        self._turns += 1
        self._last_turn[k] = self._turns


class Rate:
    """Absolute deadlines of something regular: one late tick does not delay the later ones.

    Args:
        rate: ticks per second.
        now: local time in seconds; the first tick is due at once.
        slack: seconds by which it may be behind and still catch up.
    """

    def __init__(self, rate: float, now: float, slack: float = 0.0) -> None:
        self.period = 1.0 / rate
        self.slack = slack
        self.due = now

    def remaining(self, now: float) -> float:
        """Seconds until the next tick, 0 if it is due."""
        return max(0.0, self.due - now)

    def take_tick(self, now: float) -> bool:
        """Take the tick that is due, and return whether one was; after a pause of the machine none is caught up."""
        if now < self.due:
            return False
        self.due += self.period
        if now > self.due + self.slack:
            self.due = now + self.period
        return True
