"""LAS and LAZ files (COPC included), in chunks.

The header is checked before laspy reads it: where the number of records is wrong laspy reads on for minutes, and where
the number of chunks makes the LAZ decoder ask for more memory than there is, it aborts the whole process.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from coview_stream.clouds.cloud import Cloud, CloudBuilder
from coview_stream.clouds.las_header import read_las_header
from coview_stream.clouds.laszip_pointwise import POINTWISE, is_pointwise, with_one_chunk
from coview_stream.clouds.laz_process import read_in_child
from coview_stream.clouds.reference_system import flaw_of_system, stated_system, unchecked_system
from coview_stream.errors import CloudError, require_library, warn

CHUNK = 1_000_000
"""Points per chunk, set by hand: about 100 MB of float64 and record buffers at a time."""

NOISE_CLASSES = (7, 18)
"""ASPRS classes low and high noise."""

_MIN_HEADER, _MAX_HEADER = 227, 375  # bytes
_COMPRESSED = 0x80
_VARIABLE = 0xFFFFFFFF  # points per chunk, where the chunk table has them
_POINTS_PER_BYTE = 4  # set by hand: surveys take 2 to 6 bytes a point, a plane without noise half of one


def read_las(path: Path) -> Cloud:
    """Read a LAS or LAZ file; withheld points and the noise classes 7 and 18 are dropped and counted.

    Raises:
        CloudError: the file is damaged, truncated, empty or not in metres.
    """
    check_las(path)
    if is_compressed(path):
        require_laspy()  # here: its process could not say so
        return read_in_child(path)
    return decode(path, CloudBuilder).finish(os.fspath(path))


def check_las(path: Path) -> None:
    """Check a file's header against its size; CloudError where it is damaged or truncated."""
    problem = impossible_header(path)
    if problem:
        raise CloudError(_damaged(path, ValueError(problem)))
    header = read_las_header(path)
    if header.compressor is None and header.record_length:
        stored = max(0, path.stat().st_size - header.start) // header.record_length
        if stored < header.points:
            raise CloudError(_truncated(path, header.points, stored))


def decode(path: Path, builder: Callable[[str | None], CloudBuilder]) -> CloudBuilder:
    """Read a file whose header was checked, chunk by chunk, in this process, into ``builder`` of its reference system.

    Raises:
        CloudError: the file is damaged, truncated or not in metres.
    """
    laspy = require_laspy()
    try:
        with laspy.open(with_one_chunk(path) if is_pointwise(path) else path) as reader:
            return _read(reader, path, builder)
    except (CloudError, MemoryError):
        raise
    except Exception as error:
        raise CloudError(_damaged(path, error)) from error
    except BaseException as error:
        # the LAZ decoder's Rust panics are no Exception
        if type(error).__name__ != "PanicException":
            raise
        raise CloudError(_damaged(path, error)) from error


def require_laspy() -> Any:
    """Return laspy; DependencyError where it or its decoder is not installed."""
    require_library("lazrs", "lazrs>=0.6", "LAS and LAZ files")
    return require_library("laspy", "laspy[lazrs]>=2.5", "LAS and LAZ files")


def las_system(path: Path) -> str | None:
    """Return the reference system that a file states, WKT or ``EPSG:code``; None if it does not.

    Raises:
        CloudError: no map can be made in that system (feet, degrees, lengths that are not those on the ground).
    """
    header = read_las_header(path)
    text = stated_system(header.wkt, header.geo_keys)
    flaw = flaw_of_system(text, header.geo_keys, header.low, header.high)
    if flaw is not None:
        raise CloudError(f"{path}: {flaw}")
    if unchecked_system(text):
        warn(f"{path}: says {text}, whose units were not looked up; pip install 'pyproj>=3.6'")
    return text


def is_compressed(path: Path) -> bool:
    """Tell whether a file's points are compressed (LAZ), whatever its suffix."""
    with path.open("rb") as stream:
        return bool(stream.read(105)[104] & _COMPRESSED)


