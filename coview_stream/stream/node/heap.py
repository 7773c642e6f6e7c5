"""Settings of the C library's heap, if it is glibc's.

By default each thread has its own heap, up to eight per core. Messages of a megabyte pass through most threads of a
node, and every heap keeps, in pieces, the most it has ever held: resident memory grew for hours, by 100 kB with each
fault of a link or a robot, although no more bytes were in use.
"""

from __future__ import annotations

import contextlib
import ctypes
import os

_ARENA_MAX, _MMAP_THRESHOLD = -8, -3  # numbers of mallopt's settings in malloc.h
_LARGE = 1 << 18  # bytes: a larger piece is mapped, and unmapped when freed; 0.1 ms for a cloud


def bound_heaps(number: int, map_large: bool = False) -> None:
    """Make threads share ``number`` heaps; ``map_large`` keeps large pieces out of them. Call it before threads start.

    The user's own settings, ``MALLOC_ARENA_MAX`` and ``MALLOC_MMAP_THRESHOLD_``, take precedence.
    """
    with contextlib.suppress(OSError, AttributeError, TypeError):  # another C library
        library = ctypes.CDLL(None)
        if "MALLOC_ARENA_MAX" not in os.environ:
            library.mallopt(_ARENA_MAX, number)
        if map_large and "MALLOC_MMAP_THRESHOLD_" not in os.environ:
            library.mallopt(_MMAP_THRESHOLD, _LARGE)


def return_free_memory() -> None:
    """Return the heaps' free memory to the system: tens of megabytes after a search."""
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
