"""PLY files: ascii and binary in either byte order; before the vertices of a binary file no element may have lists."""

from __future__ import annotations

import io
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from coview_stream.clouds.cloud import Cloud, CloudBuilder
from coview_stream.errors import CloudError
from coview_stream.geometry.arrays import Reals

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_AXES = ("x", "y", "z")
_MAX_HEADER = 64 * 1024  # bytes


@dataclass
class _Element:
    """An element of the header: name, number of rows, and properties."""

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)  # name and type of the scalars
    has_list: bool = False


def read_ply(path: Path) -> Cloud:
    """Read x, y and z of the ``vertex`` element; everything else is skipped.

    Raises:
        CloudError: the header is wrong, there are no vertices with x, y and z, or data are missing.
    """
    content = path.read_bytes()
    order, elements, start = _parse_header(content, path)
    vertex = next((element for element in elements if element.name == "vertex"), None)
    if vertex is None:
        raise CloudError(f"{path}: PLY without a vertex element; export the file as a point cloud")
    names = [name for name, _ in vertex.properties]
    missing = [axis for axis in _AXES if axis not in names]
    if missing or vertex.has_list or len(set(names)) < len(names):
        fault = f"have no {', '.join(missing)}" if missing else "hold lists or a property twice"
        raise CloudError(f"{path}: PLY vertices {fault}; export the file as a plain point cloud")
    before = elements[: elements.index(vertex)]
    builder = CloudBuilder()
    if vertex.count:
        read = _ascii if order == "" else _binary
        builder.add(read(content, start, order, before, vertex, path))
    return builder.finish(os.fspath(path))


def _parse_header(content: bytes, path: Path) -> tuple[str, list[_Element], int]:
    order: str | None = None
    elements: list[_Element] = []
    start = 0
    while True:
        end = content.find(b"\n", start, _MAX_HEADER)
        if end < 0:
            raise CloudError(f"{path}: truncated PLY, the header has no end_header; copy or export it again")
        words = content[start:end].decode("ascii", "replace").split()
        start = end + 1
        try:
            match words:
                case ["end_header"]:
                    break
                case ["format", name, _]:
                    order = _ORDERS[name]
                case ["element", name, count]:
                    elements.append(_Element(name, int(count)))
                    if elements[-1].count < 0:
                        raise ValueError(count)
                case ["property", "list", *_]:
                    elements[-1].has_list = True
                case ["property", kind, name]:
                    elements[-1].properties.append((name.lower(), _TYPES[kind]))
                case [] | ["ply"] | ["comment" | "obj_info", *_]:
                    pass
                case _:
                    raise ValueError(" ".join(words))
        except (KeyError, ValueError, IndexError) as error:
            line = " ".join(words)[:80]
            raise CloudError(f"{path}: damaged PLY header at {line!r}; export the file again") from error
    if order is None:
        raise CloudError(f"{path}: PLY header has no format line; export the file again")
    return order, elements, start


def _truncated(path: Path, vertex: _Element, stored: int) -> CloudError:
    return CloudError(
        f"{path}: truncated PLY, the header promises {vertex.count} vertices, the file has {max(0, stored)}; "
        "copy or export it again"
    )


def _ascii(content: bytes, start: int, _: str, before: list[_Element], vertex: _Element, path: Path) -> Reals:
    stream = io.BytesIO(content[start:])
    for _row in range(sum(element.count for element in before)):
        if not stream.readline():
            raise _truncated(path, vertex, 0)
    names = [name for name, _ in vertex.properties]
    lines: list[bytes] = []
    for line in stream:
        if len(lines) == vertex.count:
            break
        if line.strip():
            lines.append(line)
    if len(lines) < vertex.count:
        raise _truncated(path, vertex, len(lines))
    try:
        rows = np.loadtxt(lines, dtype=np.float64, ndmin=2, comments=None, encoding="ascii")
    except (ValueError, UnicodeDecodeError) as error:
        reason = str(error).split(";")[0]
        raise CloudError(f"{path}: unreadable ascii PLY row ({reason}); copy or export it again") from error
    if rows.shape[1] != len(names):
        raise CloudError(
            f"{path}: PLY rows have {rows.shape[1]} numbers, the header names {len(names)}; export it again"
        )
    return rows[:, [names.index(axis) for axis in _AXES]]


def _binary(content: bytes, start: int, order: str, before: list[_Element], vertex: _Element, path: Path) -> Reals:
    for element in before:
        if element.has_list:
            raise CloudError(f"{path}: PLY with lists before its vertices ({element.name}); export it as a point cloud")
        start += element.count * sum(np.dtype(kind).itemsize for _, kind in element.properties)
    row = np.dtype([(name, order + kind) for name, kind in vertex.properties])
    stored = (len(content) - start) // row.itemsize
    if stored < vertex.count:
        raise _truncated(path, vertex, stored)
    rows = np.frombuffer(content, row, vertex.count, start)
    double = any(rows.dtype[axis].itemsize != 4 or rows.dtype[axis].kind != "f" for axis in _AXES)
    return np.stack([rows[axis].astype(np.float64 if double else np.float32) for axis in _AXES], axis=1)
