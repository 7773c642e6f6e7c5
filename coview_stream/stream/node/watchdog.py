"""Watchdog that ends what hangs."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Watchdog:
    """Time limit of one block at a time, kept by one thread that sleeps as long as all goes well.

    Args:
        name: of its thread.
        act: called, once, when the time of the block is over; meanwhile the block cannot end.
    """

    def __init__(self, name: str, act: Callable[[], None]) -> None:
        self._name = name
        self._act = act
        self._condition = threading.Condition()
        self._deadline: float | None = None
        self._sleeps_until: float | None = None
        self._thread: threading.Thread | None = None
        self._closed = False
        self.acted = False

    @contextmanager
    def limit(self, seconds: float) -> Iterator[None]:
        """Allow the block ``seconds``; :attr:`acted` says afterwards whether it needed more."""
        self._arm(time.monotonic() + seconds)
        try:
            yield
        finally:
            with self._condition:
                self._deadline = None

    def close(self) -> None:
        """End the thread."""
        with self._condition:
            self._closed = True
            self._condition.notify_all()

    def _arm(self, deadline: float) -> None:
        with self._condition:
            self._deadline, self.acted = deadline, False
            if self._thread is None and not self._closed:
                self._thread = threading.Thread(target=self._watch, name=self._name, daemon=True)
                self._thread.start()
            # a thread that wakes too early looks at the new deadline: most jobs cost no switch of threads
            if self._sleeps_until is None or self._sleeps_until > deadline:
                self._condition.notify_all()

    def _watch(self) -> None:
        with self._condition:
            while not self._closed:
                now = time.monotonic()
                if self._deadline is not None and now >= self._deadline:
                    self._deadline, self.acted = None, True
                    self._act()
                self._sleeps_until = self._deadline
                self._condition.wait(None if self._deadline is None else self._deadline - now)
