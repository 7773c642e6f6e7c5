"""LAZ files of LASzip 1.0, which have no chunks, as files with one chunk: the decoder knows only those."""

from __future__ import annotations

import io
import struct
from pathlib import Path

from coview_stream.clouds.las_header import read_las_header

POINTWISE = 1
"""LASzip's number of the compressor without chunks."""

_CHUNKED = 2
_USER, _RECORD = b"laszip encoded", 22204


def is_pointwise(path: Path) -> bool:
    """Tell whether a LAZ file has no chunks; ValueError where its header is cut off."""
    return read_las_header(path).compressor == POINTWISE


def with_one_chunk(path: Path) -> io.BytesIO:
    """Return the content of a file without chunks, its points as one chunk; ValueError where its header is damaged."""
    import lazrs

    content = bytearray(path.read_bytes())
    points = read_las_header(path).points
    start = struct.unpack_from("<I", content, 96)[0]
    record = content.find(_USER.ljust(16, b"\0") + struct.pack("<H", _RECORD), 0, start)
    if record < 0 or record + 52 + 16 > start or not 0 < points < 0xFFFFFFFF:
        raise ValueError("its record of the compressor is damaged")
    at = record + 52  # behind the rest of the record's head
    struct.pack_into("<H", content, at, _CHUNKED)
    struct.pack_into("<I", content, at + 12, points)  # points per chunk
    compressor = lazrs.LazVlr(bytes(content[at : record + 52 + _length(content, record)]))
    size = len(content) - start
    content[start:start] = struct.pack("<q", len(content) + 8)  # where the table of chunks begins
    whole = io.BytesIO(bytes(content))
    whole.seek(0, io.SEEK_END)
    lazrs.write_chunk_table(whole, [(points, size)], compressor)
    whole.seek(0)
    return whole


def _length(content: bytearray, record: int) -> int:
    return int(struct.unpack_from("<H", content, record + 18)[0])
