"""Fleet of nodes that share robots: each robot is served by one node, and another takes over when that one goes.

Every node ranks all nodes that are alive for each robot by a hash of both names (rendezvous hashing), and the first one
serves it: no coordinator, no ranges to configure. When a node goes only its robots move, to all others alike. Nodes
show that they are alive by liveliness tokens, and tell each other the places of their robots.
"""

from __future__ import annotations

import hashlib
import json
import logging
import threading
import time
from collections.abc import Collection, Mapping
from typing import Any

from coview_stream.errors import TransportError
from coview_stream.messages.types import Encoded, Sample
from coview_stream.stream.node.last_place import LastPlace
from coview_stream.stream.node.robot_endpoints import RobotEndpoints
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.transport import Transport

log = logging.getLogger("coview_stream.node")

LEASE_MS = 1000
"""Milliseconds without a sign of life after which the network takes a node for dead, to be replaced within 3 s."""

_MISSED = 2  # looks in a row that do not show a node, before it counts as gone
_LOOK = 0.1  # seconds between two looks at the tokens
_TELL = 1.0  # seconds between two messages of the robots' places
_MAX_BYTES = 4 << 20  # of such a message that are read


def owner(robot: str, nodes: Collection[str]) -> str | None:
    """Return the node that serves a robot; None of no nodes."""

    def rank(node: str) -> tuple[bytes, str]:
        return hashlib.blake2b(f"{robot}\n{node}".encode(), digest_size=8).digest(), node

    return max(nodes, key=rank, default=None)


class FleetMembers:
    """The nodes of a fleet that are alive, as the network's liveliness tokens show them. Pure.

    A look that does not show ``node`` itself tells nothing: this node is cut off.
    """

    def __init__(self, node: str) -> None:
        self._node = node
        self._missed: dict[str, int] = {node: 0}

    @property
    def alive(self) -> frozenset[str]:
        """Names, this node's among them."""
        return frozenset(self._missed)

    def look(self, tokens: Collection[str]) -> bool:
        """Take in the nodes that have a token now; return True if membership changed."""
        if self._node not in tokens:
            return False
        before = self.alive
        for node in tokens:
            self._missed[node] = 0
        for node in before - set(tokens):
            self._missed[node] += 1
            if self._missed[node] >= _MISSED:
                del self._missed[node]
        return self.alive != before


class Fleet:
    """One node's part in a fleet, on a thread of its own: it takes robots on and gives them up.

    Args:
        prefix: of the fleet's keys.
        node: name of this node, unlike all others.
        endpoints: of all robots of the fleet, by name; none of them is served yet.
        transport: of tokens and places.
    """

    def __init__(self, prefix: str, node: str, endpoints: Mapping[str, RobotEndpoints], transport: Transport) -> None:
        self.prefix, self.node = prefix, node
        self.members = FleetMembers(node)
        self._endpoints = endpoints
        self._transport = transport
        self._errors = RateLimitedErrors(log)
        self._ranked: frozenset[str] = frozenset()  # nodes by which robots have been shared; none before the first look
        self._places: dict[str, LastPlace] = {}  # of robots of other nodes, as these told
        self._arriving: dict[str, LastPlace] = {}  # of robots that were taken on, and whose odometry has not come yet
        self._publisher = transport.publisher(f"{prefix}/places/{node}", "data")
        transport.subscribe(f"{prefix}/places/*", self._on_places, "all")
        transport.announce(f"{prefix}/nodes/{node}")
        log.info("%s: this node is %s", prefix, node)

    def run(self, stopping: threading.Event) -> None:
        """Look, and tell, until ``stopping``."""
        told = float("-inf")
        while not stopping.wait(_LOOK):
            with self._errors.catch("fleet"):
                self.look()
                if time.monotonic() - told >= _TELL:
                    told = time.monotonic()
                    self.tell()
        with self._errors.catch("fleet"):
            self.tell()

    def look(self) -> None:
        """Look who is alive, take robots on and give them up."""
        begin = f"{self.prefix}/nodes/"
        try:
            tokens = {token.removeprefix(begin) for token in self._transport.tokens(f"{begin}*")}
        except TransportError:
            return  # cut off: nothing is known
        before = self.members.alive
        if self.members.look(tokens):
            after = self.members.alive
            changes = ((after - before, "came"), (before - after, "went"))
            news = "; ".join(f"{', '.join(sorted(nodes))} {verb}" for nodes, verb in changes if nodes)
            log.info("fleet: %s: %d nodes", news, len(after))
        if self.node in tokens and self._ranked != self.members.alive:
            self._ranked = self.members.alive
            self._move({robot for robot in self._endpoints if owner(robot, self._ranked) == self.node})
        for robot, place in list(self._arriving.items()):
            if self._endpoints[robot].session.offer(place):
                del self._arriving[robot]

    def _move(self, owned: set[str]) -> None:
        served = {name for name, robot in self._endpoints.items() if robot.serving}
        given_up, taken = served - owned, owned - served
        if given_up:
            self.tell()  # the newest places, before they are forgotten
        for name in given_up:
            self._arriving.pop(name, None)
            self._endpoints[name].end_serving()
            self._endpoints[name].session.reset(forget=False)
        for name in taken:
            place = self._places.pop(name, None)
            if place is not None and place.map_sha256 == self._endpoints[name].session.site_sha256:
                self._arriving[name] = place
            self._endpoints[name].begin_serving()
        if given_up or taken:
            log.info(
                "fleet: %d robots taken on, %d given up; %d are this node's",
                len(taken), len(given_up), len(owned),
            )  # fmt: skip

    def tell(self) -> None:
        """Tell the others the places of this node's robots."""
        places = {}
        for name, robot in self._endpoints.items():
            if robot.serving and (place := robot.session.last_place()) is not None:
                places[name] = place.to_message()
        if places:
            self._publisher.put(Encoded(json.dumps(places, separators=(",", ":")).encode(), "application/json"))

    def _on_places(self, sample: Sample) -> None:
        if sample.key.endswith(f"/{self.node}") or len(sample.payload) > _MAX_BYTES:
            return
        try:
            places: Any = json.loads(bytes(sample.payload))
            for name, plain in places.items():
                if name in self._endpoints and not self._endpoints[name].serving:
                    self._places[name] = LastPlace.from_message(plain)
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError) as error:
            self._errors.report(sample.key, error)
