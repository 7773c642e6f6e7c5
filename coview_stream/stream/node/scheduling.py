"""Whose turn it is: robots take turns at an engine, and none is passed over for long."""

# FOLDED coview_stream/stream/node/scheduling.py: """When something regular is due. Pure: the time is given, so that a test can play it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

Robot = TypeVar("Robot")

Job = TypeVar("Job")


class RoundRobin:
    """Serves who has waited longest; every second time, who is urgent comes first.

    Args:
        count: of robots; they are numbered from 0.
    """

    def __init__(self, count: int) -> None:
        self._served = [0] * count
        self._clock = 0

    def next(
        self,
        robots: Sequence[Robot],
        job_of: Callable[[Robot], Job | None],
        urgent: Callable[[Robot], bool] = lambda robot: False,
    ) -> tuple[Robot, Job] | None:
        """Return the robot to be served now and its job; None if nobody has one."""
        prefer = self._clock % 2 == 0

        def waiting(k: int) -> tuple[bool, int]:
            return not (prefer and urgent(robots[k])), self._served[k]

        for k in sorted(range(len(robots)), key=waiting):
            job = job_of(robots[k])
            if job is not None:
                self._clock += 1
                self._served[k] = self._clock
                return robots[k], job
        return None


class Rate:
    """Absolute deadlines: what takes long delays one beat, not all the later ones.

    Args:
        rate: beats per second.
        now: local time in seconds; the first beat is due at once.
        slack: seconds by which it may be behind and still catch up.
    """

    def __init__(self, rate: float, now: float, slack: float = 0.0) -> None:
        self.period = 1.0 / rate
        self.slack = slack
        self.due = now

    def remaining(self, now: float) -> float:
        """Seconds until the next beat, 0 if it is due."""
        return max(0.0, self.due - now)

    def beat(self, now: float) -> bool:
        """Whether a beat is due; if so, it has been taken. After a pause of the machine go on, do not catch up."""
        if now < self.due:
            return False
        self.due += self.period
        if now > self.due + self.slack:
            self.due = now + self.period
        return True
