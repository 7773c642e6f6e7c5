"""A first look at a LAS header: counts that a damaged file must not make the decoder believe.

laspy reads on for minutes where the number of records is wrong, and the LAZ decoder aborts the whole process
where the number of chunks makes it ask for more memory than there is.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO

_SHORTEST, _LONGEST = 227, 375
_COMPRESSED = 0x80


def impossible_header(path: Path) -> str | None:
    """Say what is impossible in the header of a LAS or LAZ file; None if nothing is."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        header = stream.read(_LONGEST)
        if len(header) < _SHORTEST:
            return "the header is cut off"
        records = _unsigned(header[100:104])
        extended = _unsigned(header[243:247]) if header[25] >= 4 else 0
        if records * 54 + extended * 60 > size:
            return "more variable length records than fit"
        start = _unsigned(header[96:100])
        if start > size:
            return "the points begin behind the end"
        return _impossible_chunks(stream, start, size) if header[104] & _COMPRESSED else None


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
