"""A bounded queue between a network thread and a reader who may be slow: the newest win."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Generic, TypeVar

from coview_stream.errors import ConfigError

_Item = TypeVar("_Item")


class Mailbox(Generic[_Item]):
    """Holds up to ``size`` items in order of arrival; when it is full, the oldest goes.

    ``put`` never blocks, so that a subscription is never held up by its reader.

    Args:
        size: most items kept, at least 1.

    Raises:
        ConfigError: ``size`` is below 1.
    """

    def __init__(self, size: int) -> None:
        if size < 1:
            raise ConfigError(f"mailbox size: {size} is out of range; use at least 1")
        self._items: deque[_Item] = deque(maxlen=size)
        self._arrived = threading.Condition()
        self._closed = False
        self._dropped = 0

    @property
    def dropped(self) -> int:
        """How many items went unread because newer ones needed the place."""
        return self._dropped

    def put(self, item: _Item) -> None:
        """Add an item; after :meth:`close` it is ignored."""
        with self._arrived:
            if self._closed:
                return
            self._dropped += len(self._items) == self._items.maxlen
            self._items.append(item)
            self._arrived.notify()

    def get(self, timeout: float | None = None) -> _Item | None:
        """Take the oldest item; None when none came for ``timeout`` seconds (None: for ever) or it is closed."""
        deadline = None if timeout is None else time.monotonic() + timeout
        with self._arrived:
            while not self._items and not self._closed:
                left = None if deadline is None else deadline - time.monotonic()
                if left is not None and left <= 0:
                    return None
                self._arrived.wait(left)
            return self._items.popleft() if self._items else None

    def close(self) -> None:
        """Wake every reader; what is still inside can be taken."""
        with self._arrived:
            self._closed = True
            self._arrived.notify_all()
