"""Hub between the feed and the pages that are open: the newest event of each kind, for every page at its own pace.

Nobody waits for a page: what it has not taken when the next event of the same kind comes is replaced.
"""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

MAX_PAGES = 8
"""Pages that are served at a time, set by hand."""
_MAX_KEPT = 4_000  # events that a page may have to take: four kinds of a thousand robots

Slot = tuple[str, str]
"""Kind of an event, and whom it is about."""


class Page:
    """Events that one page has not taken yet: one for each slot, in the order in which they came."""

    def __init__(self) -> None:
        self._events: OrderedDict[Slot, bytes] = OrderedDict()
        self._changed = threading.Condition()
        self.closed = False

    def put(self, slot: Slot, event: bytes) -> None:
        """Add an event in place of the one before in its slot."""
        with self._changed:
            self._events.pop(slot, None)
            if len(self._events) < _MAX_KEPT and not self.closed:
                self._events[slot] = event
                self._changed.notify()

    def take(self, timeout: float) -> bytes:
        """Take all events; empty if there is none for ``timeout`` seconds, or it is closed."""
        with self._changed:
            if not self._events and not self.closed:
                self._changed.wait(timeout)
            taken = b"".join(self._events.values())
            self._events.clear()
        return taken

    def close(self) -> None:
        """Wake the taker; nothing more comes."""
        with self._changed:
            self.closed = True
            self._events.clear()
            self._changed.notify_all()


class WebHub:
    """All pages that are open, and what a new one has to be told first."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pages: list[Page] = []
        self._kept: OrderedDict[Slot, bytes] = OrderedDict()
        self._first: list[Callable[[], list[bytes]]] = []
        self._closed = False

    @property
    def pages(self) -> int:
        """Number of pages that are open."""
        return len(self._pages)

    def publish(self, kind: str, about: str, data: dict[str, Any], keep: bool = True) -> None:
        """Hand an event to all pages, and, if it is kept, to those that open later."""
        slot, event = (kind, about), encode_event(kind, data)
        with self._lock:
            if keep and (slot in self._kept or len(self._kept) < _MAX_KEPT):
                self._kept[slot] = event
            pages = list(self._pages)
        for page in pages:
            page.put(slot, event)

    def tell_first(self, events: Callable[[], list[bytes]]) -> None:
        """Have every new page told these events as well, before all others."""
        self._first.append(events)

    def open_page(self) -> Page | None:
        """Return a new page that has everything to be told; None if there are too many."""
        page = Page()
        for number, event in enumerate(event for events in self._first for event in events()):
            page.put(("first", str(number)), event)
        with self._lock:
            if self._closed or len(self._pages) >= MAX_PAGES:
                return None
            for slot, event in self._kept.items():
                page.put(slot, event)
            self._pages.append(page)
        return page

    def close_page(self, page: Page) -> None:
        """Forget a page."""
        page.close()
        with self._lock:
            if page in self._pages:
                self._pages.remove(page)

    def close(self) -> None:
        """Close all pages; none can be opened any more."""
        with self._lock:
            self._closed = True
            pages = list(self._pages)
        for page in pages:
            page.close()


def encode_event(kind: str, data: dict[str, Any]) -> bytes:
    """Return a server-sent event; ValueError for NaN, which JSON cannot say."""
    return f"event: {kind}\ndata: {json.dumps(data, allow_nan=False, separators=(',', ':'))}\n\n".encode()
