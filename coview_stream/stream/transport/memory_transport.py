"""In-memory transport for tests of nodes and clients, like httpx's ``MockTransport`` for HTTP.

It has no threads and no clock: every call is complete when it returns. Public: pass it as a
:class:`~coview_stream.stream.transport.transport.Transport`.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

from coview_stream.errors import TransportError
from coview_stream.messages.types import Encoded, Sample
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.keys import check_expression, matches
from coview_stream.stream.transport.transport import MAX_REPLY, Connection, Policy, Publisher, Urgency

_log = logging.getLogger(__name__)


class MemoryPublisher:
    """Publisher on one key of a :class:`MemoryTransport`."""

    def __init__(self, transport: MemoryTransport, key: str, urgency: Urgency) -> None:
        self.key = key
        self.urgency = urgency
        self.closed = False
        self._transport = transport

    def put(self, message: Encoded) -> None:
        """Record the message and hand it to matching subscriptions; lost while the network is away."""
        if not self.closed:
            self._transport.publish(Sample(self.key, message.payload, message.encoding, message.attachment))

    def close(self) -> None:
        """Undeclare: later messages are ignored."""
        self.closed = True


class MemoryTransport:
    """A transport and the network around it: the test plays robot, client and router.

    Attributes:
        published: every sample that reached the network, in order, from publishers and from :meth:`publish`.
        lost: number of samples published while the network was away.
        raised: exceptions raised by handlers, in order.
    """

    def __init__(self) -> None:
        self.published: list[Sample] = []
        self.publishers: list[MemoryPublisher] = []
        self.lost = 0
        self.raised: list[Exception] = []
        self.closed = False
        self._connected = True
        self._tokens: list[str] = []
        self._subscriptions: list[tuple[str, Callable[[Sample], None], Policy]] = []
        self._answers: list[tuple[str, Callable[[dict[str, str]], dict[str, Any]]]] = []
        self._guard = RateLimitedErrors(_log)

    # for the node or client under test

    def subscribe(self, key: str, handler: Callable[[Sample], None], policy: Policy) -> Callable[[], None]:
        """Call ``handler`` within each matching publication; nothing is queued, so both policies are the same."""
        subscription = (check_expression(key, "key"), handler, policy)
        self._subscriptions.append(subscription)

        def end() -> None:
            if subscription in self._subscriptions:
                self._subscriptions.remove(subscription)

        return end

    def publisher(self, key: str, urgency: Urgency) -> Publisher:
        """Declare a publisher; it stays readable in :attr:`publishers`."""
        publisher = MemoryPublisher(self, check_expression(key, "key", wildcards=False), urgency)
        self.publishers.append(publisher)
        return publisher

    def answer(self, key: str, handler: Callable[[dict[str, str]], dict[str, Any]]) -> Callable[[], None]:
        """Answer :meth:`query`; of several answers to one key the first declared replies."""
        answer = (check_expression(key, "key"), handler)
        self._answers.append(answer)

        def end() -> None:
            if answer in self._answers:
                self._answers.remove(answer)

        return end

    def announce(self, key: str) -> None:
        """Hold a token until :meth:`close`."""
        self._tokens.append(check_expression(key, "key", wildcards=False))

    def query(
        self, key: str, parameters: dict[str, str] | None = None, timeout: float = 5.0, max_bytes: int = MAX_REPLY
    ) -> dict[str, Any]:
        """Call the handler declared with :meth:`answer`; TransportError without one, or if it raises."""
        handler = next((handler for name, handler in self._answers if matches(name, key)), None)
        if handler is None or not self._connected:
            raise TransportError(f"{key}: no answer")
        try:
            return handler(dict(parameters or {}))
        except Exception as error:
            self.raised.append(error)
            raise TransportError(f"{key}: the node refused: {error}") from error

    def tokens(self, expression: str) -> list[str]:
        """Return the :attr:`announced` tokens that match, sorted, each once."""
        return sorted({token for token in self.announced if matches(expression, token)})

    def await_subscriber(self, key: str, seconds: float, wait: Callable[[float], object] = time.sleep) -> bool:
        """Return True at once: every publication counts as heard, as :attr:`published` keeps it."""
        return True

    def connection(self) -> Connection:
        """Return one router, ``memory``, unless the network is away."""
        return Connection(routers=("memory",)) if self._connected and not self.closed else Connection()

    def close(self) -> None:
        """Drop subscriptions, publishers, answers and tokens."""
        self.closed = True
        for publisher in self.publishers:
            publisher.close()
        self._subscriptions.clear()
        self._answers.clear()
        self._tokens.clear()

    # for the test

    @property
    def announced(self) -> tuple[str, ...]:
        """Liveliness tokens that others can see now, in the order of their announcement."""
        return tuple(self._tokens) if self._connected else ()

    @property
    def subscribed(self) -> dict[str, Policy]:
        """Subscribed key expressions, with their policies."""
        return {key: policy for key, _, policy in self._subscriptions}

    def publish(self, sample: Sample) -> None:
        """Publish as another member of the network; every matching handler has run on return."""
        if not self._connected:
            self.lost += 1
            return
        self.published.append(sample)
        for key, handler, _ in list(self._subscriptions):
            if matches(key, sample.key):
                with self._guard.catch(key) as caught:
                    handler(sample)
                if caught.error is not None:
                    self.raised.append(caught.error)

    def samples(self, key: str) -> list[Sample]:
        """Return the samples published on keys that match ``key``, oldest first."""
        return [sample for sample in self.published if matches(key, sample.key)]

    def withdraw(self, key: str) -> None:
        """Drop a liveliness token, as if its process had died."""
        self._tokens.remove(key)

    def go_away(self) -> None:
        """Take the router away: publications are lost, queries fail, tokens vanish; declarations stay."""
        self._connected = False

    def come_back(self) -> None:
        """Bring the router back with everything declared."""
        self._connected = True
