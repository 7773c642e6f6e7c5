"""A bounded queue of messages from the network that wait for a reader, for threads and event loops."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Generic, TypeVar

from coview_stream.errors import ConfigError

_Item = TypeVar("_Item")


class LatestQueue(Generic[_Item]):
    """Bounded queue in order of arrival; when it is full a new item replaces the oldest.

    ``put`` never blocks, so a slow reader cannot block a subscription. ConfigError for a ``size`` below 1.
    """

    def __init__(self, size: int) -> None:
        if size < 1:
            raise ConfigError(f"queue size: {size} is out of range; use at least 1")
        self._items: deque[_Item] = deque(maxlen=size)
        self._arrived = threading.Condition()
        self._waking: set[Callable[[], None]] = set()  # from readers in event loops
        self._closed = False
        self.dropped = 0
        """Number of items replaced unread."""

    def put(self, item: _Item) -> None:
        """Add an item; after :meth:`close` it is ignored."""
        with self._arrived:
            if self._closed:
                return
            self.dropped += len(self._items) == self._items.maxlen
            self._items.append(item)
            self._arrived.notify()
            self._wake_loops()

    def get(self, timeout: float | None = None) -> _Item | None:
        """Take the oldest item; None if none comes for ``timeout`` seconds (None: no limit) or the queue is closed."""
        deadline = None if timeout is None else time.monotonic() + timeout
        with self._arrived:
            while not self._items and not self._closed:
                left = None if deadline is None else deadline - time.monotonic()
                if left is not None and left <= 0:
                    return None
                self._arrived.wait(left)
            return self._items.popleft() if self._items else None

    async def next(self, timeout: float | None = None) -> _Item | None:
        """Take the oldest item as :meth:`get` does, without blocking the event loop; if cancelled, take nothing."""
        import asyncio

        loop, arrived = asyncio.get_running_loop(), asyncio.Event()

        def wake() -> None:
            with suppress(RuntimeError):  # the loop has been closed
                loop.call_soon_threadsafe(arrived.set)

        try:
            async with asyncio.timeout(timeout):
                while True:
                    arrived.clear()
                    with self._arrived:  # held for moments only
                        if self._items or self._closed:
                            return self._items.popleft() if self._items else None
                        self._waking.add(wake)
                    await arrived.wait()
        except TimeoutError:
            return None
        finally:
            with self._arrived:
                self._waking.discard(wake)

    def close(self) -> None:
        """Wake every reader; items in the queue can still be taken."""
        with self._arrived:
            self._closed = True
            self._arrived.notify_all()
            self._wake_loops()

    def _wake_loops(self) -> None:
        for wake in self._waking:
            wake()


class Received(Generic[_Item]):
    """Iterator over a queue's items as they arrive, for ``for`` and ``async for``.

    Ends when the queue is closed, or when no item comes for ``timeout`` seconds (None: never).
    """

    def __init__(self, unread: LatestQueue[_Item], timeout: float | None) -> None:
        self._unread = unread
        self._timeout = timeout
        self._ended = False

    def __iter__(self) -> Received[_Item]:
        return self

    def __next__(self) -> _Item:
        item = None if self._ended else self._unread.get(self._timeout)
        if item is None:
            self._ended = True
            raise StopIteration
        return item

    def __aiter__(self) -> Received[_Item]:
        return self

    async def __anext__(self) -> _Item:
        item = None if self._ended else await self._unread.next(self._timeout)
        if item is None:
            self._ended = True
            raise StopAsyncIteration
        return item
