"""Fleet of nodes that share robots: one node serves each robot, and another takes over when that node goes.

For each robot every node ranks all live nodes by a hash of both names (rendezvous hashing), and the first one serves
it: no coordinator, no ranges to configure. When a node goes only its robots move, spread evenly over the others. A
node is alive if it holds a liveliness token, which vanishes with its process, and sends its robots' places to the
others once a second, as any session may hold a token. Only a robot's statuses prove that a node serves it: a node
gives a robot up once a higher-ranked node has sent one, and another node takes it when none has come for 3 s. A node
whose engines have not been ready for 7 s is silent, ranks last, and takes no robots on while there are other nodes.
"""

from __future__ import annotations

import hashlib
import json
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from typing import Any

from coview_stream.errors import TransportError, printable
from coview_stream.messages.types import Encoded, Sample
from coview_stream.stream.node.last_place import LastPlace
from coview_stream.stream.node.robot_endpoints import RobotEndpoints
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.keys import NodeIdentity
from coview_stream.stream.transport.transport import Transport

log = logging.getLogger("coview_stream.node")

LEASE_MS = 1000
"""Milliseconds without a sign of life after which the network drops a node, to be replaced within 3 s."""

_MISSED = 2  # looks in a row that miss a node, before it counts as gone
_LOOK = 0.1  # seconds between looks at the tokens
_TELL = 1.0  # seconds between messages with the robots' places
_SILENT = 30  # looks without such a message, 3 s, after which a token alone does not count; the same for statuses
_UNREADY = 70  # looks in a row, 7 s, that find engines not ready: a dead engine restarts sooner
_MAX_HEARD = 1024  # messages between two looks
_MAX_BYTES = 4 << 20  # of such a message that are read


def owner(robot: str, nodes: Collection[str]) -> str | None:
    """Return the node that serves a robot; None if there are no nodes."""

    def rank(node: str) -> tuple[bytes, str]:
        return hashlib.blake2b(f"{robot}\n{node}".encode(), digest_size=8).digest(), node

    return max(nodes, key=rank, default=None)


def _names(nodes: Collection[str]) -> str:
    return ", ".join(printable(node)[:64] for node in sorted(nodes)[:5]) + ", ..." * (len(nodes) > 5)


class FleetMembers:
    """The live nodes of a fleet: they hold a liveliness token and were heard in the last 30 looks. Pure logic.

    A look without the token of ``node`` itself is ignored: this node is cut off from the network.
    """

    def __init__(self, node: str) -> None:
        self._node = node
        self._missed: dict[str, int] = {node: 0}
        self.looks = 0  # looks that showed this node: a clock that stops when it is cut off
        self._heard: dict[str, int] = {}  # look of the newest message, for each node with a token
        self._tokens: frozenset[str] = frozenset()

    @property
    def alive(self) -> frozenset[str]:
        """Names of the live nodes, this node's among them."""
        return frozenset(self._missed)

    @property
    def settled(self) -> bool:
        """Whether every token holder was heard, or had time to send: until then another node may serve any robot."""
        return self.looks > _SILENT or self._tokens <= self.alive

    def look(self, tokens: Collection[str], heard: Collection[str] = ()) -> bool:
        """Take the token holders and the nodes heard since the last look; return whether membership changed."""
        if self._node not in tokens:
            return False
        before = self.alive
        self.looks += 1
        self._tokens = frozenset(tokens)
        self._heard |= dict.fromkeys(heard, self.looks)
        self._heard = {node: look for node, look in self._heard.items() if node in tokens}
        here = {node for node, look in self._heard.items() if self.looks - look < _SILENT} | {self._node}
        for node in here:
            self._missed[node] = 0
        for node in before - here:
            self._missed[node] += 1
            if self._missed[node] >= _MISSED:
                del self._missed[node]
        return self.alive != before


