"""Points out of packed rows, and back: what PointCloud2 and foxglove.PointCloud have in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.errors import MessageError
from coview_stream.geometry import Points
from coview_stream.stream.codecs.beams import RING_NAMES, TIME_NAMES, rings_from, times_from
from coview_stream.stream.codecs.checks import check_points
from coview_stream.stream.messages import CloudMessage

MAX_FIELDS = 256
"""Fields of a point beyond which a message is taken for an attack; real ones have four to ten."""

_KNOWN = frozenset(("x", "y", "z", *TIME_NAMES, *RING_NAMES))

Field = tuple[str, str, int]
"""Name, NumPy type such as ``<f4``, and offset in bytes from the start of a point."""


@dataclass(frozen=True)
class Table:
    """``height`` rows of ``width`` points in a buffer; ``step`` and ``row_step`` bytes from one to the next."""

    data: memoryview | bytes | npt.NDArray[np.uint8]
    fields: tuple[Field, ...]
    step: int
    width: int
    height: int = 1
    row_step: int = 0

    def column(self, field: Field, count: int = 1) -> npt.NDArray[Any]:
        """(N, count) of ``count`` neighbouring values in every point; a view wherever strides can say it."""
        _, kind, offset = field
        strides = (self.row_step, self.step, np.dtype(kind).itemsize)
        shape = (self.height, self.width, count)
        cells: npt.NDArray[Any] = np.ndarray(shape, kind, self.data, offset, strides)
        return cells.reshape(-1, count)


def read_table(table: Table, stamp_ns: int) -> CloudMessage:
    """Cloud of a table; points are a view where they are packed float32 x y z. MessageError if it does not fit."""
    known = _known_fields(table)
    if not table.width * table.height:
        return CloudMessage(stamp_ns, np.zeros((0, 3), np.float32))
    _check_extent(table)
    with np.errstate(over="ignore", invalid="ignore"):  # beyond float32 is infinite; some NaN signal
        return _read(table, known, stamp_ns)


def _read(table: Table, known: dict[str, Field], stamp_ns: int) -> CloudMessage:
    points = _points(table, known)
    time = next((known[name] for name in TIME_NAMES if name in known), None)
    ring = next((known[name] for name in RING_NAMES if name in known), None)
    return CloudMessage(
        stamp_ns,
        points,
        times_from(table.column(time)[:, 0], points, stamp_ns) if time else None,
        rings_from(table.column(ring)[:, 0]) if ring else None,
    )


def _known_fields(table: Table) -> dict[str, Field]:
    known: dict[str, Field] = {}
    for field in table.fields:
        name, kind, offset = field
        if name in known:
            raise MessageError(f"field {name!r} occurs twice")
        if name in _KNOWN:
            if not 0 <= offset <= table.step - np.dtype(kind).itemsize:
                raise MessageError(f"field {name!r} at byte {offset} exceeds a point of {table.step} bytes")
            known[name] = field
    if missing := [name for name in "xyz" if name not in known]:
        raise MessageError(f"the cloud has no numeric field {missing[0]!r}; it needs x, y and z")
    return known


def _check_extent(table: Table) -> None:
    check_points(table.width * table.height)
    row = table.width * table.step
    if table.height > 1 and table.row_step < row:
        raise MessageError(f"a row of {row} bytes exceeds the row step of {table.row_step}")
    needed = (table.height - 1) * table.row_step + row
    if needed > len(table.data):
        raise MessageError(f"{len(table.data)} bytes of points where {needed} are announced: truncated")


def _points(table: Table, known: dict[str, Field]) -> Points:
    x, y, z = (known[name] for name in "xyz")
    if table.step == 12 and (x[1:], y[1:], z[1:]) == (("<f4", 0), ("<f4", 4), ("<f4", 8)):
        return np.ascontiguousarray(table.column(x, 3), dtype=np.float32)
    points = np.empty((table.width * table.height, 3), np.float32)
    for axis, field in enumerate((x, y, z)):  # seven times as fast as copying rows of three
        points[:, axis] = table.column(field)[:, 0]
    return points


def write_table(message: CloudMessage) -> Table:
    """Packed little-endian rows: x y z float32, ``time`` float32 and ``ring`` uint16 where the message has them."""
    columns: list[tuple[str, str, npt.NDArray[Any]]]
    columns = [(name, "<f4", message.points[:, axis]) for axis, name in enumerate("xyz")]
    if message.times is not None:
        columns.append(("time", "<f4", message.times))
    if message.rings is not None:
        columns.append(("ring", "<u2", message.rings))
    rows = np.empty(len(message.points), [(name, kind) for name, kind, _ in columns])
    fields: list[Field] = []
    offset = 0
    for name, kind, values in columns:
        rows[name] = values
        fields.append((name, kind, offset))
        offset += np.dtype(kind).itemsize
    return Table(rows.tobytes(), tuple(fields), offset, len(rows))
