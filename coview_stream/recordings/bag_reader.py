"""ROS recordings, read with rosbags: topics, and messages as CDR in order of arrival.

rosbags unpacks whole chunks, and a chunk of a few kB may unpack to gigabytes, so bounded decompressors replace its own.
"""

from __future__ import annotations

import bz2
import importlib
import os
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from coview_stream.errors import CoViewError, InputError, RunError
from coview_stream.messages import livox, ros2
from coview_stream.recordings import frame_tree

LIMIT = 1 << 29
"""Largest unpacked chunk or message, bytes; recorders start a new chunk after a few MB."""

RATIO = 100
"""A file may unpack to this multiple of its size, plus :data:`LIMIT`; clouds reach less than ten."""

_REMEDIES = (  # the first whose key occurs in the reason
    ("ompression", "write it again with zstd or without compression (ros2 bag convert)"),
    ("rofile", "record or export it as ROS 2 (CDR) messages"),
    ("empty", "copy or record it again"),
    ("denied", "check its permissions"),
    ("metadata", "repair it with: ros2 bag reindex"),
    ("", "repair it (mcap recover, ros2 bag reindex, rosbag reindex) or copy it again"),
)


@contextmanager
def readable(name: object, kind: type[InputError] = RunError) -> Iterator[None]:
    """Turn any error that rosbags raises on a damaged recording into one line with its name and the remedy."""
    try:
        yield
    except CoViewError:
        raise
    except Exception as error:  # on hostile bytes rosbags raises KeyError, TypeError, AssertionError and more
        words = " ".join(str(error).split())[:200].rstrip(".")
        reason = words if " " in words else f"{type(error).__name__} {words}".rstrip()
        remedy = next(text for word, text in _REMEDIES if word in reason)
        raise kind(f"{name}: cannot be read ({reason}); {remedy}") from error


class BagReader:
    """An open recording, closed when it is garbage-collected; messages are read one at a time.

    Reads rosbag2 directories (sqlite3 and mcap, several files, compressed or not), single ``.mcap`` and ``.db3`` files,
    and ROS 1 ``.bag`` files, whose messages are converted to CDR.

    Raises:
        RunError: it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._ros1 = path.suffix == ".bag" and path.is_file()
        with readable(path):
            _bound_rosbags()
            library = importlib.import_module("rosbags.rosbag1" if self._ros1 else "rosbags.rosbag2")
            self._reader: Any = library.Reader(path)
            self._reader.open()
        weakref.finalize(self, self._reader.close)

    def counts(self) -> dict[tuple[str, str], int]:
        """Count the messages of each (type, topic); RunError for a topic without a name."""
        counts: dict[tuple[str, str], int] = {}
        for connection in self._reader.connections:
            key = (connection.msgtype, connection.topic)
            if not all(isinstance(name, str) for name in key):  # a database accepts any value
                raise RunError(f"{self.path}: cannot be read (a topic without name or type); record or copy it again")
            counts[key] = counts.get(key, 0) + connection.msgcount
        return counts

    def messages(self, topics: Mapping[str, str], start: int | None = None) -> Iterator[tuple[str, int, bytes]]:
        """Yield (topic, arrival in ns, CDR) for the topics (name: type), in order of arrival, from ``start`` on.

        Arrival is on the recorder's clock; it only serves to find a message again.

        Raises:
            Exception: anything that rosbags raises; see :func:`readable`.
        """
        connections = [c for c in self._reader.connections if topics.get(c.topic) == c.msgtype]
        for connection, arrived, data in self._reader.messages(connections, start=start):
            payload = _cdr_from_ros1(data, connection.msgtype) if self._ros1 else data
            yield connection.topic, arrived, bytes(payload)


def _cdr_from_ros1(data: bytes, kind: str) -> bytes:
    if kind in livox.TYPES:
        return livox.cdr_from_ros1(data)
    return bytes(ros2.store().ros1_to_cdr(data, frame_tree.TYPES[0] if kind in frame_tree.TYPES else kind))


def bounded(make: Callable[[], Any]) -> Callable[..., bytes]:
    """Return a function that unpacks with decompressors like bz2's, at most :data:`LIMIT` bytes (else ValueError)."""

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
    """A compressed file, unpacked as it is read, up to a number of bytes; ValueError beyond."""

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
    """Return a function that opens a compressed file like ``opener``, bounded by :data:`RATIO`."""

    def opened(file: Any, mode: str = "rb") -> BoundedFile:
        return BoundedFile(opener(file, mode), LIMIT + RATIO * os.fstat(file.fileno()).st_size)

    return opened


def _bound_rosbags() -> None:
    """Replace the decompressors of rosbags' readers, in this process, with bounded ones."""
    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag1 import reader as ros1_reader
    from rosbags.rosbag2 import reader as ros2_reader
    from rosbags.rosbag2 import storage_mcap

    library = ros2_reader.zstd
    if isinstance(library, SimpleNamespace):
        return
    zstd, lz4 = bounded(library.ZstdDecompressor), bounded(LZ4FrameDecompressor)
    storage_mcap.DECOMPRESSORS.update(zstd=zstd, lz4=lz4)
    ros1_reader.decompressors.update(bz2=bounded(bz2.BZ2Decompressor), lz4=lz4)
    ros2_reader.zstd = SimpleNamespace(decompress=zstd, open=bounded_open(library.open))