class Fleet:
    """One node's part in a fleet, on its own thread: it takes robots on and gives them up.

    Args:
        prefix: first part of the fleet's keys.
        node: name of this node, unique in the fleet.
        endpoints: endpoints of all robots of the fleet, by name; none is served yet.
        ready: whether this node's engines are ready.
        period: seconds between statuses of a robot, the same in all nodes.
    """

    def __init__(
        self,
        prefix: str,
        node: str,
        endpoints: Mapping[str, RobotEndpoints],
        transport: Transport,
        ready: Callable[[], bool] = lambda: True,
        period: float = 1.0,
    ) -> None:
        self.prefix, self.node = prefix, node
        self.members = FleetMembers(node)
        self._endpoints = endpoints
        self._transport = transport
        self._ready, self._unready = ready, 0  # looks in a row that found engines not ready
        self._errors = RateLimitedErrors(log)
        self._heard: deque[str] = deque(maxlen=_MAX_HEARD)  # nodes that have sent something since the last look
        self._told = self._logged_at = float("-inf")  # local time
        self._logged = frozenset({node})  # live nodes in the newest log line about them
        self._ranked: frozenset[str] = frozenset()  # nodes that last shared the robots; empty before the first look
        self._owners: dict[str, str | None] = {}  # of the robots, among these nodes
        self._patience = max(_SILENT, round(3.0 * period / _LOOK))  # looks without a status of a robot
        self._statuses: dict[tuple[str, str], bool] = {}  # since the last look, by robot and node: whether it ends
        self._lock = threading.Lock()  # guards the statuses
        self._servers: dict[str, dict[str, int]] = {robot: {} for robot in endpoints}  # look of a node's newest status
        self._served: dict[str, int] = {}  # newest look at which each robot was known to be served
        self.unserved: tuple[str, ...] = ()  # robots that no node is known to serve
        self._places: dict[str, LastPlace] = {}  # of other nodes' robots, as sent by these
        self._arriving: dict[str, LastPlace] = {}  # of robots taken on whose odometry has not come yet
        self._publisher = transport.publisher(f"{prefix}/places/{node}", "data")
        transport.subscribe(f"{prefix}/places/*", self._on_places, "all")
        transport.subscribe(f"{prefix.rsplit('/', 2)[0]}/*/out/status", self._on_status, "all")
        transport.announce(f"{prefix}/nodes/{node}")
        log.info("%s: this node is %s", prefix, node)

    def run(self, stopping: threading.Event) -> None:
        """Look at the fleet and send places until ``stopping``."""
        while not stopping.wait(_LOOK):
            with self._errors.catch("fleet"):
                self.look()
                if time.monotonic() - self._told >= _TELL:
                    self._told = time.monotonic()
                    self.tell()
        with self._errors.catch("fleet"):
            self.tell()

    def look(self) -> None:
        """Check which nodes are alive, take robots on and give them up."""
        begin = f"{self.prefix}/nodes/"
        try:
            tokens = {token.removeprefix(begin) for token in self._transport.tokens(f"{begin}*")}
        except TransportError:
            return  # cut off: nothing is known
        before = self.members.alive
        self.members.look(tokens, [self._heard.popleft() for _ in range(len(self._heard))])
        after = self.members.alive
        if after - before:
            self._told = float("-inf")  # a new node does not know this one yet
        if after != self._logged and time.monotonic() - self._logged_at > _TELL:
            changes = ((after - self._logged, "came"), (self._logged - after, "went"))
            log.info(
                "fleet: %s: %d nodes", "; ".join(f"{_names(new)} {verb}" for new, verb in changes if new), len(after)
            )
            self._logged, self._logged_at = after, time.monotonic()
        self._unready = 0 if self._ready() else self._unready + 1
        with self._lock:
            statuses, self._statuses = self._statuses, {}
        for (robot, node), ends in statuses.items():
            self._servers[robot].pop(node, None)
            if not ends:
                self._servers[robot][node] = self._served[robot] = self.members.looks
        if self.node in tokens and self.members.settled:
            self._share()
        for robot, place in list(self._arriving.items()):
            if self._endpoints[robot].session.offer(place):
                del self._arriving[robot]

    def _share(self) -> None:
        """Give up robots that a higher-ranked node serves; take on this node's robots and those without a node."""
        alive, look = self.members.alive, self.members.looks
        if alive != self._ranked:
            self._ranked, self._owners = alive, {robot: owner(robot, alive) for robot in self._endpoints}
            for robot, nodes in self._servers.items():
                self._servers[robot] = {node: at for node, at in nodes.items() if node in alive}
        servers = {
            robot: {node for node, at in nodes.items() if look - at < self._patience}
            for robot, nodes in self._servers.items()
        }
        at_work = {self.node}.union(*servers.values())
        last, others = self._unready >= _UNREADY, alive - {self.node}
        given_up, taken, orphans, unserved = list[str](), list[str](), list[str](), list[str]()
        for robot, endpoints in self._endpoints.items():
            self._served[robot] = look if endpoints.serving else self._served.get(robot, look)
            if endpoints.serving:
                if any(last or owner(robot, (self.node, node)) == node for node in servers[robot]):
                    given_up.append(robot)
            elif self._owners[robot] == self.node and not (last and others):
                taken.append(robot)
            elif not servers[robot]:
                unserved.append(robot)
                if look - self._served[robot] >= self._patience and not last and owner(robot, at_work) == self.node:
                    orphans.append(robot)
        if orphans:
            names = _names({str(self._owners[robot]) for robot in orphans})
            log.warning("fleet: no node serves %d of the robots; %s should", len(orphans), names)
        self.unserved = tuple(unserved)
        if given_up or taken or orphans:
            self._move(given_up, taken + orphans)

    def _move(self, given_up: Collection[str], taken: Collection[str]) -> None:
        if given_up:
            self.tell()  # sends the newest places before they are forgotten
        for name in given_up:
            self._arriving.pop(name, None)
            self._endpoints[name].end_serving()
            self._endpoints[name].session.reset(forget=False)
        for name in taken:
            place = self._places.pop(name, None)
            if place is not None and place.map_sha256 == self._endpoints[name].session.site_sha256:
                self._arriving[name] = place
            self._endpoints[name].begin_serving()
        own = sum(robot.serving for robot in self._endpoints.values())
        log.info("fleet: %d robots taken on, %d given up; %d are this node's", len(taken), len(given_up), own)

    def tell(self) -> None:
        """Send the places of this node's robots, which shows that it is alive; silent without engines."""
        if self._unready >= _UNREADY:
            return
        places = {}
        for name, robot in self._endpoints.items():
            if robot.serving and (place := robot.session.last_place()) is not None:
                places[name] = place.to_message()
        self._publisher.put(Encoded(json.dumps(places, separators=(",", ":")).encode(), "application/json"))

    def _on_places(self, sample: Sample) -> None:
        if sample.key.endswith(f"/{self.node}") or len(sample.payload) > _MAX_BYTES:
            return
        try:
            places: Any = json.loads(bytes(sample.payload))
            self._heard.append(sample.key.rpartition("/")[2])
            for name, plain in places.items():
                if name in self._endpoints and not self._endpoints[name].serving:
                    self._places[name] = LastPlace.from_message(plain)
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError) as error:
            self._errors.report(f"{self.prefix}/places", error)  # one name for all: strangers choose theirs

    def _on_status(self, sample: Sample) -> None:
        robot = sample.key.split("/")[-3]
        node = NodeIdentity.read(bytes(sample.payload)) if robot in self._endpoints else None
        if node is not None and node.node != self.node and node.node in self._ranked:
            with self._lock:
                self._statuses[robot, node.node] = node.ending
