"""The status document: what an operator, or a program, wants to know of one robot."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

from coview_stream import __version__
from coview_stream.stream.session import Session
from coview_stream.stream.transport import Connection

_RATE_WINDOW = 30  # poses over which the rate is taken


class PoseRate:
    """How often poses go out."""

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=_RATE_WINDOW)

    def add(self, now: float) -> None:
        """Take note of a pose at local time ``now``."""
        self._times.append(now)

    def rate(self, now: float) -> float:
        """Return poses per second; 0 if the newest is older than two seconds."""
        span = self._times[-1] - self._times[0] if self._times else 0.0
        if span <= 0.0 or now - self._times[-1] > 2.0:
            return 0.0
        return round((len(self._times) - 1) / span, 2)


def status(
    session: Session,
    connection: Connection,
    reconnects: int,
    rate: float,
    uptime: float,
) -> dict[str, Any]:
    """Plain data for ``out/status``. ``stamp_ns`` is the wall clock of the node; all other stamps are the robot's."""
    state, reason = session.state()
    age = session.age()
    evidence = session.whereabouts.evidence
    return {
        "robot": session.keys.robot,
        "stamp_ns": time.time_ns(),
        "state": state.value,
        "reason": reason,
        "version": __version__,
        "map_sha256": session.map_sha256,
        "odometry": session.odometry_source,
        "uptime_s": round(uptime, 1),
        "last_frame_ns": session.whereabouts.last_frame_ns,
        "evidence": None if evidence is None else evidence.to_json(),
        "transitions": session.transitions.to_json(),
        "pose": {"rate_hz": rate, "age_s": None if age is None else round(age, 3)},
        "latency_ms": session.work.latency.to_json(),
        "engine_ms": session.work.engine_latency.to_json(),
        "longest_wait_s": round(session.work.longest_wait, 3),
        "counters": session.counters.to_json(),
        "connection": {
            "routers": list(connection.routers),
            "peers": list(connection.peers),
            "reconnects": reconnects,
        },
        "errors": list(session.complaints.texts),
    }
