"""PCD files: ascii, binary and binary_compressed, with fields in any order and of any type."""

from __future__ import annotations

import io
import os
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from coview_stream.clouds.cloud import Cloud, CloudBuilder
from coview_stream.errors import CloudError
from coview_stream.geometry.arrays import Reals

_KINDS = {"F": "f", "I": "i", "U": "u"}
_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_AXES = ("x", "y", "z")
_MAX_HEADER = 64 * 1024  # bytes
_MAX_ROW = 1 << 20  # bytes of a point; a hundred times the longest descriptors
_LZF_RATIO = 88  # LZF's maximum: a back reference of 3 bytes yields up to 264


@dataclass(frozen=True)
class _Header:
    """Header of a PCD file: type and count of each field, the field of each axis, and the number of points."""

    types: tuple[np.dtype[np.generic], ...]
    counts: tuple[int, ...]
    axes: tuple[int, int, int]
    points: int
    encoding: str
    data_start: int

    @property
    def row(self) -> np.dtype[np.void]:
        """Type of a point; fields are named by position because padding fields share the name ``_``."""
        pairs = zip(self.types, self.counts, strict=True)
        return np.dtype([(f"f{i}", kind, (count,)) for i, (kind, count) in enumerate(pairs)])


def read_pcd(path: Path) -> Cloud:
    """Read x, y and z of a PCD file; other fields and the viewpoint are ignored.

    Raises:
        CloudError: the header is wrong, x, y or z is missing, or there is less data than the header states.
    """
    content = path.read_bytes()
    header = _parse_header(content, path)
    builder = CloudBuilder()
    if header.encoding == "binary":
        stored = (len(content) - header.data_start) // header.row.itemsize
        if stored < header.points:
            raise _truncated(path, header, stored)
        rows = np.frombuffer(content, header.row, header.points, header.data_start)
        builder.add(_stack([rows[f"f{field}"][:, 0] for field in header.axes]))
    else:
        builder.add((_ascii if header.encoding == "ascii" else _compressed)(content, header, path))
    return builder.finish(os.fspath(path))


def _parse_header(content: bytes, path: Path) -> _Header:
    entries: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in entries:
        end = content.find(b"\n", start, _MAX_HEADER)
        if end < 0:
            raise CloudError(f"{path}: truncated PCD, the header has no DATA line; copy or export it again")
        words = content[start:end].decode("ascii", "replace").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    try:
        return _header_from(entries, start)
    except (KeyError, ValueError, IndexError) as error:
        reason = f"no {error.args[0]} line" if isinstance(error, KeyError) else str(error)
        raise CloudError(f"{path}: damaged PCD header ({reason}); export the file again") from error


def _header_from(entries: dict[str, list[str]], data_start: int) -> _Header:
    fields = tuple(name.lower() for name in entries["FIELDS"])
    sizes = [int(word) for word in entries["SIZE"]]
    kinds = [word.upper() for word in entries["TYPE"]]
    counts = [int(word) for word in entries.get("COUNT", ["1"] * len(fields))]
    if not len(fields) == len(sizes) == len(kinds) == len(counts):
        raise ValueError("FIELDS, SIZE, TYPE and COUNT have different lengths")
    if not all(size in _SIZES.get(kind, ()) for kind, size in zip(kinds, sizes, strict=True)):
        raise ValueError("unknown combination of TYPE and SIZE")
    if min(counts) < 0:
        raise ValueError("COUNT is negative")
    for axis in _AXES:
        if axis not in fields or counts[fields.index(axis)] != 1:
            raise ValueError(f"no field {axis} of count 1 among {' '.join(fields)}")
    if sum(size * count for size, count in zip(sizes, counts, strict=True)) > _MAX_ROW:
        raise ValueError(f"COUNT and SIZE make points of more than {_MAX_ROW} bytes")
    if "POINTS" in entries:
        points = int(entries["POINTS"][0])
    else:
        points = int(entries["WIDTH"][0]) * int(entries.get("HEIGHT", ["1"])[0])
    encoding = entries["DATA"][0].lower() if entries["DATA"] else ""
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"unknown encoding {encoding!r}")
    if points < 0:
        raise ValueError("POINTS is negative")
    types = tuple(np.dtype(f"<{_KINDS[kind]}{size}") for kind, size in zip(kinds, sizes, strict=True))
    x, y, z = (fields.index(axis) for axis in _AXES)
    return _Header(types, tuple(counts), (x, y, z), points, encoding, data_start)


