"""PLY files: ascii and binary in either byte order, with the vertices anywhere among the elements."""

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
_MAX_LISTS = 8  # in one element; files have one or two, and each costs a pass over its bytes
_WINDOW = 1 << 18  # bytes examined together: 20 MB of temporaries


@dataclass
class _Element:
    """An element of the header: name, number of rows and their properties."""

    name: str
    count: int
    # (name, type) of a scalar; (name, type of the length, type of the items) of a list
    properties: list[tuple[str, ...]] = field(default_factory=list)

    @property
    def has_list(self) -> bool:
        return any(len(prop) == 3 for prop in self.properties)

    @property
    def least_bytes(self) -> int:
        """Bytes of a binary row with empty lists."""
        return sum(np.dtype(prop[1]).itemsize for prop in self.properties)

    def row(self, order: str) -> np.dtype[np.void]:
        return np.dtype([(prop[0], order + prop[1]) for prop in self.properties])


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
    names = [prop[0] for prop in vertex.properties]
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
                    elements.append(_Element(name, _natural(count)))
                case ["property", "list", length, item, name]:
                    _add_list(elements[-1], name, _TYPES[length], _TYPES[item])
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


def _add_list(element: _Element, name: str, length: str, item: str) -> None:
    if length.startswith("f"):
        raise ValueError("the length of a list is an integer")
    element.properties.append((name, length, item))
    if sum(len(prop) == 3 for prop in element.properties) > _MAX_LISTS:
        raise ValueError(f"more than {_MAX_LISTS} lists")


def _natural(text: str) -> int:
    value = int(text)
    if value < 0:
        raise ValueError(text)
    return value


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
    names = [prop[0] for prop in vertex.properties]
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
        start = _skip(content, start, order, element, path)
    row = vertex.row(order)
    stored = (len(content) - start) // row.itemsize
    if stored < vertex.count:
        raise _truncated(path, vertex, stored)
    rows = np.frombuffer(content, row, vertex.count, start)
    double = any(rows.dtype[axis].itemsize != 4 or rows.dtype[axis].kind != "f" for axis in _AXES)
    return np.stack([rows[axis].astype(np.float64 if double else np.float32) for axis in _AXES], axis=1)


def _skip(content: bytes, start: int, order: str, element: _Element, path: Path) -> int:
    """Return the offset behind an element's rows, in time linear in the file's size whatever the header claims.

    Raises:
        CloudError: a list of negative length, or fewer bytes than the rows need.
    """
    end = start + element.count * element.least_bytes
    if end > len(content):
        raise CloudError(
            f"{path}: truncated PLY, {element.count} rows of {element.name} do not fit into it; copy or export it again"
        )
    if not element.has_list or not element.count:
        return end
    stride = _after_row(content, start, order, element, path) - start
    if _all_like_the_first(content, start, stride, order, element):
        return start + element.count * stride
    return _walk(content, start, order, element, path)


def _after_row(content: bytes, start: int, order: str, element: _Element, path: Path) -> int:
    for prop in element.properties:
        kind = np.dtype(order + prop[1])
        if len(prop) == 3:
            if start + kind.itemsize > len(content):
                raise _bad_list(path, element)
            length = int(np.frombuffer(content, kind, 1, start)[0])
            if length < 0:
                raise _bad_list(path, element)
            start += length * np.dtype(prop[2]).itemsize
        start += kind.itemsize
    if start > len(content):
        raise _bad_list(path, element)
    return start


def _all_like_the_first(content: bytes, start: int, stride: int, order: str, element: _Element) -> bool:
    """Return whether all rows have lists of the same lengths as the first."""
    if start + element.count * stride > len(content):
        return False
    for prop in element.properties:
        kind = np.dtype(order + prop[1])
        if len(prop) == 3:
            lengths = np.ndarray(element.count, kind, content, start, stride)
            if not (lengths == lengths[0]).all():
                return False
            start += int(lengths[0]) * np.dtype(prop[2]).itemsize
        start += kind.itemsize
    return True


def _walk(content: bytes, start: int, order: str, element: _Element, path: Path) -> int:
    """Follow rows of different lengths; row ends are computed for every byte of a window at once."""
    left, size = element.count, len(content)
    octets = np.frombuffer(content, np.uint8)
    while left:
        window = np.arange(start, min(start + _WINDOW, size))
        if not len(window):
            raise _bad_list(path, element)
        position = window.copy()
        wrong = np.zeros(len(window), bool)
        for prop in element.properties:
            kind = np.dtype(order + prop[1])
            if len(prop) == 3:
                wrong |= position > size - kind.itemsize
                position[wrong] = 0
                raw = octets[position[:, None] + np.arange(kind.itemsize)]
                lengths = raw.view(kind)[:, 0].astype(np.int64)
                wrong |= lengths < 0
                position += lengths * np.dtype(prop[2]).itemsize
            position += kind.itemsize
        position[wrong | (position > size)] = -1
        following, at, begin = position.tolist(), 0, start
        while left and 0 <= at < len(following):
            at = following[at] - begin
            left -= 1
        start = begin + at
        if start < 0:
            raise _bad_list(path, element)
    return start


def _bad_list(path: Path, element: _Element) -> CloudError:
    return CloudError(
        f"{path}: damaged PLY, a list of {element.name} has a negative length or reaches beyond the file; "
        "copy or export it again"
    )
