"""What nodes and clients need of a network: zenoh provides it, and an in-memory one without threads or time."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from coview_stream.messages.types import Encoded, Sample

Policy = Literal["newest", "all"]
"""``newest``: a slow reader sees only the newest sample (a ring of one). ``all``: every sample, in order."""

Urgency = Literal["realtime", "data", "report", "bulk"]
"""``realtime``: small and urgent (poses): express, never waits. ``data``: must arrive (odometry): blocks rather than
drops. ``report``: statuses: who has stopped reading misses some and holds nobody up. ``bulk``: clouds: the newest frame
matters, one that does not fit is dropped."""


class Publisher(Protocol):
    """Publishes on one key."""

    def put(self, message: Encoded) -> None:
        """Publish; never raises for a peer that is gone."""
        ...

    def close(self) -> None:
        """Undeclare."""
        ...


@dataclass(frozen=True)
class Connection:
    """Whom a transport is connected to, zenoh identities, sorted; clients of a listening session count as peers."""

    routers: tuple[str, ...] = ()
    peers: tuple[str, ...] = ()
    clients: tuple[str, ...] = ()
    """Those of the peers that are clients."""


class Transport(Protocol):
    """A publish/subscribe session. Handlers are called on a thread of the subscription's own, one call at a time."""

    def subscribe(self, key: str, handler: Callable[[Sample], None], policy: Policy) -> None:
        """Call ``handler`` for what is published on ``key`` (a key expression). What it raises is logged, not fatal."""
        ...

    def publisher(self, key: str, urgency: Urgency) -> Publisher:
        """Declare a publisher."""
        ...

    def answer(self, key: str, handler: Callable[[dict[str, str]], dict[str, Any]]) -> None:
        """Answer queries on ``key`` with JSON; the handler takes the query's parameters. An error of it is replied."""
        ...

    def announce(self, key: str) -> None:
        """Hold a liveliness token on ``key`` until :meth:`close`."""
        ...

    def query(
        self, key: str, parameters: dict[str, str] | None = None, timeout: float = 5.0
    ) -> dict[str, Any]:
        """Ask on ``key`` and return the first JSON reply.

        Raises:
            TransportError: nobody answered within ``timeout`` seconds, or the answer was an error or no JSON object.
        """
        ...

    def tokens(self, expression: str, timeout: float = 1.0) -> list[str]:
        """Keys of the liveliness tokens that match ``expression`` right now, sorted; none while not connected.

        Raises:
            TransportError: they cannot be asked for.
        """
        ...

    def await_subscriber(
        self, key: str, seconds: float, wait: Callable[[float], object] = time.sleep
    ) -> bool:
        """Wait up to ``seconds`` until somebody subscribes to ``key``; False if nobody did.

        ``wait(seconds)`` passes the time between two looks; what it returns as true ends the waiting early.
        """
        ...

    def connection(self) -> Connection:
        """Whom we are connected to right now."""
        ...

    def close(self) -> None:
        """Undeclare everything and end all threads; idempotent."""
        ...