def _truncated(path: Path, header: _Header, stored: int) -> CloudError:
    return CloudError(
        f"{path}: truncated PCD, the header promises {header.points} points and the file holds {stored}; "
        "copy or export it again"
    )


def _stack(columns: list[npt.NDArray[np.generic]]) -> Reals:
    """Stack to (N, 3), in float32 if all columns are, otherwise in float64."""
    dtype = np.float32 if all(column.dtype == np.float32 for column in columns) else np.float64
    return np.stack([column.astype(dtype, copy=False) for column in columns], axis=1)


def _ascii(content: bytes, header: _Header, path: Path) -> Reals:
    columns = [sum(header.counts[:field]) for field in header.axes]
    body = content[header.data_start :]
    if header.points == 0:
        return np.zeros((0, 3))
    # the shortest row has three digits, two blanks and a line end; this also bounds loadtxt's allocation
    if header.points > len(body) // 6 + 1 or not body.strip():
        raise _truncated(path, header, body.count(b"\n"))
    try:
        rows = np.loadtxt(
            io.BytesIO(body), dtype=np.float64, usecols=columns, ndmin=2, max_rows=header.points, encoding="ascii"
        )
    except (ValueError, UnicodeDecodeError, IndexError) as error:
        reason = str(error).split(";")[0]
        raise CloudError(f"{path}: unreadable ascii PCD row ({reason}); copy or export it again") from error
    if len(rows) < header.points:
        raise _truncated(path, header, len(rows))
    return rows


def _compressed(content: bytes, header: _Header, path: Path) -> Reals:
    """Unpack a body: one LZF block with all points of the first field, then of the next."""
    start = header.data_start + 8
    if len(content) < start:
        raise _truncated(path, header, 0)
    packed, unpacked = struct.unpack_from("<II", content, header.data_start)
    if len(content) < start + packed:
        raise CloudError(
            f"{path}: truncated PCD, {len(content) - start} of {packed} compressed bytes; copy or export it again"
        )
    if unpacked < header.points * header.row.itemsize:
        raise _truncated(path, header, unpacked // max(1, header.row.itemsize))
    if unpacked > packed * _LZF_RATIO:
        raise CloudError(
            f"{path}: damaged compressed PCD, {packed} bytes cannot unpack to {unpacked}; copy or export it again"
        )
    try:
        body = lzf_decompress(content[start : start + packed], unpacked)
    except ValueError as error:
        raise CloudError(f"{path}: damaged compressed PCD ({error}); copy or export it again") from error
    lengths = [t.itemsize * c * header.points for t, c in zip(header.types, header.counts, strict=True)]
    starts = np.concatenate([[0], np.cumsum(lengths)])
    return _stack([np.frombuffer(body, header.types[i], header.points, int(starts[i])) for i in header.axes])


def lzf_decompress(packed: bytes, size: int) -> bytearray:
    """Decompress one LZF block; ValueError if it does not decode to exactly ``size`` bytes.

    A control byte below 32 starts a literal run; others are back references with a 3-bit length (7: one more
    length byte follows) and a 13-bit distance.
    """
    out = bytearray()
    at, end = 0, len(packed)
    try:
        while at < end and len(out) <= size:
            control = packed[at]
            at += 1
            if control < 32:
                out += packed[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += packed[at]
                at += 1
            distance = ((control & 31) << 8 | packed[at]) + 1
            at += 1
            length += 2
            begin = len(out) - distance
            if begin < 0:
                raise ValueError("back reference before the start")
            piece = out[begin : begin + length]
            # a reference may overlap its own output: the pattern then repeats
            out += piece if distance >= length else (piece * (length // distance + 1))[:length]
    except IndexError as error:
        raise ValueError("compressed block ends early") from error
    if len(out) != size:
        raise ValueError(f"block decodes to {len(out)} bytes instead of {size}")
    return out
