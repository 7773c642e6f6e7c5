"""Large memory-mapped arrays, used window by window: pages that were read count as this process's until released."""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

WINDOW = 1 << 25
"""Bytes that are used before they are released, set by hand: 16 launches for half a gigabyte, and little to hold."""

LARGE = 1 << 26
"""Bytes from which an array is used by windows, set by hand: each pass through it costs time, about an eighth of a
second for a gigabyte (``python -m bench scale``)."""

_CAN_RELEASE = hasattr(mmap.mmap, "madvise") and hasattr(mmap, "MADV_DONTNEED")


class Windows:
    """The windows of an array (N, ...): one of all rows, unless it is mapped from a file and large.

    Iterating yields slices of rows; what one of them has brought into memory is released when the next is asked for.
    The system keeps the file's pages as long as it has room, so that reading them again takes no disk.
    """

    def __init__(self, array: npt.NDArray[Any]) -> None:
        """Take an array."""
        self._rows = len(array)
        self._size = array[:1].nbytes
        self._map = _map_of(array) if array.nbytes > LARGE and array.flags.c_contiguous else None
        self._step = self._rows if self._map is None else max(1, WINDOW // self._size)
        self._offset = 0 if self._map is None else _offset(array, self._map)

    @property
    def several(self) -> bool:
        """Whether there are more than one."""
        return self._step < self._rows

    def number(self, rows: npt.NDArray[np.int32]) -> npt.NDArray[np.int64]:
        """Return the numbers of the windows that rows are in."""
        return rows.astype(np.int64) // max(1, self._step)

    def release(self) -> None:
        """Release all of it."""
        self._release(slice(0, self._rows))

    def __iter__(self) -> Iterator[slice]:
        """Yield slices of rows, in order."""
        for start in range(0, self._rows, max(1, self._step)):
            part = slice(start, min(start + self._step, self._rows))
            try:
                yield part
            finally:
                self._release(part)

    def _release(self, part: slice) -> None:
        if self._map is None:
            return
        page = mmap.PAGESIZE
        begin = (self._offset + part.start * self._size) // page * page
        end = self._offset + part.stop * self._size
        self._map.madvise(mmap.MADV_DONTNEED, begin, min(end, len(self._map)) - begin)


def take_rows(array: npt.NDArray[Any], rows: npt.NDArray[np.int64]) -> npt.NDArray[Any]:
    """Return a copy (K, ...) of rows (K,) of an array; of a large mapped file, a window is in memory at a time.

    Raises:
        IndexError: there is no such row.
    """
    if len(rows) and not 0 <= rows.min() <= rows.max() < len(array):
        raise IndexError(f"rows {rows.min()} to {rows.max()} of {len(array)}")
    out = np.empty((len(rows), *array.shape[1:]), dtype=array.dtype)
    order = np.argsort(rows, kind="stable")
    sorted_rows = rows[order]
    for part in Windows(array):
        begin, end = np.searchsorted(sorted_rows, (part.start, part.stop))
        out[order[begin:end]] = array[sorted_rows[begin:end]]
    return out


def release(array: npt.NDArray[Any]) -> None:
    """Let the memory of an array that is mapped from a file go; it is read again when it is touched."""
    whole = _map_of(array)
    if whole is not None:
        whole.madvise(mmap.MADV_DONTNEED)


def _map_of(array: npt.NDArray[Any]) -> mmap.mmap | None:
    """Return the file's map that an array lies in, None of one in memory or one that can be written to."""
    base: Any = array
    if not _CAN_RELEASE or array.flags.writeable:  # what was written to a private map would be lost
        return None
    while base is not None and not isinstance(base, mmap.mmap):
        base = base.obj if isinstance(base, memoryview) else getattr(base, "base", None)
    return base


def _offset(array: npt.NDArray[Any], whole: mmap.mmap) -> int:
    """Return the byte of the map at which an array begins."""
    return int(array.ctypes.data - np.frombuffer(whole, dtype=np.uint8).ctypes.data)
