"""Member of a fleet: takes robots on and gives them up as nodes come and go, and tells the others where they are."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Mapping
from typing import Any

from coview_stream.errors import TransportError
from coview_stream.messages.types import Encoded, Sample
from coview_stream.stream.node.fleet import FleetShares
from coview_stream.stream.node.handover import Handover
from coview_stream.stream.node.robot_endpoints import RobotEndpoints
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.transport import Transport

log = logging.getLogger("coview_stream.node")

_LOOK = 0.1  # seconds between two looks at who is alive; set by hand
_TELL = 1.0  # seconds between two messages of where the robots are; set by hand
_MAX_BYTES = 4 << 20  # of such a message that are read


class FleetMember:
    """Work of one node in a fleet, on a thread of its own.

    Args:
        shares: which robots are this node's.
        endpoints: of all robots of the fleet, by name; none of them listens yet.
        transport: where places are told.
    """

    def __init__(self, shares: FleetShares, endpoints: Mapping[str, RobotEndpoints], transport: Transport) -> None:
        self._shares = shares
        self._endpoints = endpoints
        self._errors = RateLimitedErrors(log)
        self._known: dict[str, Handover] = {}  # where robots of other nodes are, as these said
        self._arriving: dict[str, Handover] = {}  # robots that were taken on, and whose odometry has not come yet
        self._publisher = transport.publisher(f"{shares.prefix}/places/{shares.node}", "data")
        transport.subscribe(f"{shares.prefix}/places/*", self._hear, "all")

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
        try:
            moved = self._shares.look()
        except TransportError:
            return  # cut off: nothing is known
        if moved:
            self._move()
        for robot, known in list(self._arriving.items()):
            if self._endpoints[robot].session.take_over(known):
                del self._arriving[robot]

    def _move(self) -> None:
        given_up = [name for name, each in self._endpoints.items() if each.listening and not self._shares.owns(name)]
        if given_up:
            self.tell()  # the newest places, before they are forgotten
        for name in given_up:
            self._arriving.pop(name, None)
            self._endpoints[name].stop_listening()
            self._endpoints[name].session.give_up()
        taken = [name for name, each in self._endpoints.items() if not each.listening and self._shares.owns(name)]
        for name in taken:
            session = self._endpoints[name].session
            known = self._known.pop(name, None)
            if known is not None and known.map_sha256 == session.site_sha256:
                self._arriving[name] = known
            self._endpoints[name].listen()
        if given_up or taken:
            own = sum(map(self._shares.owns, self._endpoints))
            log.info("fleet: %d robots taken on, %d given up; %d are this node's", len(taken), len(given_up), own)

    def tell(self) -> None:
        """Tell the others where this node's robots are."""
        places = {}
        for name, each in self._endpoints.items():
            if each.listening and (place := each.session.handover()) is not None:
                places[name] = place.to_json()
        if places:
            self._publisher.put(Encoded(json.dumps(places, separators=(",", ":")).encode(), "application/json"))

    def _hear(self, sample: Sample) -> None:
        if sample.key.endswith(f"/{self._shares.node}") or len(sample.payload) > _MAX_BYTES:
            return
        try:
            told: Any = json.loads(bytes(sample.payload))
            for name, place in told.items():
                if name in self._endpoints and not self._endpoints[name].listening:
                    self._known[name] = Handover.from_json(place)
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError) as error:
            self._errors.report(sample.key, error)
