"""What the node needs of a network: zenoh provides it, and a fake one for tests without threads or time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from coview_stream.stream.messages import Encoded, Sample

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

    def connection(self) -> Connection:
        """Whom we are connected to right now."""
        ...

    def close(self) -> None:
        """Undeclare everything and end all threads; idempotent."""
        ...
