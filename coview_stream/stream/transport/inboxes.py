"""Inboxes of subscriptions: samples that wait for their handlers, and a few threads that call these.

zenoh's own queues take a thread each, and each thread that waits on one wakes ten times a second: a thousand
subscriptions would keep half a core busy with nothing.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

from coview_stream.stream.transport.error_guard import RateLimitedErrors

THREADS = 4
"""Handlers that run at once, of different subscriptions; set by hand: they decode, and wait for little else."""


class Inbox:
    """Samples of one subscription; the oldest is dropped where they are too many. At most one is handled at a time."""

    def __init__(self, name: str, handle: Callable[[Any], None], size: int, ready: SimpleQueue[Inbox | None]) -> None:
        self.name = name
        self._handle = handle
        self._waiting: deque[Any] = deque(maxlen=size)
        self._ready = ready
        self._lock = threading.Lock()
        self._scheduled = self._closed = False

    def put(self, sample: Any) -> None:
        """Keep a sample for its handler; called on zenoh's thread, and back at once."""
        with self._lock:
            if self._closed:
                return
            self._waiting.append(sample)
            if not self._scheduled:
                self._scheduled = True
                self._ready.put(self)

    def close(self) -> None:
        """Handle nothing any more, but for what is being handled now."""
        with self._lock:
            self._closed = True
            self._waiting.clear()

    def work(self) -> None:
        """Handle the oldest sample; the next one waits for its turn behind other subscriptions."""
        with self._lock:
            sample = self._waiting.popleft() if self._waiting else None
        try:
            if sample is not None:
                self._handle(sample)
        finally:
            del sample  # it may be large, and must not live until the next one comes
            with self._lock:
                self._scheduled = bool(self._waiting)
                if self._scheduled:
                    self._ready.put(self)


class Inboxes:
    """All inboxes of a transport."""

    def __init__(self, guard: RateLimitedErrors) -> None:
        """Take who logs what goes wrong."""
        self._guard = guard
        self._ready: SimpleQueue[Inbox | None] = SimpleQueue()

    def open(self, name: str, handle: Callable[[Any], None], size: int) -> Inbox:
        """Return a new inbox of at most ``size`` samples."""
        return Inbox(name, handle, size, self._ready)

    def run(self) -> None:
        """Handle samples until :meth:`end`; on several threads at once."""
        while (inbox := self._ready.get()) is not None:
            with self._guard.catch(inbox.name):
                inbox.work()
            del inbox
        self._ready.put(None)  # for the other threads

    def end(self) -> None:
        """Let all :meth:`run` return."""
        self._ready.put(None)
