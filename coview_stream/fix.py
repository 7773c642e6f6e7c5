"""What the localizer says after every frame: state, pose, covariance, and the evidence behind them."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.geometry import Pose
from coview_stream.pose.verification import Evidence


class State(str, Enum):
    """What the localizer knows of its place."""

    SEARCHING = "SEARCHING"
    """No place explains what the robot sees well enough (or too little has been seen)."""
    AMBIGUOUS = "AMBIGUOUS"
    """A place does, but another does too, or it has not been confirmed yet."""
    TRACKING = "TRACKING"
    """The pose is known."""
    LOST = "LOST"
    """It was known; the evidence has gone. Searching again."""


@dataclass(frozen=True)
class KeyframeEvidence:
    """Why a keyframe decided what it decided.

    Attributes:
        stamp: seconds.
        state: the state it led to.
        reason: one clause for people.
        score: evidence score of the best hypothesis, 0 if there is none.
        rival: score of the best distinct rival, 0 if there is none.
        evidence: its parts, if a hypothesis could be registered.
        station: winning station, if this keyframe searched.
        shift: winning shift.
    """

    stamp: float
    state: State
    reason: str
    score: float = 0.0
    rival: float = 0.0
    evidence: Evidence | None = None
    station: int | None = None
    shift: int | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain data for ``result.json``."""
        parts = {} if self.evidence is None else {k: round(v, 4) for k, v in vars(self.evidence).items()}
        return {
            "stamp": self.stamp,
            "state": self.state.value,
            "reason": self.reason,
            "score": round(self.score, 4),
            "rival": round(self.rival, 4),
            **parts,
            "station": self.station,
            "shift": self.shift,
        }

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> KeyframeEvidence:
        """Read back what :meth:`to_json` wrote; KeyError or ValueError if it is something else."""
        names = [f.name for f in fields(Evidence)]
        parts = Evidence(**{n: float(data[n]) for n in names}) if names[0] in data else None
        return cls(
            float(data["stamp"]), State(data["state"]), str(data["reason"]), float(data["score"]),
            float(data["rival"]), parts, data["station"], data["shift"],
        )  # fmt: skip


@dataclass(frozen=True)
class Fix:
    """The localizer's answer to one frame.

    Attributes:
        stamp: seconds, of the frame.
        state: see :class:`State`.
        T_map_body: (4, 4) float64 in the frame of the map's sources; None unless TRACKING.
        T_map_odom: (4, 4) float64, the correction behind it; None unless TRACKING.
        covariance: (6, 6) over (x, y, z, roll, pitch, yaw), map frame, m2 and rad2; None unless TRACKING.
        confidence: in [0, 1]: the evidence score, less what the best rival has of it.
        evidence: of the newest keyframe, None before the first.
    """

    stamp: float
    state: State
    T_map_body: Pose | None = None
    T_map_odom: Pose | None = None
    covariance: npt.NDArray[np.float64] | None = None
    confidence: float = 0.0
    evidence: KeyframeEvidence | None = field(default=None)
