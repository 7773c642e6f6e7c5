"""The statuses of all robots: when they go out, and what of a state has been told already."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Sequence
from functools import partial

from coview_stream.fix import State
from coview_stream.stream import status as statuses
from coview_stream.stream.guard import Guard
from coview_stream.stream.link import Link
from coview_stream.stream.messages import Encoded
from coview_stream.stream.metronome import Metronome
from coview_stream.stream.session import Session
from coview_stream.stream.transport import Publisher, Transport

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

    def __init__(self, sessions: Sequence[Session], transport: Transport, guard: Guard) -> None:
        self.changed = threading.Event()
        self.rates = {s.keys.robot: statuses.PoseRate() for s in sessions}
        self._sessions = sessions
        self._transport = transport
        self._guard = guard
        self._started = time.monotonic()
        self._link = Link()
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
        clock = Metronome(rate, time.monotonic())
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
