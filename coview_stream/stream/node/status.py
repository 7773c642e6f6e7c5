"""Statuses of all robots: the document, when it goes out, and the connection that it tells of."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from coview_stream.localization.state import State
from coview_stream.messages.json_messages import encode_hypotheses
from coview_stream.messages.types import Encoded
from coview_stream.stream.node.counters import PoseRate
from coview_stream.stream.node.election import Elections
from coview_stream.stream.node.fleet import FleetShares
from coview_stream.stream.node.scheduling import Rate
from coview_stream.stream.node.session import Session
from coview_stream.stream.node.status_size import encode_status
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.transport import Connection, Publisher, Transport
from coview_stream.version import __version__

log = logging.getLogger("coview_stream.node")

_JSON = "application/json"

_MIN_INTERVAL = 0.02  # seconds between two rounds: many changes at once are one status each, not a flood; set by hand


class Reporter:
    """Publishes statuses. What goes wrong with one robot's silences no other.

    Args:
        sessions: one per robot.
        transport: where statuses go to.
        errors: logs what goes wrong.
        elections: of robots that another node serves nothing is said; None: this one serves them all.

    Attributes:
        changed: set it when a state may have changed.
        rates: of each robot's poses; add to it when one goes out.
    """

    def __init__(
        self,
        sessions: Sequence[Session],
        transport: Transport,
        errors: RateLimitedErrors,
        elections: Elections | FleetShares | None = None,
    ) -> None:
        self._elections = elections
        self.changed = threading.Event()
        self.rates = {s.keys.robot: PoseRate() for s in sessions}
        self._sessions = sessions
        self._transport = transport
        self._errors = errors
        self._started = time.monotonic()
        self._connection = ConnectionMonitor()
        self._reported: dict[str, tuple[str, object]] = {}  # states, as in the statuses, and what rivals were told
        self._publishers: dict[str, Publisher] = {}
        self._hypotheses: dict[str, Publisher] = {}

    def declare(self, session: Session) -> None:
        """Declare a robot's status, and the places that a search for it considers."""
        keys = session.keys
        self._publishers[keys.robot] = self._transport.publisher(keys.status, "report")
        self._hypotheses[keys.robot] = self._transport.publisher(keys.hypotheses, "report")

    def report_change(self, session: Session) -> None:
        """Have the status published at once if the robot's state is another than its last status says."""
        if self._has_changed(session):
            self.changed.set()

    def _has_changed(self, session: Session) -> bool:
        return self._news(session) != self._reported.get(session.keys.robot)

    def _news(self, session: Session) -> tuple[str, object]:
        told = None if self._elections is None else self._elections.told(session.keys.robot)
        return session.state()[0].reported, told

    def run(self, rate: float, stopping: threading.Event) -> None:
        """Publish at ``rate``, and at once what has changed, until ``stopping``; set ``changed`` as well, to end."""
        clock = Rate(rate, time.monotonic())
        while not stopping.is_set():
            self.changed.wait(timeout=clock.remaining(time.monotonic()))
            self.changed.clear()
            if stopping.is_set():
                return
            now = time.monotonic()
            self.publish(now, all_robots=clock.take_tick(now))
            stopping.wait(_MIN_INTERVAL)

    def publish(self, now: float, all_robots: bool = True) -> None:
        """Publish the status of every robot, or of those whose state has changed."""
        if all_robots:
            with self._errors.catch("connection"):
                self._check_connection(now)
        for session in self._sessions:
            with self._errors.catch(f"{session.keys.robot}: status"):
                if all_robots or self._has_changed(session):
                    self._publish_status(session, now)
                if all_robots:
                    self._publish_hypotheses(session)

    def _publish_hypotheses(self, session: Session) -> None:
        """Publish what a search considers, while there is one."""
        robot = session.keys.robot
        if self._elections is not None and self._elections.claim(robot) is None:
            return
        message = session.hypotheses()
        if message is not None:
            self._hypotheses[robot].put(encode_hypotheses(message))

    def publish_last(self, now: float) -> None:
        """Publish that the node ends, and no robot is tracked any more."""
        for session in self._sessions:
            with self._errors.catch(f"{session.keys.robot}: status"):
                self._publish_status(session, now, closing=True)

    def _check_connection(self, now: float) -> None:
        self._connection.update(self._transport.connection())
        if self._elections is not None:
            self._elections.check_connection()
        if not (self._connection.connection.routers or self._connection.connection.peers):
            for session in self._sessions:
                session.on_disconnected(now)

    def _publish_status(self, session: Session, now: float, closing: bool = False) -> None:
        robot = session.keys.robot
        state, reason = session.state()
        before, now_told = self._reported.get(robot, ("", None)), self._news(session)
        self._reported[robot] = now_told  # published or not: it is not tried again at once
        if state.reported != before[0] and not closing:
            name = session.map_name()
            log.info("%s: %s%s (%s)", robot, state.reported, "" if name is None else f" on {name}", reason)
        claim = None if self._elections is None else self._elections.claim(robot)
        if self._elections is not None and claim is None:
            return
        rate, uptime = self.rates[robot].rate(now), now - self._started
        document = status(session, self._connection.connection, self._connection.reconnects, rate, uptime)
        if claim is not None:
            document["node"] = replace(claim, ending=closing).to_json()
        if closing:
            document["reason"] = "the node is shutting down"
            if state is State.TRACKING:
                document["state"] = State.LOST.reported
        self._publishers[robot].put(Encoded(encode_status(document), _JSON))


