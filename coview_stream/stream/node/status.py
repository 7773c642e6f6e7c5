"""Statuses of all robots: their content, size and times, and the connection that they show."""

from __future__ import annotations

import json
import logging
import re
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from coview_stream.localization.result import calibration_json
from coview_stream.localization.state import State
from coview_stream.messages.json_messages import encode_hypotheses
from coview_stream.messages.types import Encoded, HypothesesMessage
from coview_stream.stream.node.counters import PoseRate, Rate
from coview_stream.stream.node.session import Session
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.keys import NodeIdentity
from coview_stream.stream.transport.transport import Connection, Publisher, Transport
from coview_stream.version import __version__

log = logging.getLogger("coview_stream.node")

MAX_STATUS = 3500
"""Largest status, bytes; usual are 2,000. A default zenoh-pico loses one of 5 kB silently."""

_JSON = "application/json"
_MIN_INTERVAL = 0.02  # seconds between rounds: many changes at once give one status each, not a flood
_TEXT, _SHORT_TEXT = 300, 100  # characters
_LOG_INTERVAL = 10.0  # seconds between lines about a robot whose reason changes but not its state


class Reporter:
    """Publishes the statuses of all robots. A robot's error does not silence the others."""

    def __init__(
        self, sessions: Sequence[Session], transport: Transport, errors: RateLimitedErrors, identity: NodeIdentity
    ) -> None:
        self.identity = identity
        self.changed = threading.Event()  # set when a state may have changed
        self.rates = {s.keys.robot: PoseRate() for s in sessions}  # of published poses
        self.served: set[str] = set()  # robots that this node serves: only these are published
        self._sessions = sessions
        self._transport = transport
        self._errors = errors
        self._started = time.monotonic()
        self._connection = ConnectionMonitor()
        self._reported: dict[str, tuple[str, bool]] = {}  # state, and whether it was published
        self._logged: dict[str, tuple[str, float]] = {}  # reason without its numbers, and local time
        self._publishers: dict[str, Publisher] = {}
        self._hypotheses: dict[str, Publisher] = {}

    def declare(self, session: Session) -> None:
        """Declare the publishers of a robot's status and of its search hypotheses."""
        keys = session.keys
        self._publishers[keys.robot] = self._transport.publisher(keys.status, "report")
        self._hypotheses[keys.robot] = self._transport.publisher(keys.hypotheses, "report")

    def report_change(self, session: Session) -> None:
        """Publish the status at once if the robot's state differs from its last status."""
        if self._has_changed(session):
            self.changed.set()

    def _has_changed(self, session: Session) -> bool:
        robot = session.keys.robot
        return (session.state()[0].reported, robot in self.served) != self._reported.get(robot)

    def run(self, rate: float, stopping: threading.Event) -> None:
        """Publish at ``rate``, and changes at once, until ``stopping``; to end it set ``changed`` too."""
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
                self._connection.update(self._transport.connection())
                if not (self._connection.connection.routers or self._connection.connection.peers):
                    for session in self._sessions:
                        session.inputs.disconnected_at = now
        for session in self._sessions:
            robot = session.keys.robot
            with self._errors.catch(f"{robot}: status"):
                if all_robots or self._has_changed(session):
                    self._publish_status(session, now)
                if all_robots and robot in self.served and (message := hypotheses(session)) is not None:
                    self._hypotheses[robot].put(encode_hypotheses(message))

    def publish_last(self, now: float) -> None:
        """Publish that the node ends and tracks no robot."""
        for session in self._sessions:
            with self._errors.catch(f"{session.keys.robot}: status"):
                self._publish_status(session, now, closing=True)

    def _publish_status(self, session: Session, now: float, closing: bool = False) -> None:
        robot = session.keys.robot
        state, reason = session.state()
        before, _ = self._reported.get(robot, ("", False))
        self._reported[robot] = state.reported, robot in self.served  # even on failure: not retried at once
        kind, (logged, at) = re.sub(r"[\d.,]+", "", reason), self._logged.get(robot, ("", now))
        new_reason = kind != logged and now - at >= _LOG_INTERVAL and not state.has_place
        if (state.reported != before or new_reason) and not closing:
            self._logged[robot] = kind, now
            name = map_name(session)
            log.info("%s: %s%s (%s)", robot, state.reported, "" if name is None else f" on {name}", reason)
        if robot not in self.served:
            return
        rate, uptime = self.rates[robot].rate(now), now - self._started
        document = status(session, self._connection.connection, self._connection.reconnects, rate, uptime)
        document["node"] = self.identity.to_json(closing)
        if closing:
            document["reason"] = "the node is shutting down"
            if state is State.TRACKING:
                document["state"] = State.LOST.reported
        self._publishers[robot].put(Encoded(encode_status(document), _JSON))


# ---- the document


