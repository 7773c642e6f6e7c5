"""Election of the node that serves a robot: the one that does goes on, others stand by and take over from it.

The statuses of a robot are the signs of life of the node that serves it; each says which node it is of, and of which
*term*. A node begins by listening. Where it hears nobody for two and a half statuses it serves, in a term after all
that it has heard of; where it hears somebody it stands by: it computes everything, to take over with a pose, and
publishes nothing. Of two that serve (they started at once, or a network was in two parts) the one of the later term
goes on, and of the same term the one whose name comes first. So a node that was stopped and goes on finds that it has
been replaced.
"""

from __future__ import annotations

import json
import logging
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
_PATIENCE = 2.5  # of the periods of statuses, of a second at least, before a node that is silent is one that is gone
_MAX_PERIOD = 60.0  # seconds between statuses that are believed
_MAX_TERM = 1_000_000_000  # of those that are believed
_MAX_STATUS = 65_536  # bytes: a longer one is none


@dataclass(frozen=True)
class Claim:
    """A node's claim to a robot.

    Attributes:
        term: later ones win.
        node: name of the node; of the same term the one that comes first wins.
        period: seconds between its statuses.
        ending: it serves no longer.
    """

    term: int
    node: str
    period: float = 1.0
    ending: bool = False

    def outranks(self, other: Claim) -> bool:
        """Tell whether this node goes on where both serve."""
        return self.term > other.term or (self.term == other.term and self.node < other.node)

    def to_json(self) -> dict[str, Any]:
        """Return it as it stands in a status."""
        return {"id": self.node, "term": self.term, "period_s": self.period, "ending": self.ending}


def claim_in(payload: bytes) -> Claim | None:
    """Return the claim in a status; None where there is none that can be read."""
    if len(payload) > _MAX_STATUS:
        return None
    try:
        node = json.loads(payload)["node"]
        term, name, period, ending = node["term"], node["id"], node["period_s"], node["ending"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    numbers = type(term) is int and isinstance(period, int | float) and type(period) is not bool
    if not (numbers and isinstance(name, str) and isinstance(ending, bool)):
        return None
    if not (0 <= term <= _MAX_TERM and 0.0 < period <= _MAX_PERIOD and 0 < len(name) <= 64):
        return None
    return Claim(term, name, float(period), ending)


class Election:
    """Whether this node serves one robot. Pure: the caller passes the time, monotonic seconds.

    Args:
        node: name of this node.
        period: seconds between its statuses.
        now: when it began to listen.

    Attributes:
        claim: this node's; None while it stands by.
        other: the newest claim of another node that it stands by for.
    """

    def __init__(self, node: str, period: float, now: float) -> None:
        self._node, self._period = node, period
        self._patient_until = now + _PATIENCE
        self._latest_term = 0
        self.claim: Claim | None = None
        self.other: Claim | None = None

    def hear(self, claim: Claim, now: float) -> None:
        """Take in the claim that a status brought."""
        if claim.node == self._node:
            return
        self._latest_term = max(self._latest_term, claim.term)
        if self.claim is not None and not claim.outranks(self.claim):
            return
        if not claim.ending:
            self.claim = None
        self.other = claim
        self._patient_until = now if claim.ending else now + _PATIENCE * max(1.0, claim.period)

    def tick(self, now: float) -> Claim | None:
        """Let time pass; return the claim if this node serves."""
        if self.claim is None and now >= self._patient_until:
            self.claim = Claim(min(self._latest_term + 1, _MAX_TERM), self._node, self._period)
            self.other = None
        return self.claim


class Elections:
    """The elections of all robots of a node, by what their statuses say.

    Args:
        keys: of each robot.
        status_rate: of this node's statuses, per second.
        clock: seconds, monotonic.
    """

    def __init__(
        self, keys: Sequence[RobotKeys], status_rate: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.node = uuid.uuid4().hex[:12]
        self._clock = clock
        self._keys = {k.robot: k for k in keys}
        self._lock = threading.Lock()
        self._of = {robot: Election(self.node, round(1.0 / status_rate, 3), clock()) for robot in self._keys}
        self._told: dict[str, str | None] = {}  # who serves it, as has been logged

    def declare(self, transport: Transport) -> None:
        """Listen from now on."""
        for robot, keys in self._keys.items():
            transport.subscribe(keys.status, self._listener(robot), "all")

    def _listener(self, robot: str) -> Callable[[Sample], None]:
        def heard(sample: Sample) -> None:
            claim = claim_in(bytes(sample.payload))
            if claim is not None:
                with self._lock:
                    self._of[robot].hear(claim, self._clock())

        return heard

    def claim(self, robot: str) -> Claim | None:
        """Return this node's claim to a robot; None while it stands by."""
        with self._lock:
            election = self._of[robot]
            claim, other = election.tick(self._clock()), election.other
        serving = self.node if claim is not None else None if other is None else other.node
        if serving is not None and self._told.get(robot) != serving:
            before, self._told[robot] = self._told.get(robot), serving
            if claim is None:
                log.warning("%s: node %s serves it: standing by, to take over when that one is gone", robot, serving)
            elif before is not None:
                log.warning("%s: node %s is gone: serving it now", robot, before)
        return claim

    def served_by(self, robot: str) -> str | None:
        """Return the name of the node that serves a robot, as far as this one knows."""
        with self._lock:
            election = self._of[robot]
            claim = election.claim or election.other
        return None if claim is None else claim.node
