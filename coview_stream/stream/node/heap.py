"""Settings of the C library's heap, where it is glibc's.

By default each thread has a heap of its own, up to eight for each core. Messages of a megabyte pass through most
threads of a node, and every heap keeps the most that it has ever held, in pieces: resident memory grew for hours by
100 kB with each fault of a link or a robot, though no byte more was in use.
"""

from __future__ import annotations

import contextlib
import ctypes
import os

_ARENA_MAX, _MMAP_THRESHOLD = -8, -3  # names of mallopt's settings in malloc.h
_LARGE = 1 << 18  # bytes: a larger piece is mapped, and unmapped when it is free; 0.1 ms for a cloud


def bound_heaps(number: int, map_large: bool = False) -> None:
    """Let all threads share so many heaps; ``map_large`` keeps large pieces out of them. Before threads are started.

    The user's own settings, ``MALLOC_ARENA_MAX`` and ``MALLOC_MMAP_THRESHOLD_``, stay.
    """
    with contextlib.suppress(OSError, AttributeError, TypeError):  # another C library
        library = ctypes.CDLL(None)
        if "MALLOC_ARENA_MAX" not in os.environ:
            library.mallopt(_ARENA_MAX, number)
        if map_large and "MALLOC_MMAP_THRESHOLD_" not in os.environ:
            library.mallopt(_MMAP_THRESHOLD, _LARGE)


def return_free_memory() -> None:
    """Give the free memory of the heaps back to the system: after a search, tens of megabytes."""
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
