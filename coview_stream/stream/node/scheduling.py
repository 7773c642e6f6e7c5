"""Scheduling of regular and of shared work. Pure: the time is given, so that a test can play it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

# of searches; set by hand
_PATIENCE = 1.5  # seconds that a keyframe waits before it comes before all that have waited less
_NEW = 8  # searches in which a robot counts as newly lost; most are found within them
_MAX_SUPPORT = 16  # searches in a row that propose a place: with more, the map has another one like it


class RoundRobin:
    """Order in which robots are served by one engine: who has waited longest first.

    Args:
        count: of robots; they are numbered from 0.
    """

    def __init__(self, count: int) -> None:
        self._last_turn = [0] * count
        self._turns = 0

    def order(self) -> list[int]:
        """Return the robots in the order in which they may be served now."""
        return sorted(range(len(self._last_turn)), key=self._last_turn.__getitem__)

    def serve(self, k: int) -> None:
        """Count the turn that robot ``k`` has now."""
        self._turns += 1
        self._last_turn[k] = self._turns


@dataclass(frozen=True)
class SearchDemand:
    """One robot's demand to be searched for: a keyframe of it waits.

    Attributes:
        since: local time in seconds from which a keyframe has been waiting, be it this one or one that it replaced.
        searches: how many there were since the robot was lost.
        support: how many of the newest of them, in a row, proposed a place.
    """

    since: float
    searches: int = 0
    support: int = 0


def search_order(demands: Sequence[SearchDemand | None], now: float) -> list[int]:
    """Return which robots of ``demands`` want a search, in the order in which they are to have it.

    A keyframe that has waited for 1.5 s comes first, the oldest of them before the others: no robot waits much longer,
    unless the engine cannot keep up, and then all wait equally long. Otherwise a robot whose place has been
    proposed comes before those that are newly lost, for it needs the fewest searches until it needs none, and these
    before those that have searched in vain for long.

    Args:
        demands: of each robot; None for one that wants nothing.
        now: local time in seconds.
    """

    def rank(demand: SearchDemand) -> tuple[bool, int, bool, float]:
        overdue = now - demand.since >= _PATIENCE
        support = demand.support if demand.support <= _MAX_SUPPORT and not overdue else 0
        new = overdue or demand.searches < _NEW
        return not overdue, -support, not new, demand.since

    wanted = [(rank(demand), k) for k, demand in enumerate(demands) if demand is not None]
    return [k for _, k in sorted(wanted)]


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
