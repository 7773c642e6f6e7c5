"""Arrays in files without names: for what is made piece by piece and is larger than memory should be.

The files are deleted when they are closed, or when the process ends in any way. Room is taken before it is written to,
so that a full disk is an error and not a signal.
"""

from __future__ import annotations

import contextlib
import io
import math
import mmap
import os
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.basemap.file_format import Arrays
from coview_stream.errors import MapError

Array = npt.NDArray[Any]


class ArrayFiles:
    """Arrays by name, each in a file: made whole by :meth:`zeros`, or row by row by :meth:`append`."""

    def __init__(self, folder: Path) -> None:
        """Make them in this folder."""
        self._folder = folder
        self._files: dict[str, io.FileIO] = {}
        self._shapes: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}
        self._mapped: list[Array] = []

    def __enter__(self) -> ArrayFiles:
        """Return it."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close it."""
        self.close()

    def zeros(self, name: str, shape: tuple[int, ...], dtype: npt.DTypeLike) -> Array:
        """Return an array to be written to, of zeros.

        Raises:
            MapError: there is no room for it.
        """
        kind = np.dtype(dtype)
        size = kind.itemsize * math.prod(shape)
        file = self._new(name, kind, tuple(shape))
        if not size:
            return np.zeros(shape, kind)
        with self._room():
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)
            else:
                file.truncate(size)
        made = np.memmap(file, dtype=kind, mode="r+", shape=tuple(shape))
        self._mapped.append(made)
        return made

    def append(self, name: str, rows: Array) -> int:
        """Write rows (N, ...) below those that an array has, and return how many it had.

        Raises:
            MapError: there is no room for them.
        """
        file = self._files.get(name) or self._new(name, rows.dtype, (0, *rows.shape[1:]))
        kind, (before, *rest) = self._shapes[name]
        if kind != rows.dtype or tuple(rest) != rows.shape[1:]:
            raise ValueError(f"rows of {name} are {rows.dtype} {rows.shape[1:]}, not {kind} {tuple(rest)}")
        content = np.ascontiguousarray(rows).reshape(-1).view(np.uint8).data
        with self._room():
            file.seek(before * kind.itemsize * math.prod(rest))  # not behind what a failure has left
            while len(content):
                content = content[file.write(content) :]
        self._shapes[name] = kind, (before + len(rows), *rest)
        return before

    def rows(self, name: str, begin: int, end: int) -> Array:
        """Return some rows of an array in memory of their own."""
        kind, (_, *rest) = self._shapes[name]
        width = kind.itemsize * math.prod(rest)
        out = np.empty((end - begin, *rest), kind)
        view = out.reshape(-1).view(np.uint8).data
        done = 0
        while done < len(view):
            self._files[name].seek(begin * width + done)
            count = self._files[name].readinto(view[done:])
            if not count:
                raise MapError(f"{self._folder}: a file of the map that is being made was cut off")
            done += count
        return out

    def arrays(self) -> Arrays:
        """Return all arrays, mapped into memory, read-only."""
        found: Arrays = {}
        for name, (kind, shape) in self._shapes.items():
            if math.prod(shape):
                found[name] = np.memmap(self._files[name], dtype=kind, mode="r", shape=shape)
                self._mapped.append(found[name])
            else:
                found[name] = np.zeros(shape, kind)
        return found

    def release(self) -> None:
        """Let the memory go that what was written or read takes; it is in the files."""
        if hasattr(mmap, "MADV_DONTNEED"):
            for each in self._mapped:
                each._mmap.madvise(mmap.MADV_DONTNEED)  # type: ignore[attr-defined]  # NumPy's types lack it

    def close(self) -> None:
        """Delete the files; arrays that are still mapped can be used on."""
        self._mapped.clear()
        for file in self._files.values():
            file.close()
        self._files.clear()

    def _new(self, name: str, kind: np.dtype[Any], shape: tuple[int, ...]) -> io.FileIO:
        if name in self._files:
            raise ValueError(f"{name} is there already")
        with self._room():
            self._files[name] = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115 - until close()
        self._shapes[name] = kind, shape
        return self._files[name]

    @contextlib.contextmanager
    def _room(self) -> Any:
        try:
            yield
        except OSError as error:
            raise MapError(
                f"{self._folder}: cannot hold what a map is made of ({error.strerror}); make room, or name another "
                "folder in COVIEW_CACHE"
            ) from error