def status(session: Session, connection: Connection, reconnects: int, rate: float, uptime: float) -> dict[str, Any]:
    """Return ``out/status`` as plain data; its ``stamp_ns`` is the node's wall clock, all other stamps the robot's."""
    with session.lock:
        state, reason = session.state()
        robot, queue, odometry = session.robot_state, session.queue, session.inputs.odometry
        age, level, correction = robot.age(odometry), robot.protection_level(odometry), robot.correction
    return {
        "robot": session.keys.robot,
        "stamp_ns": time.time_ns(),
        "state": state.reported,
        "reason": reason,
        "version": __version__,
        "map_sha256": session.map_sha256,
        **({} if session.parts is None else {"map": map_name(session)}),
        "odometry": session.inputs.odometry_source,
        "uptime_s": round(uptime, 1),
        "last_frame_ns": robot.last_frame_ns,
        "evidence": None if robot.evidence is None else robot.evidence.to_json(),
        "calibration": calibration_json(robot.calibration, robot.evidence, session.config.mount),
        "transitions": session.history.to_json(),
        "pose": {
            "rate_hz": rate,
            "age_s": None if age is None else round(age, 3),
            "confidence": None if correction is None else correction.fix.confidence,
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


def map_name(session: Session) -> str | None:
    """Return which of several maps the robot is on; None while unknown, and for a single map."""
    correction = session.robot_state.correction
    if session.parts is None or correction is None or correction.fix.T_map_body is None:
        return None
    return session.parts.at(correction.fix.T_map_body[:3, 3]).name


def hypotheses(session: Session) -> HypothesesMessage | None:
    """Return the places that a robot's search considers; None with a place, and before the first search."""
    with session.lock:
        considered = session.queue.considered
        if considered is None or session.robot_state.state.has_place:
            return None
    stamp_ns, robot, places = round(considered.stamp * 1e9), session.keys.robot, considered.places
    names: tuple[str, ...] = ()
    if session.parts is not None:
        parts = [session.parts.at(place[:3]) for place in places]
        places = places.copy()
        places[:, :3] -= np.array([part.shift for part in parts]).reshape(-1, 3)
        names = tuple(part.name for part in parts)
    return HypothesesMessage(stamp_ns, robot, places, considered.none, session.map_sha256, maps=names)


# ---- its size


def encode_status(document: dict[str, Any]) -> bytes:
    """Encode a status as JSON in at most :data:`MAX_STATUS` bytes.

    A longer one loses its least important parts first, and ``shortened`` names them: ids of others on the network,
    evidence of past state changes, old errors, past changes, the ends of long texts.
    """
    text = _encode(document)
    if len(text) <= MAX_STATUS:
        return text
    short: dict[str, Any] = json.loads(text)
    for name in _shorten(short):
        short["shortened"] = list(dict.fromkeys([*short.get("shortened", ()), name]))
        text = _encode(short)
        if len(text) <= MAX_STATUS:
            break
    return text


def _encode(document: dict[str, Any]) -> bytes:
    return json.dumps(document, separators=(",", ":"), ensure_ascii=True).encode()


_ESSENTIAL = (
    "robot", "stamp_ns", "state", "reason", "version", "map_sha256", "last_frame_ns", "pose", "node", "shortened",
)  # fmt: skip


def _shorten(document: dict[str, Any]) -> Iterator[str]:
    """Shorten one part of a status after another in place; yield the name of each."""
    connection, transitions = document["connection"], document["transitions"]
    for name in ("routers", "peers"):
        connection[name] = connection[name][:2]
    yield "connection"
    for transition in transitions:
        transition["evidence"] = None
        transition["reason"] = _cut(transition["reason"], _SHORT_TEXT)
    yield "transitions"
    document["errors"] = [_cut(text, _SHORT_TEXT) for text in document["errors"][-3:]]
    yield "errors"
    document["transitions"] = transitions[-1:]
    yield "transitions"
    document["reason"] = _cut(document["reason"], _TEXT)
    if document["evidence"]:
        document["evidence"]["reason"] = _cut(document["evidence"]["reason"], _SHORT_TEXT)
    if document["calibration"]:
        document["calibration"]["says"] = [_cut(text, _SHORT_TEXT) for text in document["calibration"]["says"][:3]]
    yield "reason"
    for name in document.keys() - set(_ESSENTIAL):  # only names and texts of hundreds of characters lead here
        del document[name]
    document["reason"] = _cut(document["reason"], _SHORT_TEXT)
    yield "all but the state"


def _cut(text: str, length: int) -> str:
    return text if len(text) <= length else f"{text[: length - 4]} ..."


# ---- the connection


class ConnectionMonitor:
    """Routers and peers that the node is connected to, and their changes. Pure logic."""

    def __init__(self) -> None:
        self.connection = Connection()
        self.reconnects = 0  # times a router returned or another replaced it; peers come and go
        self._missing: set[str] = set()  # routers that have gone without a replacement

    def update(self, connection: Connection) -> None:
        """Take the present connection, and log its changes."""
        before, self.connection = self.connection, connection
        for zid in sorted(set(connection.peers) - set(before.peers)):
            log.info("peer %s is connected", zid)
        for zid in sorted(set(before.peers) - set(connection.peers)):
            log.info("peer %s is gone", zid)
        now = set(connection.routers)
        gone, come = set(before.routers) - now, now - set(before.routers)
        self._missing |= gone
        if come and self._missing:
            self.reconnects += 1
            for zid in sorted(come):
                how = "again" if zid in self._missing else f"instead of {', '.join(sorted(self._missing))}"
                log.info("connected to router %s %s", zid, how)
            # a router that returned is no longer missing; after a replacement none is: the replaced one may return too
            self._missing = self._missing - come if come & self._missing else set()
        elif come:
            log.info("connected to router %s", ", ".join(sorted(come)))
        elif gone:
            log.warning("router %s is gone%s", ", ".join(sorted(gone)), "" if now else ": no subscriber can be reached")
