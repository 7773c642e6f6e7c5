"""Packed rows of point fields, as in PointCloud2 and foxglove.PointCloud: reading and writing.

Lidar drivers add fields for each point's time and beam. The type and size of a time field decide its meaning:

================================  =========  ==================================================
name and driver                   type       meaning
================================  =========  ==================================================
``time`` (Velodyne)               float32    seconds after the stamp
``t`` (Ouster)                    uint32     nanoseconds after the stamp
``offset_time`` (Livox)           uint32     nanoseconds after the stamp
``timestamp`` (Hesai, RoboSense)  float64    seconds on the stamp's clock
``timestamp`` (Livox driver 2)    float64    nanoseconds on the stamp's clock
``time_offset``, others above     float64    seconds after the stamp, if on no clock near the stamp
``ring``, ``line``, ``channel``   any        number of the beam; whole floats too
================================  =========  ==================================================

Any time name may have any of these types (int32 as uint32). Times more than 1 s from the stamp, or spanning more than
1 s, are dropped: no times are better than wrong ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.errors import MessageError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points
from coview_stream.messages.types import CloudMessage
from coview_stream.messages.validation import MAX_POINTS, OversizedError

TIME_NAMES = ("time", "t", "time_offset", "offset_time", "timestamp")
RING_NAMES = ("ring", "line", "channel")
MAX_FIELDS = 256
"""A message with more fields is refused as hostile; real ones have four to ten."""

_KNOWN = frozenset(("x", "y", "z", *TIME_NAMES, *RING_NAMES))
_MAX_SWEEP = 1.0  # seconds; no lidar frame lasts longer

Field = tuple[str, str, int]
"""Name, NumPy type such as ``<f4``, and offset in bytes from the start of a point."""


@dataclass(frozen=True)
class Table:
    """Points in a buffer, as rows of fields."""

    data: memoryview | bytes | npt.NDArray[np.uint8]
    fields: tuple[Field, ...]  # of each point
    step: int  # bytes from one point to the next
    width: int  # points in a row
    height: int = 1  # rows
    row_step: int = 0  # bytes from one row to the next; unused for a single row

    def column(self, field: Field, count: int = 1) -> npt.NDArray[Any]:
        """Return (N, count) adjacent values of every point; a view where strides allow it."""
        _, kind, offset = field
        strides = (self.row_step, self.step, np.dtype(kind).itemsize)
        shape = (self.height, self.width, count)
        cells: npt.NDArray[Any] = np.ndarray(shape, kind, self.data, offset, strides)
        return cells.reshape(-1, count)


def read_table(table: Table, stamp_ns: int) -> CloudMessage:
    """Read the cloud in a table; packed float32 x y z remain a view. MessageError if fields and data disagree."""
    known = _known_fields(table)
    count = table.width * table.height
    if not count:
        return CloudMessage(stamp_ns, np.zeros((0, 3), np.float32))
    if count > MAX_POINTS:
        raise OversizedError(f"a cloud of {count} points; at most {MAX_POINTS} are taken: thin it out")
    row = table.width * table.step
    if table.height > 1 and table.row_step < row:
        raise MessageError(f"a row of {row} bytes exceeds the row step of {table.row_step}")
    needed = (table.height - 1) * table.row_step + row
    if needed > len(table.data):
        raise MessageError(f"{len(table.data)} bytes of points where {needed} are announced: truncated")
    x, y, z = (known[name] for name in "xyz")
    time = next((known[name] for name in TIME_NAMES if name in known), None)
    ring = next((known[name] for name in RING_NAMES if name in known), None)
    with np.errstate(over="ignore", invalid="ignore"):  # overflow becomes infinity; some NaN signal
        if table.step == 12 and (x[1:], y[1:], z[1:]) == (("<f4", 0), ("<f4", 4), ("<f4", 8)):
            points = np.ascontiguousarray(table.column(x, 3), dtype=np.float32)
        else:
            points = np.empty((count, 3), np.float32)
            for axis, field in enumerate((x, y, z)):  # seven times as fast as copying rows of three
                points[:, axis] = table.column(field)[:, 0]
        times = _times_from(table.column(time)[:, 0], points, stamp_ns) if time else None
        return CloudMessage(stamp_ns, points, times, _rings_from(table.column(ring)[:, 0]) if ring else None)


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


def write_table(message: CloudMessage) -> Table:
    """Pack little-endian rows: x y z float32, and ``time`` float32 and ``ring`` uint16 if the message has them."""
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


def _times_from(values: npt.NDArray[Any], points: Points, stamp_ns: int) -> Floats | None:
    """Return (N,) seconds after ``stamp_ns``, 0 where a point is not finite; None if implausible."""
    measured = np.isfinite(points[:, 0] + points[:, 1] + points[:, 2])  # many times faster than all(axis=1)
    if not measured.any():
        return None
    seconds = values.astype(np.float64)
    if values.dtype.kind in "ui":  # meanings that the type allows, likeliest first
        meanings = [1e-9 * seconds] if values.dtype.itemsize == 4 else []
    elif values.dtype.itemsize == 4:
        meanings = [seconds]
    else:
        meanings = [seconds - 1e-9 * stamp_ns, 1e-9 * (seconds - stamp_ns), seconds]
    for candidate in meanings:
        valid = candidate[measured]
        low, high = float(valid.min()), float(valid.max())  # NaN fails the comparisons below
        if low >= -_MAX_SWEEP and high <= _MAX_SWEEP and high - low <= _MAX_SWEEP:
            return np.where(measured, candidate, 0.0)
    return None


def _rings_from(values: npt.NDArray[Any]) -> npt.NDArray[np.uint16] | None:
    """Return (N,) beam numbers; None if not whole or outside the uint16 range."""
    if values.dtype.kind == "f" and not np.array_equal(values, np.trunc(values)):  # false for NaN too
        return None
    if len(values) and (values.min() < 0 or values.max() > np.iinfo(np.uint16).max):
        return None
    return values.astype(np.uint16)
