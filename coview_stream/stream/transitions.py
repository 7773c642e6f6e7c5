"""The newest changes of a robot's state, with what led to each: a status a second would not show them all."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

from coview_stream.fix import KeyframeEvidence, State

_KEPT = 5


@dataclass(frozen=True)
class Transition:
    """One change of state, or LOST for another reason than before: the robot is then searched for otherwise.

    Attributes:
        number: counted from 1 since the session began; a gap tells who listens what was missed.
        stamp_ns: of the robot's newest processed frame, nanoseconds; None before the first.
        before: the state that ended.
        state: the state that began.
        reason: one clause for people.
        evidence: of the newest keyframe, if any.
    """

    number: int
    stamp_ns: int | None
    before: State
    state: State
    reason: str
    evidence: KeyframeEvidence | None

    def to_json(self) -> dict[str, Any]:
        """Plain data for the status."""
        return {
            "number": self.number,
            "stamp_ns": self.stamp_ns,
            "from": self.before.value,
            "to": self.state.value,
            "reason": self.reason,
            "evidence": None if self.evidence is None else self.evidence.to_json(),
        }


class Transitions:
    """Takes note of states and keeps the newest changes."""

    def __init__(self) -> None:
        self._state = State.SEARCHING
        self._reason = ""
        self._kept: deque[Transition] = deque(maxlen=_KEPT)
        self._count = 0

    def note(
        self, state: State, reason: str, stamp_ns: int | None, evidence: KeyframeEvidence | None
    ) -> None:
        """Take note of the present state; a transition if it is another than before, or lost for another reason."""
        if state is not self._state or (state is State.LOST and reason != self._reason):
            self._count += 1
            change = Transition(self._count, stamp_ns, self._state, state, reason, evidence)
            self._kept.append(change)
            self._state, self._reason = state, reason

    def to_json(self) -> list[dict[str, Any]]:
        """Return the newest ones, oldest first."""
        return [change.to_json() for change in tuple(self._kept)]
