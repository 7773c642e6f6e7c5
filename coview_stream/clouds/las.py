"""LAS and LAZ files (COPC too), read in chunks by laspy.

The sizes in a header are checked first, because a wrong number of records keeps laspy busy for minutes, and a wrong
chunk table makes the LAZ decoder allocate too much memory.
"""

from __future__ import annotations

import contextlib
import logging
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from coview_stream.clouds.cloud import CloudBuilder
from coview_stream.clouds.reference_system import flaw_of_system, stated_system, unchecked_system
from coview_stream.clouds.survey_unit import InMetres, SurveyUnit, unit_of_system
from coview_stream.errors import PIP_INSTALL, CloudError, require_library, warn
from coview_stream.geometry.arrays import Floats

CHUNK = 1_000_000
"""Points per chunk: about 100 MB of float64 and record buffers."""
NOISE_CLASSES = (7, 18)
"""ASPRS classes of low and high noise."""
_MIN_HEADER, _MAX_HEADER = 227, 375  # bytes
_WKT_RECORD = "LASF_Projection", 2112
_POINTWISE = 1  # LASzip's number for the compressor without chunks
_VARIABLE = 0xFFFFFFFF  # points per chunk, if the chunk table states them
_POINTS_PER_BYTE = 4  # at most: surveys take 2 to 6 bytes per point, a plane without noise half a byte


def require_laspy() -> Any:
    """Return laspy; DependencyError if it or its decoder is not installed."""
    require_library("lazrs", "lazrs>=0.6", "LAS and LAZ files")
    return require_library("laspy", "laspy[lazrs]>=2.5", "LAS and LAZ files")


@contextlib.contextmanager
def las_writer(stream: BinaryIO, header: Any, path: Path) -> Iterator[Any]:
    """Open laspy's writer for LAS, or LAZ by the suffix of ``path``, on a stream that stays open.

    Raises:
        OSError: the stream cannot be written; the LAZ encoder's own exception is converted.
    """
    laspy, lazrs = require_laspy(), require_library("lazrs", "lazrs>=0.6", "LAS and LAZ files")
    compress = path.suffix.lower() == ".laz"
    try:
        with laspy.open(stream, mode="w", header=header, do_compress=compress, closefd=False) as writer:
            yield writer
    except lazrs.LazrsError as error:
        raise OSError(" ".join(str(error).split())[:160]) from error


def read_header(path: Path) -> Any:
    """Read a file's ``laspy.LasHeader`` and check its sizes; CloudError if it is damaged or truncated."""
    with _reader(path) as reader:
        return reader.header


def decode(path: Path, builder: CloudBuilder) -> None:
    """Read a file chunk by chunk into a builder, in this process, in metres, with its reference system.

    Points that are withheld or classified as noise are dropped and counted. CloudError if the file is damaged, or for
    the reasons of :func:`system_of`.
    """
    with _reader(path) as reader:
        builder.crs, unit = system_of(path, reader.header)
        builder = builder if unit is None else InMetres(builder, unit)
        for raw, classes, dropped in _chunks(path, reader):
            builder.add(raw, classes, dropped)


def system_of(path: Path, header: Any) -> tuple[str | None, SurveyUnit | None]:
    """Return the reference system in a header, WKT or ``EPSG:code``, None if it states none, and the unit.

    For a file in feet the system returned is in metres, and the unit is the file's; a unit of None is the metre.

    Raises:
        CloudError: the system allows no map (degrees, or lengths that differ from lengths on the ground).
    """
    records = [*header.vlrs, *(header.evlrs or ())]
    wkt = ""
    keys: dict[int, int] = {}
    for record in records:
        kind = type(record).__name__
        if kind == "WktCoordinateSystemVlr":
            wkt = wkt or record.string.strip("\0 \r\n\t")
        elif (record.user_id, record.record_id) == _WKT_RECORD:  # laspy could not decode it
            wkt = wkt or record.record_data.decode("utf-8", "replace").strip("\0 \r\n\t")
            warn(f"{path}: its reference system is not UTF-8, unreadable letters are replaced; export the file again")
        elif kind == "GeoKeyDirectoryVlr":
            for key in record.geo_keys:
                if key.tiff_tag_location == 0:  # the value itself; others refer to records of doubles or text
                    keys.setdefault(key.id, key.value_offset)
    text = stated_system(wkt, keys)
    low, high, unit = header.mins, header.maxs, unit_of_system(text, keys)
    if unit is not None:
        text, keys, low, high = unit.crs, {}, unit.to_metres(low), unit.to_metres(high)
    flaw = flaw_of_system(text, keys, low, high)
    if flaw is not None:
        raise CloudError(f"{path}: {flaw}")
    if unchecked_system(text):
        warn(f"{path}: says {text}, whose units were not looked up; {PIP_INSTALL} 'pyproj>=3.6'")
    return text, unit