def status(session: Session, connection: Connection, reconnects: int, rate: float, uptime: float) -> dict[str, Any]:
    """Return the plain data of ``out/status``; its ``stamp_ns`` is the node's wall clock, all others the robot's."""
    state, reason = session.state()
    age, level = session.age(), session.protection_level()
    known, queue, calibration = session.robot_state, session.queue, session.calibration
    return {
        "robot": session.keys.robot,
        "stamp_ns": time.time_ns(),
        "state": state.reported,
        "reason": reason,
        "version": __version__,
        "map_sha256": session.map_sha256,
        **({} if session.parts is None else {"map": session.map_name()}),
        "odometry": session.odometry_source,
        "uptime_s": round(uptime, 1),
        "last_frame_ns": known.last_frame_ns,
        "evidence": None if known.evidence is None else known.evidence.to_json(),
        "calibration": None if calibration is None else calibration.to_json(session.config.mount),
        "transitions": session.history.to_json(),
        "pose": {
            "rate_hz": rate,
            "age_s": None if age is None else round(age, 3),
            "confidence": session.confidence(),
            "protection_level": None if level is None else level.to_json(),
        },
        "latency_ms": queue.latency.to_json(),
        "engine_ms": queue.engine_latency.to_json(),
        "longest_wait_s": round(queue.longest_wait, 3),
        "longest_search_wait_s": round(queue.longest_search_wait, 3),
        "counters": session.counters.to_json(),
        "connection": {"routers": list(connection.routers), "peers": list(connection.peers), "reconnects": reconnects},
        "errors": list(session.errors.texts),
    }


class ConnectionMonitor:
    """Routers and peers that the node is connected to, and what has changed of them. Pure.

    Attributes:
        connection: at the last update.
        reconnects: how often a router came back, or another took its place. Peers come and go as they like.
    """

    def __init__(self) -> None:
        self.connection = Connection()
        self.reconnects = 0
        self._missing: set[str] = set()  # routers that were there once and have not been replaced

    def update(self, connection: Connection) -> None:
        """Take in the connection as it is now, and log what has changed."""
        before, self.connection = self.connection, connection
        self._update_routers(set(before.routers), set(connection.routers))
        for zid in sorted(set(connection.peers) - set(before.peers)):
            log.info("peer %s is connected", zid)
        for zid in sorted(set(before.peers) - set(connection.peers)):
            log.info("peer %s is gone", zid)

    def _update_routers(self, before: set[str], now: set[str]) -> None:
        gone, come = before - now, now - before
        self._missing |= gone
        if come and self._missing:
            self.reconnects += 1
            for zid in sorted(come):
                how = "again" if zid in self._missing else f"instead of {', '.join(sorted(self._missing))}"
                log.info("connected to router %s %s", zid, how)
            # one that took another's place need not go for the other to be missed no more
            self._missing = self._missing - come if come & self._missing else set()
        elif come:
            log.info("connected to router %s", ", ".join(sorted(come)))
        elif gone:
            log.warning("router %s is gone%s", ", ".join(sorted(gone)), "" if now else ": no subscriber can be reached")
