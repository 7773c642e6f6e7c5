"""Headers of LAS and LAZ files, read without a decoder: extent, number of points, reference system, compressor."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from coview_stream.geometry.arrays import Floats

_MIN_SIZE, _MAX_SIZE = 227, 375  # bytes
_COMPRESSED = 0x80
_MAX_RECORDS = 10_000  # set by hand; files have a handful
_MAX_RECORD = 1 << 20  # bytes of a record that is read; a reference system's text is the longest
_WKT, _GEO_KEYS, _LASZIP = 2112, 34735, 22204


@dataclass(frozen=True, eq=False)
class LasHeader:
    """What a LAS or LAZ file says of itself.

    Attributes:
        points: how many it holds.
        start: of the first, bytes from the beginning.
        record_length: bytes of a point that is not compressed.
        low, high: (3,) float64 corners of their extent, in the file's units.
        wkt: text of the reference system; empty if there is none.
        geo_keys: GeoTIFF keys whose values are numbers, by key.
        compressor: LASzip's: None not compressed, 1 the one of LASzip 1.0, 2 and 3 those with chunks.
    """

    points: int
    start: int
    record_length: int
    low: Floats
    high: Floats
    wkt: str = ""
    geo_keys: dict[int, int] = field(default_factory=dict)
    compressor: int | None = None


def read_las_header(path: Path) -> LasHeader:
    """Read a header; ValueError where it is cut off."""
    with path.open("rb") as stream:
        head = stream.read(_MAX_SIZE)
        if len(head) < _MIN_SIZE or head[:4] != b"LASF":
            raise ValueError("the header is cut off")
        head = head.ljust(_MAX_SIZE, b"\0")
        size, start, records = struct.unpack_from("<HII", head, 94)
        length = struct.unpack_from("<H", head, 105)[0]
        points = struct.unpack_from("<I", head, 107)[0]
        extent = np.array(struct.unpack_from("<6d", head, 179)).reshape(3, 2)
        extended = (0, 0)
        if head[25] >= 4:
            extended = struct.unpack_from("<QI", head, 235)
            points = struct.unpack_from("<Q", head, 247)[0]
        found = _records(stream, size, records, extended_form=False)
        found |= _records(stream, extended[0], extended[1], extended_form=True)
    compressor = None
    if head[104] & _COMPRESSED:
        laszip = found.get(_LASZIP, b"")
        compressor = struct.unpack_from("<H", laszip)[0] if len(laszip) >= 2 else 0
    wkt = found.get(_WKT, b"").decode("utf-8", "replace").strip("\0 \r\n\t")
    return LasHeader(
        points, start, length, extent[:, 1], extent[:, 0], wkt, _geo_keys(found.get(_GEO_KEYS, b"")), compressor
    )


def _records(stream: BinaryIO, start: int, count: int, extended_form: bool) -> dict[int, bytes]:
    """Read the variable length records that are of use, by their identifier."""
    found: dict[int, bytes] = {}
    size = 60 if extended_form else 54
    stream.seek(min(start, 1 << 62))
    for _ in range(min(count, _MAX_RECORDS)):
        head = stream.read(size)
        if len(head) < size:
            break
        user = head[2:18].rstrip(b"\0")
        identifier, length = struct.unpack_from("<HQ" if extended_form else "<HH", head, 18)
        end = stream.tell() + length
        wanted = (user, identifier) in ((b"LASF_Projection", _WKT), (b"LASF_Projection", _GEO_KEYS)) or (
            user == b"laszip encoded" and identifier == _LASZIP
        )
        if wanted and length <= _MAX_RECORD:
            found.setdefault(identifier, stream.read(length))
        if end > 1 << 62:
            break
        stream.seek(end)
    return found


def _geo_keys(raw: bytes) -> dict[int, int]:
    values = np.frombuffer(raw[: len(raw) // 2 * 2], "<u2").tolist()
    keys = {}
    for at in range(4, len(values) - 3, 4):
        key, location, _, value = values[at : at + 4]
        if location == 0:  # the value itself; others are places in records of doubles or of text
            keys[key] = value
    return keys
