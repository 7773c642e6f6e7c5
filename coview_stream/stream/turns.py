"""Whose turn it is: robots take turns at an engine, and none is passed over for long."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

Robot = TypeVar("Robot")
Job = TypeVar("Job")


class Turns:
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
