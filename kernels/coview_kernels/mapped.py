"""Large memory-mapped arrays, used window by window: pages count as this process's memory until released."""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

WINDOW = 1 << 25
"""Bytes of a window: 16 launches for half a gigabyte."""

LARGE = 1 << 26
"""Least bytes of an array that is used by windows; a pass takes an eighth of a second per gigabyte."""

_CAN_RELEASE = hasattr(mmap.mmap, "madvise") and hasattr(mmap, "MADV_DONTNEED")


class Windows:
    """Windows of an array (N, ...); one window of all rows unless the array is large and mapped from a file.

    Iterating yields slices of rows, and releases the pages of each before the next. The system caches the file's pages
    while it has room, so that reading them again needs no disk.
    """

    def __init__(self, array: npt.NDArray[Any]) -> None:
        self._rows = len(array)
        self._size = array[:1].nbytes
        self._map = _map_of(array) if array.nbytes > LARGE and array.flags.c_contiguous else None
        self._step = self._rows if self._map is None else max(1, WINDOW // self._size)
        start = 0 if self._map is None else np.frombuffer(self._map, dtype=np.uint8).ctypes.data
        self._offset = int(array.ctypes.data - start)  # of the array in the map

    @property
    def several(self) -> bool:
        """Whether there is more than one window."""
        return self._step < self._rows

    def number(self, rows: npt.NDArray[np.int32]) -> npt.NDArray[np.int64]:
        """Return the numbers of the windows of rows."""
        return rows.astype(np.int64) // max(1, self._step)

    def release(self) -> None:
        """Release all pages."""
        self._release(slice(0, self._rows))

    def __iter__(self) -> Iterator[slice]:
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
    """Copy rows (K,) of an array to (K, ...), window by window; IndexError if a row does not exist."""
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
    """Release the pages of an array that is mapped from a file; access reads them again."""
    whole = _map_of(array)
    if whole is not None:
        whole.madvise(mmap.MADV_DONTNEED)


def _map_of(array: npt.NDArray[Any]) -> mmap.mmap | None:
    """Return the memory map that holds an array; None for an array in memory or a writable one."""
    base: Any = array
    if not _CAN_RELEASE or array.flags.writeable:  # changes of a private map would be lost
        return None
    while base is not None and not isinstance(base, mmap.mmap):
        base = base.obj if isinstance(base, memoryview) else getattr(base, "base", None)
    return base
