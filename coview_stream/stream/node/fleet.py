"""Fleet of nodes: which of them serves a robot, by their names alone.

Every node of a fleet ranks all nodes that are alive for each robot by a hash of both names (rendezvous hashing), and
the first one serves it: no coordinator, no ranges to configure. When a node goes only its robots move, to all others
alike.
"""

from __future__ import annotations

import hashlib
import logging
import socket
import threading
import time
from collections.abc import Callable, Collection, Sequence

from coview_stream.stream.node.election import Claim
from coview_stream.stream.transport.keys import RobotKeys
from coview_stream.stream.transport.transport import Transport

log = logging.getLogger("coview_stream.node")

LEASE_MS = 1000
"""After so long without a sign of life the network takes a node for dead, set by hand: to be replaced within 3 s."""

_MISSED = 2  # looks in a row that do not show a node, before it is gone; set by hand
_MAX_NAME = 64


def owner(robot: str, nodes: Collection[str]) -> str | None:
    """Return the node that serves a robot; None of no nodes."""
    return max(nodes, key=lambda node: (_rank(robot, node), node), default=None)


def _rank(robot: str, node: str) -> bytes:
    return hashlib.blake2b(f"{robot}\n{node}".encode(), digest_size=8).digest()


class FleetMembers:
    """The nodes of a fleet that are alive, as the network's liveliness tokens show them.

    A look that does not show this node itself tells nothing: it is this one that is cut off. Pure.

    Args:
        node: name of this node.
    """

    def __init__(self, node: str) -> None:
        self._node = node
        self._missed: dict[str, int] = {node: 0}

    @property
    def alive(self) -> frozenset[str]:
        """Names, this node's among them."""
        return frozenset(self._missed)

    def look(self, seen: Collection[str]) -> bool:
        """Take in which nodes have a token now; return whether the fleet is another one than before."""
        if self._node not in seen:
            return False
        before = self.alive
        for node in seen:
            self._missed[node] = 0
        for node in before - set(seen):
            self._missed[node] += 1
            if self._missed[node] >= _MISSED:
                del self._missed[node]
        return self.alive != before


class FleetShares:
    """Which robots this node serves, in the place of :class:`~coview_stream.stream.node.election.Elections`.

    Args:
        fleet: name of the fleet.
        keys: of each robot.
        base: first part of the fleet's keys.
        status_rate: of this node's statuses, per second.
        node: name of this node, unlike all others.
        clock: seconds, monotonic.

    Attributes:
        node: as given.
        members: of the fleet.
    """

    def __init__(
        self,
        fleet: str,
        keys: Sequence[RobotKeys],
        base: str,
        status_rate: float,
        node: str,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.node = node
        self.prefix = f"{base}/fleet/{fleet}"
        self.members = FleetMembers(node)
        self._robots = [each.robot for each in keys]
        self._clock = clock
        self._lock = threading.Lock()
        self._owners: dict[str, str | None] = dict.fromkeys(self._robots)  # none before the first look
        self._claim = Claim(0, node, round(1.0 / status_rate, 3), host=socket.gethostname()[:_MAX_NAME])
        self._transport: Transport | None = None

    def declare(self, transport: Transport) -> None:
        """Show this node to the others from now on."""
        self._transport = transport
        transport.announce(f"{self.prefix}/nodes/{self.node}")
        log.info("%s: this node is %s", self.prefix, self.node)

    def look(self) -> bool:
        """Ask who is alive; return whether robots have changed their node."""
        if self._transport is None:
            return False
        begin = f"{self.prefix}/nodes/"
        seen = {token.removeprefix(begin) for token in self._transport.tokens(f"{begin}*")}
        before = self.members.alive
        changed = self.members.look(seen)
        if changed:
            log.info("fleet: %s", _news(before, self.members.alive))
        if not changed and self.node not in seen:
            return False
        with self._lock:
            owners = {robot: owner(robot, self.members.alive) for robot in self._robots}
            moved = owners != self._owners
            self._owners = dict(owners)
        return moved

    def owns(self, robot: str) -> bool:
        """Whether this node serves a robot."""
        return self._owners[robot] == self.node

    # as Elections

    def hear_robot(self, robot: str) -> None:
        """Do nothing: who serves a robot does not depend on its messages."""

    def check_connection(self) -> None:
        """Do nothing: a look that is cut off tells nothing."""

    def claim(self, robot: str) -> Claim | None:
        """Return this node's claim to a robot; None where another one serves it."""
        return self._claim if self.owns(robot) else None

    def told(self, robot: str) -> tuple[bool, int]:
        """Return what others have to be told at once when it is another than before."""
        return self.owns(robot), 0

    def served_by(self, robot: str) -> str | None:
        """Return the name of the node that serves a robot; None before the first look."""
        return self._owners[robot]


def _news(before: frozenset[str], after: frozenset[str]) -> str:
    come, gone = sorted(after - before), sorted(before - after)
    parts = [f"{', '.join(names)} {what}" for names, what in ((come, "came"), (gone, "went")) if names]
    return f"{'; '.join(parts)}: {len(after)} nodes"
