"""Conversion of samples and queries between zenoh's types and ours, quality of service, and queues of both ways."""

from __future__ import annotations

import json
import threading
from collections import Counter, deque
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

from coview_stream.errors import MessageError, TransportError
from coview_stream.messages.json_messages import read_object
from coview_stream.messages.types import Encoded, Sample
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.transport import Urgency

_UNSET = "zenoh/bytes"  # how zenoh spells "no encoding"
_JSON = "application/json"
_MAX_WAITING = 1024  # messages queued for the link: 5 s of 200 Hz odometry
MAX_QUERY = 8192
"""Largest query, bytes of parameters, payload and attachment; our answers ignore the last two."""

MAX_QUERIES = 16
"""Queries that may wait on one key; further ones are refused."""

FLUSH = 0.3  # seconds for queued messages at close

Answer = Callable[[dict[str, str]], dict[str, Any]]
"""Handler of a query: takes its parameters, returns the fields of the reply."""


class ZenohPublisher:
    """A publisher that may exist before its session, and outlive it.

    ``guard`` logs zenoh's refusals; ``writer`` publishes asynchronously, None on the calling thread.
    """

    def __init__(self, key: str, guard: RateLimitedErrors, writer: Writer | None = None) -> None:
        self._key = key
        self._guard = guard
        self._writer = writer
        self._publisher: Any = None
        self._closed = False

    def attach(self, publisher: Any) -> None:
        """Take zenoh's publisher, once a session has declared it; None when that session ends."""
        self._publisher = publisher
        if self._closed:
            self.close()

    def put(self, message: Encoded) -> None:
        """Publish; the message is lost without a session or peer."""
        if self._writer is None:
            self.write(message)
        elif self._publisher is not None:
            self._writer.put(self, message)

    def write(self, message: Encoded) -> None:
        """Publish now, and wait while the link is blocked."""
        publisher = self._publisher
        if publisher is not None and not self._closed:
            encoding = message.encoding or _UNSET
            with self._guard.catch(self._key):
                publisher.put(message.payload, encoding=encoding, attachment=message.attachment)

    def close(self) -> None:
        """Undeclare; later messages are ignored. Messages queued for the link get 0.3 s."""
        if self._writer is not None and not self._closed:
            self._writer.flush(FLUSH)
        self._closed = True
        publisher, self._publisher = self._publisher, None
        if publisher is not None:
            with self._guard.catch(self._key):
                publisher.undeclare()


