"""Election of the node that serves a robot: the one that does goes on, others stand by and take over from it.

The statuses of a robot show that the node that serves it is running; each says which node it is of, and of which
*term*. A node begins by listening. If no status arrives for four periods it serves, in a term later than all that
it has heard of; otherwise it stands by: it computes everything, to take over with a pose, and publishes nothing. Of
two that serve (they started at once, or a network was in two parts) the one of the later term goes on, and of the
same term the one whose name comes first; it says so at once to the one that does not. A node that has itself been
stopped for longer than others wait for it listens again before it says anything. Nobody takes over by what is not
heard while the network is away, nor from a node that falls silent together with the robot.
"""

from __future__ import annotations

import json
import logging
import socket
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from coview_stream.messages.types import Sample
from coview_stream.stream.transport.keys import RobotKeys
from coview_stream.stream.transport.transport import Transport

log = logging.getLogger("coview_stream.node")

# set by hand
_PATIENCE = 4.0  # of the periods of statuses, of a second at least, before a node that is silent is one that is gone
_ROBOT_SILENT = 2.0  # seconds without a message of a robot, after which it is not heard
_MAX_PERIOD = 60.0  # seconds between statuses that are believed
_MAX_TERM = 1_000_000_000  # of those that are believed
_MAX_STATUS = 65_536  # bytes: a longer one is none
_MAX_NAME = 64  # characters of a node's name or host


@dataclass(frozen=True)
class Claim:
    """A node's claim to a robot.

    Attributes:
        term: later ones win.
        node: name of the node; of the same term the one that comes first wins.
        period: seconds between its statuses.
        ending: it serves no longer.
        host: name of the machine that it runs on, for people.
    """

    term: int
    node: str
    period: float = 1.0
    ending: bool = False
    host: str = ""

    def __str__(self) -> str:
        return f"{self.node} on {self.host}" if self.host else self.node

    def outranks(self, other: Claim) -> bool:
        """Tell whether this node goes on where both serve."""
        return self.term > other.term or (self.term == other.term and self.node < other.node)

    def to_json(self) -> dict[str, Any]:
        """Return it as it stands in a status."""
        return {"id": self.node, "term": self.term, "period_s": self.period, "ending": self.ending, "host": self.host}


def claim_in(payload: bytes) -> Claim | None:
    """Return the claim in a status; None where there is none that can be read."""
    if len(payload) > _MAX_STATUS:
        return None
    try:
        node = json.loads(payload)["node"]
        term, name, period, ending = node["term"], node["id"], node["period_s"], node["ending"]
        host = node.get("host", "")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    numbers = type(term) is int and isinstance(period, int | float) and type(period) is not bool
    if not (numbers and isinstance(ending, bool) and _is_name(name) and name and _is_name(host)):
        return None
    if not (0 <= term <= _MAX_TERM and 0.0 < period <= _MAX_PERIOD):
        return None
    return Claim(term, name, float(period), ending, host)


def _is_name(text: object) -> bool:
    """Whether it can be logged."""
    return isinstance(text, str) and len(text) <= _MAX_NAME and text.isprintable()