@contextlib.contextmanager
def _reader(path: Path) -> Iterator[Any]:
    laspy = require_laspy()
    with path.open("rb") as stream:
        size = path.stat().st_size
        with _damage_of(path):
            _check_sizes(stream, size)
            logger = logging.getLogger("laspy")
            level = logger.level
            logger.setLevel(logging.ERROR)  # it warns of records that this module checks itself
            try:
                reader = laspy.open(stream, closefd=False)
            finally:
                logger.setLevel(level)
            _check_points(path, reader.header, stream, size)
        yield reader


def _chunks(path: Path, reader: Any) -> Iterator[tuple[Floats, npt.NDArray[np.uint8], int]]:
    """Yield coordinates (N, 3), classes (N,) and the number of dropped points, chunk by chunk."""
    header = reader.header
    count = 0
    with _damage_of(path):
        for chunk in reader.chunk_iterator(CHUNK):
            count += len(chunk)
            classes = np.asarray(chunk.classification, dtype=np.uint8)
            keep = ~np.isin(classes, NOISE_CLASSES) & ~np.asarray(chunk.withheld, dtype=bool)
            columns = [
                np.asarray(axis)[keep] * scale + offset
                for axis, scale, offset in zip((chunk.X, chunk.Y, chunk.Z), header.scales, header.offsets, strict=True)
            ]
            yield np.stack(columns, axis=1), classes[keep], int(len(keep) - keep.sum())
        if count < header.point_count:
            raise _truncated(path, header.point_count, count)


@contextlib.contextmanager
def _damage_of(path: Path) -> Iterator[None]:
    """Turn any error of laspy and its decoder into a CloudError that names the file."""
    try:
        yield
    except (CloudError, MemoryError):
        raise
    except BaseException as error:
        # a panic of the LAZ decoder, written in Rust, is not an Exception
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise CloudError(f"{path}: damaged or truncated LAS/LAZ ({reason}); copy or export the file again") from error


def _truncated(path: Path, promised: int, count: int) -> CloudError:
    return CloudError(
        f"{path}: truncated, the header promises {promised} points and the file holds {count}; "
        "copy or export the file again"
    )


def _check_sizes(stream: BinaryIO, size: int) -> None:
    """Check the sizes that laspy trusts; ValueError if one is impossible in a file of ``size`` bytes."""
    head = stream.read(_MAX_HEADER)
    stream.seek(0)
    if len(head) < _MIN_HEADER:
        raise ValueError("the header is cut off")
    head = head.ljust(_MAX_HEADER, b"\0")
    start, records = struct.unpack_from("<II", head, 96)
    extended = struct.unpack_from("<I", head, 243)[0] if head[25] >= 4 else 0
    if records * 54 + extended * 60 > size:
        raise ValueError("more variable length records than fit")
    if start > size:
        raise ValueError("the points begin behind the end")


def _check_points(path: Path, header: Any, stream: BinaryIO, size: int) -> None:
    """Check the sizes that the point decoder trusts: points, chunks, and the chunk table of LAZ."""
    start, points = header.offset_to_point_data, header.point_count
    if not header.are_points_compressed:
        stored = max(0, size - start) // header.point_format.size
        if stored < points:
            raise _truncated(path, points, stored)
        return
    if points > _POINTS_PER_BYTE * size + CHUNK:
        raise ValueError(f"{points} points cannot be in {size} bytes")
    compressor, per_chunk = struct.unpack_from("<H10xI", header.vlrs.get("LasZipVlr")[0].record_data)
    if compressor == _POINTWISE:
        raise CloudError(f"{path}: LAZ of LASzip 1.0, without chunks, is not read; write it again with a newer LASzip")
    if max(points, CHUNK) < per_chunk < _VARIABLE:  # the decoder allocates a chunk at once
        raise ValueError(f"{per_chunk} points per chunk")
    # the table's offset precedes the points, or is in the last 8 bytes of a streamed file
    stream.seek(start)
    table = int.from_bytes(stream.read(8), "little", signed=True)
    if table == -1 and size >= 8:
        stream.seek(-8, os.SEEK_END)
        table = int.from_bytes(stream.read(8), "little", signed=True)
    if not start + 8 <= table <= size - 8:
        raise ValueError("the chunk table is not in the file")
    stream.seek(table + 4)
    # a chunk has at least one point, and its first record is stored uncompressed
    if int.from_bytes(stream.read(4), "little") * 20 > size:
        raise ValueError("more chunks than fit")
    stream.seek(start)