class Writer:
    """Queue of messages that wait for the link instead of being dropped, and the work of the thread that empties it.

    A half-open link blocks its writer for seconds: this thread, not the callers. Beyond 1024 messages, five seconds of
    200 Hz odometry, the oldest are dropped, which is logged.
    """

    def __init__(self, guard: RateLimitedErrors) -> None:
        self._guard = guard
        self._waiting: deque[tuple[ZenohPublisher, Encoded]] = deque()
        self._changed = threading.Condition()
        self._busy = self._ended = False

    def put(self, publisher: ZenohPublisher, message: Encoded) -> None:
        """Add a message; never waits."""
        with self._changed:
            if self._ended:
                return
            if len(self._waiting) >= _MAX_WAITING:
                self._waiting.popleft()
                self._guard.report("writing", TransportError("the link is held up: the oldest odometry is dropped"))
            self._waiting.append((publisher, message))
            self._changed.notify_all()

    def run(self) -> None:
        """Write until :meth:`end`."""
        while True:
            with self._changed:
                self._busy = False
                self._changed.notify_all()
                while not (self._waiting or self._ended):
                    self._changed.wait()
                if self._ended:
                    return
                publisher, message = self._waiting.popleft()
                self._busy = True
            publisher.write(message)

    def flush(self, seconds: float) -> bool:
        """Wait up to ``seconds`` until everything is written; return whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: not (self._waiting or self._busy), seconds)

    def end(self) -> None:
        """Let :meth:`run` return; waiting messages are lost."""
        with self._changed:
            self._ended = True
            self._waiting.clear()
            self._changed.notify_all()


def plain(sample: Any, max_payload: int | None = None) -> Sample:
    """Return a zenoh sample as plain data. Copies the payload once: zenoh's Python types do not share memory.

    If payload and attachment together exceed ``max_payload``, only their size is returned: a copy would block every
    other thread.
    """
    key, encoding = str(sample.key_expr), str(sample.encoding)
    encoding = "" if encoding == _UNSET else encoding
    attachment, size = sample.attachment, size_of(sample)
    if max_payload is not None and size > max_payload:
        return Sample(key, b"", encoding, size=size)
    return Sample(key, sample.payload.to_bytes(), encoding, None if attachment is None else attachment.to_bytes())


def quality(urgency: Urgency) -> dict[str, Any]:
    """Return the options with which zenoh declares a publisher of this urgency."""
    import zenoh

    congestion, priority = zenoh.CongestionControl, zenoh.Priority
    if urgency == "realtime":  # express: not batched; 0.2 ms instead of 8 beside clouds on the link
        return {"express": True, "priority": priority.REAL_TIME, "congestion_control": congestion.DROP}
    if urgency == "report":
        return {"congestion_control": congestion.DROP}
    if urgency == "data":  # DROP lost 2 % of small messages at 300 robots on one link; goes before clouds on a thin one
        return {"priority": priority.INTERACTIVE_HIGH, "congestion_control": congestion.BLOCK}
    # BLOCK_FIRST hands one frame to a background task and meanwhile drops newer ones: put never waits. DROP abandons a
    # half-sent large frame after 50 ms, so none arrives on a slow link
    control = getattr(congestion, "BLOCK_FIRST", congestion.DROP)
    return {"priority": priority.DATA_LOW, "congestion_control": control}


class Answers:
    """Queue of queries to answer; one thread answers for all keys.

    At most :data:`MAX_QUERIES` of :data:`MAX_QUERY` bytes each wait on one key: further ones are refused at once.
    """

    def __init__(self, guard: RateLimitedErrors) -> None:
        self._guard = guard
        self._queries: SimpleQueue[tuple[str, Any, Answer, threading.Event] | None] = SimpleQueue()
        self._waiting: Counter[str] = Counter()
        self._lock = threading.Lock()

    def callback(self, key: str, handler: Answer, ended: threading.Event) -> Callable[[Any], None]:
        """Return the callback that queues queries on ``key``. Once ``ended`` is set none is answered."""

        def enqueue(query: Any) -> None:
            with self._guard.catch(key):
                self._put(key, query, handler, ended)

        return enqueue

    def _put(self, key: str, query: Any, handler: Answer, ended: threading.Event) -> None:
        size = len(str(query.parameters)) + sum(
            len(part) for part in (query.payload, query.attachment) if part is not None
        )
        with self._lock:
            busy = self._waiting[key] >= MAX_QUERIES
            if not busy and size <= MAX_QUERY:
                self._waiting[key] += 1
                self._queries.put((key, query, handler, ended))
                return
        why = f"{MAX_QUERIES} queries wait already: ask later" if busy else f"{size} bytes, {MAX_QUERY} at most"
        query.reply_err(json.dumps({"error": f"{key}: {why}"}), encoding=_JSON)

    def run(self) -> None:
        """Answer until :meth:`end`."""
        while (entry := self._queries.get()) is not None:
            key, query, handler, ended = entry
            if not ended.is_set():
                with self._guard.catch(key):
                    self._answer(key, query, handler)
            with self._lock:
                self._waiting[key] -= 1
            del entry, query  # a query is complete for its sender once no reference is left

    def end(self) -> None:
        """Let :meth:`run` return."""
        self._queries.put(None)

    def _answer(self, key: str, query: Any, handler: Answer) -> None:
        asked = str(query.key_expr)
        if asked != key:  # an explorer's or a recorder's get("**") must not reset every robot
            query.reply_err(json.dumps({"error": f"{key} answers to its own key only, not to {asked}"}), encoding=_JSON)
            return
        try:
            reply = json.dumps(handler({str(name): str(value) for name, value in query.parameters}))
        except Exception as error:
            self._guard.report(key, error)
            query.reply_err(json.dumps({"error": str(error)}), encoding=_JSON)
        else:
            query.reply(key, reply, encoding=_JSON)


def first_reply(
    session: Any, key: str, parameters: dict[str, str], timeout: float, max_bytes: int
) -> dict[str, Any] | None:
    """Query ``key``; return the first JSON reply, None after ``timeout`` s; TransportError for any other reply."""
    import zenoh

    for reply in session.get(zenoh.Selector(key, parameters), timeout=timeout):
        if reply.ok is None:
            raise TransportError(f"{key}: the node refused: {_error_of(reply.err.payload.to_bytes())}")
        return _json_object(key, reply.ok.payload.to_bytes(), max_bytes)
    return None


def _json_object(key: str, payload: bytes, max_bytes: int) -> dict[str, Any]:
    try:
        return read_object(payload, max_bytes)
    except MessageError as error:
        raise TransportError(
            f"{key}: the answer is not a JSON object ({error}); is this a coview_stream node?"
        ) from error


def _error_of(payload: bytes) -> str:
    """Return the text of an error reply: ``error`` in its JSON, or the bytes as text."""
    try:
        return str(read_object(payload)["error"])
    except (MessageError, KeyError):
        return payload[:200].decode("utf-8", "replace")


THREADS = 4
"""Handlers that run in parallel, for different subscriptions: they decode and rarely wait."""


MAX_INBOX = 1 << 27
"""Bytes of samples that may wait on one subscription, besides the newest: two of the largest (64 MiB each)."""


def size_of(sample: Any) -> int:
    """Return the bytes in a zenoh sample's payload and attachment, without a copy."""
    return len(sample.payload) + (0 if sample.attachment is None else len(sample.attachment))


