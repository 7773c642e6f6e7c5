"""Arrays in unnamed files, for arrays that are built piece by piece and should not fill the memory.

The files vanish when they are closed, or when the process ends in any way. Space is allocated before it is written, so
that a full disk is an error, not a signal.
"""

from __future__ import annotations

import contextlib
import io
import math
import mmap
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.basemap.file_format import Arrays
from coview_stream.basemap.map_arrays import MemoryArrays
from coview_stream.errors import MapError

Array = npt.NDArray[Any]


class ArrayFiles(MemoryArrays):
    """Arrays by name, each in a file: allocated at once by :meth:`zeros`, or grown by :meth:`append`."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder
        self._files: dict[str, io.FileIO] = {}
        self._shapes: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}
        self._mapped: list[Array] = []

    def __enter__(self) -> ArrayFiles:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def zeros(self, name: str, shape: tuple[int, ...], dtype: npt.DTypeLike) -> Array:
        """Return a new array of zeros to write to; MapError if there is no space."""
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
        """Append rows (N, ...) to an array, and return its earlier length; MapError if there is no space."""
        file = self._files.get(name) or self._new(name, rows.dtype, (0, *rows.shape[1:]))
        kind, (before, *rest) = self._shapes[name]
        if kind != rows.dtype or tuple(rest) != rows.shape[1:]:
            raise ValueError(f"rows of {name} are {rows.dtype} {rows.shape[1:]}, not {kind} {tuple(rest)}")
        content = np.ascontiguousarray(rows).reshape(-1).view(np.uint8).data
        with self._room():
            file.seek(before * kind.itemsize * math.prod(rest))  # over the remains of a failed write
            while len(content):
                content = content[file.write(content) :]
        self._shapes[name] = kind, (before + len(rows), *rest)
        return before

    def rows(self, name: str, begin: int, end: int) -> Array:
        """Return a copy of rows ``begin`` to ``end`` of an array; MapError if its file was cut off."""
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
        mapped: Arrays = {}
        for name, (kind, shape) in self._shapes.items():
            if math.prod(shape):
                mapped[name] = np.memmap(self._files[name], dtype=kind, mode="r", shape=shape)
                self._mapped.append(mapped[name])
            else:
                mapped[name] = np.zeros(shape, kind)
        return mapped

    def release(self) -> None:
        """Release the memory of mapped pages; the content is in the files."""
        if hasattr(mmap, "MADV_DONTNEED"):
            for array in self._mapped:
                array._mmap.madvise(mmap.MADV_DONTNEED)  # type: ignore[attr-defined]  # NumPy's types lack it

    def close(self) -> None:
        """Delete the files; mapped arrays stay usable."""
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
    def _room(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise MapError(
                f"{self._folder}: cannot hold the parts of a map ({error.strerror}); make room, or name another "
                "folder in COVIEW_CACHE"
            ) from error
