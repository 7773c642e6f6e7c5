"""Rows of a memory-mapped array, read from its file: pages that are mapped count as memory of this process.

A row that is touched through the map brings the sixteen pages around it into the process, so that a few thousand rows
of half a gigabyte are all of it. Reading them leaves the pages to the system.
"""

from __future__ import annotations

import contextlib
import os
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.geometry.arrays import Ints

_GAP = 8  # rows between two that are read together: skipping them would take another call; set by hand


class StoredRows:
    """Rows of an array of a file.

    Args:
        array: (N, ...) memory-mapped.

    Raises:
        OSError: its file cannot be opened, or is another one by now.
    """

    def __init__(self, array: np.memmap[Any, Any]) -> None:
        if array.filename is None or not array.flags.c_contiguous or not len(array):
            raise OSError("not an array of a file")
        self._dtype, self._shape = array.dtype, array.shape[1:]
        self._row = array[:1].nbytes
        self._offset = array.offset
        self._file = os.open(array.filename, os.O_RDONLY | getattr(os, "O_CLOEXEC", 0))
        ends = np.array([0, len(array) - 1])
        if not np.array_equal(self.take(ends), array[ends]):  # the name is another file's by now
            os.close(self._file)
            self._file = -1
            raise OSError("its file has been replaced")

    def __del__(self) -> None:
        """Close the file."""
        if getattr(self, "_file", -1) >= 0:
            with contextlib.suppress(OSError):
                os.close(self._file)

    def take(self, rows: Ints) -> npt.NDArray[Any]:
        """Return some rows (K, ...), whose numbers increase.

        Raises:
            OSError: the file has become shorter.
        """
        found = np.empty((len(rows), *self._shape), dtype=self._dtype)
        if not len(rows):
            return found
        begins = np.flatnonzero(np.append(True, np.diff(rows) > _GAP))
        for begin, end in zip(begins.tolist(), np.append(begins[1:], len(rows)).tolist(), strict=True):
            first, last = int(rows[begin]), int(rows[end - 1])
            size = (last - first + 1) * self._row
            raw = os.pread(self._file, size, self._offset + first * self._row)
            if len(raw) != size:
                raise OSError("the map's file has been cut off")
            whole = np.frombuffer(raw, dtype=self._dtype).reshape(-1, *self._shape)
            found[begin:end] = whole[rows[begin:end] - first]
        return found


def stored_rows(array: npt.NDArray[Any]) -> StoredRows | None:
    """Return the rows of an array by its file, None where it is not memory-mapped or the file is gone."""
    if not isinstance(array, np.memmap) or not hasattr(os, "pread"):
        return None
    try:
        return StoredRows(array)
    except OSError:
        return None