class Inbox:
    """Samples of one subscription, handled one at a time; of too many, or too large ones, the oldest are dropped."""

    def __init__(self, name: str, handle: Callable[[Any], None], size: int, ready: SimpleQueue[Inbox | None]) -> None:
        self.name = name
        self._handle = handle
        self._waiting: deque[tuple[Any, int]] = deque()
        self._size, self._bytes = size, 0
        self._ready = ready
        self._lock = threading.Lock()
        self._scheduled = self._closed = False

    def put(self, sample: Any) -> None:
        """Keep a sample for its handler; called on zenoh's thread, returns at once."""
        weight = size_of(sample)
        with self._lock:
            if self._closed:
                return
            self._waiting.append((sample, weight))
            self._bytes += weight
            while len(self._waiting) > self._size or (self._bytes > MAX_INBOX and len(self._waiting) > 1):
                self._bytes -= self._waiting.popleft()[1]
            if not self._scheduled:
                self._scheduled = True
                self._ready.put(self)

    def close(self) -> None:
        """Handle nothing more; a running handler finishes."""
        with self._lock:
            self._closed = True
            self._waiting.clear()
            self._bytes = 0

    def work(self) -> None:
        """Handle the oldest sample; the next one queues behind other subscriptions."""
        with self._lock:
            sample, weight = self._waiting.popleft() if self._waiting else (None, 0)
            self._bytes -= weight
        try:
            if sample is not None:
                self._handle(sample)
        finally:
            del sample  # it may be large: free it before the next sample comes
            with self._lock:
                self._scheduled = bool(self._waiting)
                if self._scheduled:
                    self._ready.put(self)


class Inboxes:
    """All inboxes of a transport."""

    def __init__(self, guard: RateLimitedErrors) -> None:
        self._guard = guard
        self._ready: SimpleQueue[Inbox | None] = SimpleQueue()

    def open(self, name: str, handle: Callable[[Any], None], size: int) -> Inbox:
        """Return a new inbox of at most ``size`` samples."""
        return Inbox(name, handle, size, self._ready)

    def run(self) -> None:
        """Handle samples until :meth:`end`; several threads may run this."""
        while (inbox := self._ready.get()) is not None:
            with self._guard.catch(inbox.name):
                inbox.work()
            del inbox
        self._ready.put(None)  # for the other threads

    def end(self) -> None:
        """Let every :meth:`run` return."""
        self._ready.put(None)