class Election:
    """Whether this node serves one robot. Pure: the caller passes the time, monotonic seconds.

    Args:
        node: name of this node.
        period: seconds between its statuses.
        now: when it began to listen.
        host: name of this machine.

    Attributes:
        claim: this node's; None while it stands by.
        other: the newest claim of another node that it stands by for.
        challenges: how often a node has been heard that serves as well, and has to be told not to.
    """

    def __init__(self, node: str, period: float, now: float, host: str = "") -> None:
        self._node, self._period, self._host = node, period, host
        self._patient_until = now + _PATIENCE * max(1.0, period)
        self._ticked: float | None = None
        self._robot_heard = now
        self._latest_term = 0
        self.challenges = 0
        self.claim: Claim | None = None
        self.other: Claim | None = None

    def hear(self, claim: Claim, now: float) -> None:
        """Take in the claim that a status brought."""
        if claim.node == self._node:
            return
        self._latest_term = max(self._latest_term, claim.term)
        if self.claim is not None and not claim.outranks(self.claim):
            self.challenges += not claim.ending
            return
        leader = self.other
        awaited = leader is not None and not leader.ending and now < self._patient_until
        if awaited and leader is not None and leader.node != claim.node and leader.outranks(claim):
            return  # of two others the one that goes on is waited for
        if not claim.ending:
            self.claim = None
        self.other = claim
        self._patient_until = now if claim.ending else now + _PATIENCE * max(1.0, claim.period)

    def hear_robot(self, now: float) -> None:
        """Note that a message of the robot came."""
        self._robot_heard = now

    def tick(self, now: float) -> Claim | None:
        """Let time pass; return the claim if this node serves."""
        before, self._ticked = self._ticked, now
        if before is not None and now - before >= _PATIENCE * max(1.0, self._period):
            self.claim = None  # it was stopped, and another one may have taken over
            self.wait(now)
        replaces = self.other is not None and not self.other.ending
        if replaces and now - self._robot_heard > _ROBOT_SILENT:
            self.wait(now)  # it is this node that is cut off, or there is nothing to take over
        if self.is_due(now):
            self._latest_term = min(self._latest_term + 1, _MAX_TERM)
            self.claim = Claim(self._latest_term, self._node, self._period, host=self._host)
            self.other = None
        return self.claim

    def is_due(self, now: float) -> bool:
        """Whether it takes over at the next tick."""
        return self.claim is None and now >= self._patient_until

    def wait(self, now: float) -> None:
        """Begin to listen again, for example after a stop of this process. No effect while this node serves."""
        known = self._period if self.other is None else max(self._period, self.other.period)
        self._patient_until = max(self._patient_until, now + _PATIENCE * max(1.0, known))


class Elections:
    """The elections of all robots of a node, by what their statuses say.

    Args:
        keys: of each robot.
        status_rate: of this node's statuses, per second.
        clock: seconds, monotonic.
        needs_connection: nobody is heard, and nobody listens, as long as the network is away.
    """

    def __init__(
        self,
        keys: Sequence[RobotKeys],
        status_rate: float,
        clock: Callable[[], float] = time.monotonic,
        needs_connection: bool = False,
    ) -> None:
        self.node = uuid.uuid4().hex[:12]
        self._clock, self._needs_connection = clock, needs_connection
        self._keys = {k.robot: k for k in keys}
        self._lock = threading.Lock()
        host, period = socket.gethostname()[:_MAX_NAME], round(1.0 / status_rate, 3)
        self._of = {robot: Election(self.node, period, clock(), host) for robot in self._keys}
        self._told: dict[str, Claim | None] = {}  # who serves it, as has been logged
        self._transport: Transport | None = None

    def declare(self, transport: Transport) -> None:
        """Listen from now on."""
        self._transport = transport
        for robot, keys in self._keys.items():
            transport.subscribe(keys.status, self._listener(robot), "all")

    def _listener(self, robot: str) -> Callable[[Sample], None]:
        def heard(sample: Sample) -> None:
            claim = claim_in(bytes(sample.payload))
            if claim is not None:
                with self._lock:
                    self._of[robot].hear(claim, self._clock())

        return heard

    def hear_robot(self, robot: str) -> None:
        """Note that a message of a robot came."""
        self._of[robot].hear_robot(self._clock())

    def check_connection(self) -> None:
        """Do not take over by what is not heard while nothing is connected; call it at least once in a second."""
        if not self._needs_connection or self._transport is None:
            return
        connection = self._transport.connection()
        if not (connection.routers or connection.peers):
            with self._lock:
                for election in self._of.values():
                    election.wait(self._clock())

    def claim(self, robot: str) -> Claim | None:
        """Return this node's claim to a robot; None while it stands by."""
        election = self._of[robot]
        if election.is_due(self._clock()):  # without the lock: as good as a moment ago
            self.check_connection()
        with self._lock:
            claim, other = election.tick(self._clock()), election.other
            serving, before = claim or other, self._told.get(robot)
            news = serving is not None and (before is None or before.node != serving.node)
            if news:
                self._told[robot] = serving
        if news and claim is None:
            log.warning("%s: node %s serves it: standing by, to take over when that one is gone", robot, serving)
        elif news and before is not None:
            log.warning("%s: node %s is gone: serving it now", robot, before)
        return claim

    def told(self, robot: str) -> tuple[bool, int]:
        """Return what others have to be told at once when it is another than before."""
        claim = self.claim(robot)
        with self._lock:
            return claim is not None, self._of[robot].challenges

    def served_by(self, robot: str) -> str | None:
        """Return the name of the node that serves a robot, as far as this one knows."""
        with self._lock:
            election = self._of[robot]
            claim = election.claim or election.other
        return None if claim is None else claim.node
