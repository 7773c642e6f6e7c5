"""Zenoh transport: a session that implements :class:`~coview_stream.stream.transport.transport.Transport`."""

from __future__ import annotations

import atexit
import logging
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from coview_stream.errors import TransportError
from coview_stream.messages.types import Sample
from coview_stream.stream.transport import zenoh_config
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.transport import MAX_REPLY, Connection, Policy, Publisher, Transport, Urgency
from coview_stream.stream.transport.zenoh_config import zenoh_errors
from coview_stream.stream.transport.zenoh_io import (
    FLUSH,
    THREADS,
    Answers,
    Inboxes,
    Writer,
    ZenohPublisher,
    first_reply,
    plain,
    quality,
)

_log = logging.getLogger(__name__)

# zenoh's error text for a missing router; waiting does not cure any other error at opening
_NO_ROUTER = "Unable to connect"

# seconds
_POLL = 0.02  # a check of the matching status costs microseconds
_RETRY = 0.5  # between attempts to find the first router
_OPEN_TIMEOUT = 2.0  # for the first attempt to open: a host that is off does not even refuse
_CLOSE_TIMEOUT = 1.0  # for zenoh to close, which says goodbye on a link that may be blocked
_JOIN_TIMEOUT = 0.4  # for all our threads to end at close; they notice it within 0.1
_EXIT_TIMEOUT = 10.0  # for each thread to end with the process: longer than any attempt to open
_TOKEN_TIMEOUT = 1.0  # for answers to a query for tokens
_QUEUE = 1024  # samples; 5 s of 200 Hz odometry


def open_transport(
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    config: Path | None = None,
    max_payload: int | None = None,
    lease_ms: int | None = None,
) -> ZenohTransport:
    """Open a zenoh session.

    A client may start before its router: declarations take effect once the router is there; samples published before
    are lost. After an outage the connection is restored without further calls.

    Args:
        connect: endpoints to connect to, for example ``tcp/127.0.0.1:7447``.
        listen: endpoints to listen on.
        config: zenoh configuration file; it overrides our defaults, ``connect`` and ``listen`` override it.
        max_payload: bytes beyond which only a message's size is handed on; None: no limit.
        lease_ms: time without a sign of life after which others consider us dead; None: zenoh's 10 s.

    Raises:
        TransportError: the configuration is wrong or an endpoint cannot be bound.
    """
    import zenoh

    # RUST_LOG=zenoh=warn prints why a router refuses us; by default zenoh is silent
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]  # zenoh gives it no types
    return ZenohTransport(zenoh_config.compose(connect, listen, config, lease_ms), max_payload)


DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
"""Default endpoint of a client: zenoh's usual port, on this machine only."""


def open_client(
    endpoint: str | Sequence[str] | None = None,
    listen: str | Sequence[str] | None = None,
    config: str | Path | None = None,
) -> Transport:
    """Open a zenoh session for a client: to :data:`DEFAULT_ENDPOINT` unless the arguments say otherwise.

    Raises:
        TransportError: as :func:`coview_stream.stream.transport.zenoh_transport.open_transport`.
    """
    connect = _listed(endpoint)
    if not connect and not _listed(listen) and config is None:
        connect = [DEFAULT_ENDPOINT]
    return open_transport(connect, _listed(listen), None if config is None else Path(config))


def _listed(endpoints: str | Sequence[str] | None) -> list[str]:
    return [endpoints] if isinstance(endpoints, str) else list(endpoints or ())


