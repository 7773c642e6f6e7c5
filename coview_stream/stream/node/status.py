"""The statuses of all robots: when they go out, and what of a state has been told already."""

# FOLDED coview_stream/stream/node/status.py: """Who is connected, and what of a change concerns people. Pure: fed with what the transport says."""
# FOLDED coview_stream/stream/node/status.py: """The status document: what an operator, or a program, wants to know of one robot."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections import deque
from collections.abc import Sequence
from functools import partial
from typing import Any

from coview_stream.localization.result import State
from coview_stream.messages.types import Encoded
from coview_stream.stream.node import status as statuses
from coview_stream.stream.node.scheduling import Rate
from coview_stream.stream.node.session import Session
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.transport import Connection, Publisher, Transport
from coview_stream.version import __version__

log = logging.getLogger("coview_stream.node")

_JSON = "application/json"

_BREATH = 0.02  # seconds between two rounds: many changes at once are one status each, not a flood


class Reporter:
    """Publishes statuses. What goes wrong with one robot's silences no other.

    Args:
        sessions: one per robot.
        transport: where statuses go to.
        guard: logs what goes wrong.

    Attributes:
        changed: set it when a state may have changed.
        rates: of each robot's poses; whoever publishes them adds to it.
    """

    def __init__(self, sessions: Sequence[Session], transport: Transport, guard: RateLimitedErrors) -> None:
        self.changed = threading.Event()
        self.rates = {s.keys.robot: statuses.PoseRate() for s in sessions}
        self._sessions = sessions
        self._transport = transport
        self._guard = guard
        self._started = time.monotonic()
        self._link = ConnectionMonitor()
        self._told: dict[str, State] = {}
        self._publishers: dict[str, Publisher] = {}

    def declare(self, session: Session) -> None:
        """Declare a robot's status."""
        self._publishers[session.keys.robot] = self._transport.publisher(session.keys.status, "report")

    def has_news(self, session: Session) -> bool:
        """Whether a robot's state is another than was told last."""
        return session.state()[0] is not self._told.get(session.keys.robot)

    def run(self, rate: float, stopping: threading.Event) -> None:
        """Publish at ``rate``, and at once what has changed, until ``stopping``; set ``changed`` as well, to end."""
        clock = Rate(rate, time.monotonic())
        while not stopping.is_set():
            self.changed.wait(timeout=clock.remaining(time.monotonic()))
            self.changed.clear()
            if stopping.is_set():
                return
            now = time.monotonic()
            self.publish(now, everyone=clock.beat(now))
            stopping.wait(_BREATH)

    def publish(self, now: float, everyone: bool = True) -> None:
        """Publish the status of every robot, or of those whose state has changed."""
        if everyone:
            self._guard.run("connection", partial(self._look, now))
        for session in self._sessions:
            self._guard.run(f"{session.keys.robot}: status", partial(self._report, session, now, everyone))

    def _look(self, now: float) -> None:
        self._link.look(self._transport.connection())
        if not (self._link.connection.routers or self._link.connection.peers):
            for session in self._sessions:
                session.unreachable(now)

    def say_goodbye(self, now: float) -> None:
        """Publish that nobody tracks the robots any more."""
        for session in self._sessions:
            self._guard.run(f"{session.keys.robot}: status", partial(self._tell, session, now, closing=True))

    def _report(self, session: Session, now: float, anyway: bool) -> None:
        if anyway or self.has_news(session):
            self._tell(session, now)

    def _tell(self, session: Session, now: float, closing: bool = False) -> None:
        robot = session.keys.robot
        state, reason = session.state()
        known, self._told[robot] = self._told.get(robot), state  # told or not: it is not tried again at once
        if state is not known and not closing:
            log.info("%s: %s (%s)", robot, state.value, reason)
        link, rate = self._link, self.rates[robot].rate(now)
        document = statuses.status(session, link.connection, link.reconnects, rate, now - self._started)
        if closing:
            document["reason"] = "the node is shutting down"
            if state is State.TRACKING:
                document["state"] = State.LOST.value
        self._publishers[robot].put(Encoded(json.dumps(document).encode(), _JSON))


class ConnectionMonitor:
    """Compares whom we are connected to with whom we were.

    Attributes:
        connection: at the last look.
        reconnects: how often a router came back, or another took its place. Peers come and go as they like.
    """

    def __init__(self) -> None:
        self.connection = Connection()
        self.reconnects = 0
        self._missed: set[str] = set()  # routers that were there once and have not been replaced

    def look(self, connection: Connection) -> None:
        """Take in whom we are connected to now, and log what has changed."""
        before, self.connection = self.connection, connection
        self._look_at_routers(set(before.routers), set(connection.routers))
        for zid in sorted(set(connection.peers) - set(before.peers)):
            log.info("peer %s is connected", zid)
        for zid in sorted(set(before.peers) - set(connection.peers)):
            log.info("peer %s is gone", zid)

    def _look_at_routers(self, before: set[str], now: set[str]) -> None:
        gone, come = before - now, now - before
        self._missed |= gone
        if come and self._missed:
            self.reconnects += 1
            for zid in sorted(come):
                how = "again" if zid in self._missed else f"instead of {', '.join(sorted(self._missed))}"
                log.info("connected to router %s %s", zid, how)
            # one that took another's place need not go for the other to be missed no more
            self._missed = self._missed - come if come & self._missed else set()
        elif come:
            log.info("connected to router %s", ", ".join(sorted(come)))
        elif gone:
            log.warning("router %s is gone%s", ", ".join(sorted(gone)), "" if now else ": nobody can hear us")


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
