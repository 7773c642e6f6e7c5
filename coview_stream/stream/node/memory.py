"""Free memory of a process that runs for months: given back to the system now and then.

The C library keeps what its arenas once needed, one for each few threads: after a flood of messages or a search the
memory of a process stays at its highest mark. To give it back takes a few milliseconds.
"""

from __future__ import annotations

import ctypes
import threading
import time
from collections.abc import Callable

PERIOD = 60.0
"""Seconds between two times; set by hand."""


def release_free_memory() -> bool:
    """Give back what is free; False where the C library has no way to."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    return trim is not None and bool(trim(0))


class MemoryRelease:
    """Gives free memory back once in a while, by whoever calls it often enough.

    Args:
        release: does it.
        clock: seconds, monotonic.
    """

    def __init__(
        self, release: Callable[[], object] = release_free_memory, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._release = release
        self._clock = clock
        self._due = clock() + PERIOD

    def when_due(self) -> None:
        """Give it back if that was long ago."""
        if self._clock() >= self._due:
            self._release()
            self._due = self._clock() + PERIOD

    def run(self, stopping: threading.Event) -> None:
        """Do so until ``stopping`` is set."""
        while not stopping.wait(PERIOD):
            self._release()