class ZenohTransport:
    """A zenoh session, opened by :func:`open_transport`. Any thread may call any method."""

    def __init__(self, config: Any, max_payload: int | None = None) -> None:
        self._config = config
        self._max_payload = max_payload
        self._waits = zenoh_config.mode_of(config) == "client"
        self._guard = RateLimitedErrors(_log)
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._threads: list[threading.Thread] = []
        self._declared: list[Any] = []  # zenoh undeclares unreferenced objects
        self._declarations: list[Callable[[Any], None]] = []  # for a session that opens later
        self._answers = Answers(self._guard)
        self._inboxes = Inboxes(self._guard)
        self._writer = Writer(self._guard)
        self._session: Any = None
        # a thread inside zenoh at interpreter shutdown aborts the process: end all threads before
        atexit.register(self._at_exit)
        self._open()

    def subscribe(self, key: str, handler: Callable[[Sample], None], policy: Policy) -> Callable[[], None]:
        """Call ``handler`` on one of our threads; ``newest`` keeps one unread sample, ``all`` the newest 1024.

        A subscription's samples are handled one at a time, in order. Returns a function that ends the subscription.

        Raises:
            TransportError: ``key`` is not a key expression, or the transport is closed.
        """
        import zenoh

        def handle(sample: Any) -> None:
            if not self._closing.is_set() and sample.kind == zenoh.SampleKind.PUT:
                handler(plain(sample, self._max_payload))

        inbox = self._inboxes.open(key, handle, 1 if policy == "newest" else _QUEUE)

        def declare(session: Any) -> Any:
            subscriber = session.declare_subscriber(key, zenoh.handlers.Callback(inbox.put, indirect=False))
            self._start_once("inboxes", self._inboxes.run, THREADS)
            return subscriber

        return self._declare_until_end(key, declare, threading.Event(), inbox.close)

    def publisher(self, key: str, urgency: Urgency) -> Publisher:
        """Declare a publisher. Errors as in :meth:`subscribe`."""
        publisher = ZenohPublisher(key, self._guard, self._writer if urgency == "data" else None)

        def declare(session: Any) -> None:
            publisher.attach(session.declare_publisher(key, **quality(urgency)))
            if urgency == "data":
                self._start_once("writer", self._writer.run)

        self._declare(key, declare)
        return publisher

    def answer(self, key: str, handler: Callable[[dict[str, str]], dict[str, Any]]) -> Callable[[], None]:
        """Answer queries with JSON; all handlers of a transport share one thread. Errors as in :meth:`subscribe`.

        Returns a function that ends the answers, also to waiting queries.
        """
        import zenoh

        ended = threading.Event()
        callback = zenoh.handlers.Callback(self._answers.callback(key, handler, ended), indirect=False)

        def declare(session: Any) -> Any:
            queryable = session.declare_queryable(key, callback)
            self._start_once("answers", self._answers.run)
            return queryable

        return self._declare_until_end(key, declare, ended)

    def announce(self, key: str) -> None:
        """Hold a liveliness token until :meth:`close`. Errors as in :meth:`subscribe`."""

        def declare(session: Any) -> None:
            self._declared.append(session.liveliness().declare_token(key))

        self._declare(key, declare)

    def query(
        self, key: str, parameters: dict[str, str] | None = None, timeout: float = 5.0, max_bytes: int = MAX_REPLY
    ) -> dict[str, Any]:
        """As :meth:`Transport.query`, but first waits for the first router."""
        deadline = time.monotonic() + timeout
        while (session := self._session) is None and time.monotonic() < deadline:
            time.sleep(_POLL)
        if session is not None:
            left = max(_POLL, deadline - time.monotonic())
            answer = first_reply(session, key, parameters or {}, left, max_bytes)
            if answer is not None:
                return answer
        raise TransportError(f"{key}: no answer within {timeout:g} s; is the node running and connected?")

    def tokens(self, expression: str) -> list[str]:
        """As :meth:`Transport.tokens`."""
        session = self._session
        if session is None:
            return []
        with zenoh_errors(f"tokens {expression!r}"):
            replies = [reply.ok for reply in session.liveliness().get(expression, timeout=_TOKEN_TIMEOUT)]
        return sorted({str(sample.key_expr) for sample in replies if sample is not None})

    def await_subscriber(self, key: str, seconds: float, wait: Callable[[float], object] = time.sleep) -> bool:
        """As :meth:`Transport.await_subscriber`."""
        probe: Any = None
        deadline = time.monotonic() + seconds
        try:
            while True:
                if probe is None and (session := self._session) is not None:
                    probe = session.declare_publisher(key)
                if probe is not None and probe.matching_status.matching:
                    return True
                if time.monotonic() >= deadline or wait(_POLL):
                    return False
        finally:
            if probe is not None:
                probe.undeclare()

    @property
    def session(self) -> Any:
        """The zenoh session; None while closed or waiting for the first router."""
        return self._session

    def connection(self) -> Connection:
        """Return the current connections; none while closed or waiting for the first router."""
        with self._lock:
            if self._session is None:
                return Connection()
            others = [(str(o.whatami), str(o.zid)) for o in self._session.info.transports()]
        return Connection(
            tuple(sorted(zid for kind, zid in others if kind == "router")),
            tuple(sorted(zid for kind, zid in others if kind != "router")),
            tuple(sorted(zid for kind, zid in others if kind == "client")),
        )

    def close(self) -> None:
        """Undeclare, give queued messages 0.3 s, end the threads; within 1 s, or 2 s on a blocked link; idempotent."""
        with self._lock:
            if self._closing.is_set():
                return
            self._closing.set()
            session, self._session = self._session, None
            self._declarations.clear()
        if session is not None:
            self._writer.flush(FLUSH)
            self._writer.end()
            self._start_once("closing", self._end, 1, session)
            self._threads[-1].join(_CLOSE_TIMEOUT)  # a blocked link keeps it from closing: continue without it
        self._writer.end()
        self._answers.end()
        self._inboxes.end()
        end = time.monotonic() + _JOIN_TIMEOUT
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, end - time.monotonic()))
        self._declared.clear()
        if not any(thread.is_alive() for thread in self._threads):
            atexit.unregister(self._at_exit)

    def _end(self, session: Any) -> None:
        with self._guard.catch("closing"):
            session.close()

    def _at_exit(self) -> None:
        self.close()
        for thread in self._threads:
            thread.join(_EXIT_TIMEOUT)

    # opening

    def _open(self) -> None:
        """Open now, so that the caller gets configuration errors; a missing router is waited for in the background."""
        if not self._waits:
            try:
                self._attempt()
            except TransportError:
                self.close()
                raise
            return
        first: SimpleQueue[TransportError | None] = SimpleQueue()
        self._start_once("opening", self._keep_trying, 1, first)
        where = zenoh_config.endpoints_of(self._config)
        try:
            error = first.get(timeout=_OPEN_TIMEOUT)
        except Empty:
            _log.warning("no answer from a router at %s yet: going on without", where)
            return
        if error is not None and _NO_ROUTER not in str(error):
            self.close()
            raise error
        if error is not None:
            _log.warning(
                "no node or router at %s, or it refuses us (RUST_LOG=zenoh=warn says more): waiting for it", where
            )

    def _keep_trying(self, first: SimpleQueue[TransportError | None]) -> None:
        while not self._closing.is_set():
            try:
                self._attempt()
            except TransportError as error:
                first.put(error)
                self._closing.wait(_RETRY)
            else:
                first.put(None)
                _log.info("connected to %s", zenoh_config.endpoints_of(self._config))
                return

    def _attempt(self) -> None:
        import zenoh

        with zenoh_errors("zenoh session"):
            session: Any = zenoh.open(self._config)
        with self._lock:
            if not self._closing.is_set():
                self._session = session
                for declare in self._declarations:
                    with self._guard.catch("declaring"):
                        declare(session)
                return
        session.close()

    def _declare(self, key: str, declare: Callable[[Any], None]) -> None:
        import zenoh

        with zenoh_errors(f"key {key!r}"):
            zenoh.KeyExpr(key)  # refuses anything but a key expression
        with self._lock:
            if self._closing.is_set():
                raise TransportError(f"key {key!r}: the transport is closed")
            if self._session is not None:
                with zenoh_errors(f"key {key!r}"):
                    declare(self._session)
            self._declarations.append(declare)

    def _declare_until_end(
        self, key: str, declare: Callable[[Any], Any], ended: threading.Event, close: Callable[[], None] = lambda: None
    ) -> Callable[[], None]:
        """Declare an entity; return a function that ends it, in this session and in one opened later."""
        declared: list[Any] = []

        def declare_unless_ended(session: Any) -> None:
            if not ended.is_set():
                declared[:] = [declare(session)]
                self._declared.extend(declared)

        def end() -> None:
            ended.set()
            close()
            with self._lock:
                if declare_unless_ended in self._declarations:
                    self._declarations.remove(declare_unless_ended)
                ending = [entity for entity in declared if entity in self._declared]
                for entity in ending:
                    self._declared.remove(entity)
                declared.clear()
            for entity in ending:
                with self._guard.catch(key):
                    entity.undeclare()

        self._declare(key, declare_unless_ended)
        return end

    def _start_once(self, name: str, target: Callable[..., None], count: int = 1, *args: Any) -> None:
        if any(thread.name.startswith(f"coview {name}") for thread in self._threads):
            return
        for number in range(count):
            name_of_thread = f"coview {name} {number + 1}" if count > 1 else f"coview {name}"
            self._threads.append(threading.Thread(target=target, args=args, name=name_of_thread, daemon=True))
            self._threads[-1].start()
