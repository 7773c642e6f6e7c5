"""Decompression with a limit for recordings: rosbags unpacks whole chunks, a few kB of which may claim gigabytes."""

from __future__ import annotations

import bz2
import os
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

LIMIT = 1 << 29
"""Bytes that a chunk or a message may unpack to, set by hand: recorders begin a new chunk after a few MB."""

RATIO = 100
"""Times its size, besides :data:`LIMIT`, that a whole file may unpack to, set by hand: clouds come to less than ten."""


def bounded(make: Callable[[], Any]) -> Callable[..., bytes]:
    """Return a function that unpacks all frames of its argument.

    Args:
        make: returns a decompressor like that of bz2: ``decompress(data, max_length)``, ``eof``, ``unused_data``.

    The function raises ValueError where that is more than :data:`LIMIT` bytes, or the data end early.
    """

    def decompress(data: bytes, _: int = 0) -> bytes:
        pieces: list[bytes] = []
        left = LIMIT
        while data:
            decompressor = make()
            while not decompressor.eof:
                pieces.append(decompressor.decompress(data, left + 1))
                data = b""
                left -= len(pieces[-1])
                if left < 0:
                    raise ValueError(f"a chunk unpacks to more than {LIMIT} bytes")
                if not pieces[-1] and not decompressor.eof:
                    raise ValueError("a compressed chunk ends early")
            data = bytes(decompressor.unused_data or b"")
        return b"".join(pieces)

    return decompress


class BoundedFile:
    """A file that is unpacked while it is read, up to a number of bytes; ValueError beyond."""

    def __init__(self, unpacked: Any, left: int) -> None:
        self._unpacked, self._left = unpacked, left

    def read(self, size: int = -1) -> bytes:
        """Read at most ``size`` unpacked bytes, or all."""
        data = bytes(self._unpacked.read(self._left + 1 if size < 0 else size))
        self._left -= len(data)
        if self._left < 0:
            raise ValueError("a compressed file unpacks to more than a hundred times its size")
        return data

    def __enter__(self) -> BoundedFile:
        return self

    def __exit__(self, *error: object) -> None:
        self._unpacked.close()


def bounded_open(opener: Callable[..., Any]) -> Callable[..., BoundedFile]:
    """Return a function that opens a compressed file as ``opener`` does, to be unpacked within :data:`RATIO`."""

    def opened(file: Any, mode: str = "rb") -> BoundedFile:
        return BoundedFile(opener(file, mode), LIMIT + RATIO * os.fstat(file.fileno()).st_size)

    return opened


def bound_rosbags() -> None:
    """Let rosbags' readers, of this process, use such functions instead of their own."""
    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import reader as ros2
    from rosbags.rosbag2 import storage_mcap as mcap

    if isinstance(ros2.zstd, SimpleNamespace):
        return
    library = ros2.zstd
    zstd, lz4 = bounded(library.ZstdDecompressor), bounded(LZ4FrameDecompressor)
    mcap.DECOMPRESSORS.update(zstd=zstd, lz4=lz4)
    ros1.decompressors.update(bz2=bounded(bz2.BZ2Decompressor), lz4=lz4)
    ros2.zstd = SimpleNamespace(decompress=zstd, open=bounded_open(library.open))
