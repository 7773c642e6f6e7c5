"""Network interface of nodes and clients; implemented for zenoh, for ROS 2, and in memory for tests."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from coview_stream.messages.types import Encoded, Sample

MAX_REPLY = 64 * 1024
"""Largest reply to a query, bytes, unless the caller allows more."""

Policy = Literal["newest", "all"]
"""``newest``: a slow reader sees only the newest sample. ``all``: all, in order; if too many wait, the oldest go."""

Urgency = Literal["realtime", "data", "report", "bulk"]
"""``realtime``: small and urgent (poses): express, never waits. ``data``: must arrive (odometry): waits for a
busy link in a bounded queue. ``report``: statuses: a stopped reader misses some and blocks no other reader. ``bulk``:
clouds: only the newest frame matters, one that does not fit is dropped."""


class Publisher(Protocol):
    """A publisher on one key."""

    def put(self, message: Encoded) -> None:
        """Publish; never raises for a peer that has gone."""
        ...

    def close(self) -> None:
        """Undeclare."""
        ...


@dataclass(frozen=True)
class Connection:
    """Connected routers and peers, sorted: zenoh identities, or names of ROS 2 nodes."""

    routers: tuple[str, ...] = ()
    peers: tuple[str, ...] = ()  # all others; clients of a listening session count as peers
    clients: tuple[str, ...] = ()  # the peers that are clients


class Transport(Protocol):
    """A publish/subscribe session. Each subscription calls its handler for one sample at a time, on another thread."""

    def subscribe(self, key: str, handler: Callable[[Sample], None], policy: Policy) -> Callable[[], None]:
        """Call ``handler`` with samples on ``key`` (a key expression). Its exceptions are logged.

        Returns a function that ends the subscription; any thread may call it, more than once.
        """
        ...

    def publisher(self, key: str, urgency: Urgency) -> Publisher:
        """Declare a publisher."""
        ...

    def answer(self, key: str, handler: Callable[[dict[str, str]], dict[str, Any]]) -> Callable[[], None]:
        """Answer queries on ``key`` with JSON; ``handler`` takes the query's parameters; an exception is replied.

        Returns a function that ends the answers; any thread may call it, more than once.
        """
        ...

    def announce(self, key: str) -> None:
        """Hold a liveliness token on ``key`` until :meth:`close`."""
        ...

    def query(
        self, key: str, parameters: dict[str, str] | None = None, timeout: float = 5.0, max_bytes: int = MAX_REPLY
    ) -> dict[str, Any]:
        """Query ``key`` and return the first JSON reply, of at most ``max_bytes``.

        Raises:
            TransportError: no answer within ``timeout`` seconds, or the answer is an error or not a JSON object.
        """
        ...

    def tokens(self, expression: str) -> list[str]:
        """List the liveliness tokens that match ``expression`` now, sorted; empty while not connected.

        Raises:
            TransportError: the query for tokens failed.
        """
        ...

    def await_subscriber(self, key: str, seconds: float, wait: Callable[[float], object] = time.sleep) -> bool:
        """Wait up to ``seconds`` for a subscriber to ``key``; return whether there is one.

        ``wait(seconds)`` passes the time between checks; it ends the wait early by returning True.
        """
        ...

    def connection(self) -> Connection:
        """Return the current connections."""
        ...

    def close(self) -> None:
        """Undeclare everything and end all threads; idempotent."""
        ...
