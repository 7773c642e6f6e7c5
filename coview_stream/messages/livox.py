"""Livox clouds in CDR: ``CustomMsg`` of livox_ros_driver, livox_ros_driver2 and livox_interfaces.

    header, uint64 timebase, uint32 point_num, uint8 lidar_id, uint8[3] rsvd, CustomPoint[] points
    CustomPoint: uint32 offset_time (ns after the stamp), float32 x y z, uint8 reflectivity tag line

The points are read as a table: 20,000 objects a frame would take longer than the frame.
"""

from __future__ import annotations

import struct

import numpy as np

from coview_stream.errors import MessageError
from coview_stream.messages.point_fields import Table, read_table
from coview_stream.messages.types import CloudMessage
from coview_stream.messages.validation import stamp_join

TYPES = ("livox_ros_driver2/msg/CustomMsg", "livox_ros_driver/msg/CustomMsg", "livox_interfaces/msg/CustomMsg")

_FIELDS = (("offset_time", "u4", 0), ("x", "f4", 4), ("y", "f4", 8), ("z", "f4", 12), ("line", "u1", 18))
_POINT, _STEP = 19, 20  # bytes of a point, and from one to the next in CDR
_HEAD = 20  # bytes from the time base to the first point


def _layout(payload: bytes) -> tuple[str, int, int] | None:
    """Return byte order, offset of the first point and number of points; None for another message."""
    if payload[:2] not in (b"\0\0", b"\0\1") or len(payload) < 16:
        return None
    order = "<" if payload[1] else ">"
    (name,) = struct.unpack_from(order + "I", payload, 12)
    base = 4 + (12 + name + 7 & ~7)
    if base + _HEAD > len(payload):
        return None
    point_num, count = (struct.unpack_from(order + "I", payload, base + at)[0] for at in (8, 16))
    size = base + _HEAD + max(_STEP * count - 1, 0)
    return (order, base + _HEAD, count) if count == point_num and 0 <= len(payload) - size < 4 else None


def is_custom(payload: bytes) -> bool:
    """Whether a CDR message is a CustomMsg: its counts agree with each other and with its size."""
    return _layout(payload) is not None


def decode(payload: bytes) -> CloudMessage:
    """Read a cloud; MessageError if it is not one."""
    layout = _layout(payload)
    if layout is None:
        raise MessageError(f"not a {TYPES[0]} in CDR: truncated, or another message")
    order, begin, count = layout
    sec, nanosec = struct.unpack_from(order + "iI", payload, 4)
    fields = tuple((name, order + kind, offset) for name, kind, offset in _FIELDS)
    rows = np.frombuffer(payload[begin:] + bytes(1), np.uint8)  # the last point lacks the padding
    return read_table(Table(rows, fields, _STEP, count), stamp_join(sec, nanosec))


def cdr_from_ros1(data: bytes) -> bytes:
    """Convert a ROS 1 CustomMsg to CDR, little-endian; MessageError if it is truncated."""
    try:
        _, sec, nanosec, length = struct.unpack_from("<4I", data)
        at = 16 + length
        base, count = data[at : at + 16], *struct.unpack_from("<I", data, at + 16)
        points = np.frombuffer(data, np.uint8, _POINT * count, at + _HEAD).reshape(count, _POINT)
    except (struct.error, ValueError) as error:
        raise MessageError(f"not a {TYPES[1]} of ROS 1: truncated") from error
    head = struct.pack("<3I", sec, nanosec, length + 1) + data[16:at] + b"\0"
    rows = np.pad(points, ((0, 0), (0, _STEP - _POINT))).tobytes()[:-1]
    return b"\0\1\0\0" + head.ljust(len(head) + 7 & ~7, b"\0") + base + struct.pack("<I", count) + rows