def _read(reader: Any, path: Path, make: Callable[[str | None], CloudBuilder]) -> CloudBuilder:
    header = reader.header
    expected = int(header.point_count)
    builder = make(las_system(path))
    read = 0
    for chunk in reader.chunk_iterator(CHUNK):
        read += len(chunk)
        classes = np.asarray(chunk.classification, dtype=np.uint8)
        keep = ~np.isin(classes, NOISE_CLASSES) & ~np.asarray(chunk.withheld, dtype=bool)
        columns = [
            np.asarray(axis)[keep] * scale + offset
            for axis, scale, offset in zip((chunk.X, chunk.Y, chunk.Z), header.scales, header.offsets, strict=True)
        ]
        builder.add(np.stack(columns, axis=1), classes[keep], dropped=int(len(keep) - keep.sum()))
    if read < expected:
        raise CloudError(_truncated(path, expected, read))
    return builder


def _damaged(path: Path, error: BaseException) -> str:
    reason = " ".join(str(error).split())[:160] or type(error).__name__
    return f"{path}: damaged or truncated LAS/LAZ ({reason}); copy or export the file again"


def _truncated(path: Path, expected: int, found: int) -> str:
    return (
        f"{path}: truncated, the header promises {expected} points and the file holds {found}; "
        "copy or export the file again"
    )


def impossible_header(path: Path) -> str | None:
    """Return what is impossible in the header of a LAS or LAZ file; None if nothing is."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        header = stream.read(_MAX_HEADER)
        if len(header) < _MIN_HEADER:
            return "the header is cut off"
        records = _unsigned(header[100:104])
        extended = _unsigned(header[243:247]) if header[25] >= 4 else 0
        if records * 54 + extended * 60 > size:
            return "more variable length records than fit"
        start = _unsigned(header[96:100])
        if start > size:
            return "the points begin behind the end"
        if not header[104] & _COMPRESSED:
            return None
        points = _unsigned(header[247:255]) if header[25] >= 4 else _unsigned(header[107:111])
        if points > _POINTS_PER_BYTE * size + CHUNK:
            return f"{points} points cannot be in {size} bytes"
        stream.seek(_unsigned(header[94:96]))
        wrong = _impossible_sizes(stream, records, max(points, CHUNK))
    if wrong or read_las_header(path).compressor == POINTWISE:
        return wrong
    with path.open("rb") as stream:
        return _impossible_chunks(stream, start, size)


def _impossible_sizes(stream: BinaryIO, records: int, points: int) -> str | None:
    """Check the points per chunk that the compressor's record states: the decoder makes room for them at once."""
    for _ in range(records):
        record = stream.read(54)
        length = _unsigned(record[20:22])
        if record[2:18].rstrip(b"\0") == b"laszip encoded" and _unsigned(record[18:20]) == 22204:
            per_chunk = _unsigned(stream.read(16)[12:16])
            return f"{per_chunk} points per chunk" if points < per_chunk < _VARIABLE else None
        stream.seek(length, os.SEEK_CUR)
    return None


def _impossible_chunks(stream: BinaryIO, start: int, size: int) -> str | None:
    """Check the chunk table: its place stands before the points, or in the last 8 bytes of a streamed file."""
    stream.seek(start)
    table = int.from_bytes(stream.read(8), "little", signed=True)
    if table == -1 and size >= 8:
        stream.seek(-8, os.SEEK_END)
        table = int.from_bytes(stream.read(8), "little", signed=True)
    if not start + 8 <= table <= size - 8:
        return "the chunk table is not in the file"
    stream.seek(table + 4)
    # a chunk holds at least one point, whose first record is stored as it is
    if _unsigned(stream.read(4)) * 20 > size:
        return "more chunks than fit"
    return None


def _unsigned(raw: bytes) -> int:
    return int.from_bytes(raw, "little")
