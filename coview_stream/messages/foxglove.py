"""Foxglove's protobuf schemas: PointCloud, PoseInFrame, FrameTransform and LocationFix.

Our own parser of the wire format splits the top level of a message and checks every size. The schema classes would
copy a cloud's data once more, and build an object for each of the millions of empty fields that a hostile payload can
announce.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from coview_stream.errors import MessageError, require_library
from coview_stream.geometry.transforms import Pose, pose_to_tum, transform
from coview_stream.messages.point_fields import MAX_FIELDS, Table, read_table, write_table
from coview_stream.messages.types import CloudMessage, Encoded, LocationMessage, OdometryMessage, PoseMessage, Sample
from coview_stream.messages.validation import bare_pose, checked_pose, stamp_join, stamp_split

_ENCODING = "application/protobuf;foxglove."
_LIBRARY = "foxglove-schemas-protobuf>=0.3"
_KINDS = {1: "<u1", 2: "<i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<f4", 8: "<f8"}
_NUMBERS = {kind: number for number, kind in _KINDS.items()}
_DATA = 6  # number of PointCloud.data
_ROTATION = 5  # number of FrameTransform.rotation; PoseInFrame has fewer fields
_LENGTH, _FIXED = 2, {1: 8, 5: 4}  # wire types: with a length, and of fixed size


class Entry(NamedTuple):
    """One field on the wire; offsets are in bytes from the start of the message."""

    number: int
    sized: bool  # a length precedes the value
    start: int  # of the tag
    value: int  # after the length
    end: int


def wire_entries(payload: bytes | memoryview, limit: int) -> list[Entry]:
    """List the top-level fields in order; MessageError if they overrun the payload or exceed ``limit``."""
    fields: list[Entry] = []
    position = 0
    while position < len(payload):
        start = position
        tag, position = _varint(payload, position)
        kind = tag & 7
        value = position
        if kind == 0:
            _, position = _varint(payload, position)
        elif kind == _LENGTH:
            length, value = _varint(payload, position)
            position = value + length
        elif kind in _FIXED:
            position += _FIXED[kind]
        else:
            raise MessageError("the payload is not a protobuf message")
        if position > len(payload) or tag < 8:
            raise MessageError("the protobuf message is truncated or malformed")
        fields.append(Entry(tag >> 3, kind == _LENGTH, start, value, position))
        if len(fields) > limit:
            raise MessageError(f"the protobuf message has more than {limit} fields")
    return fields


def _varint(payload: bytes | memoryview, position: int) -> tuple[int, int]:
    value = 0
    for index, byte in enumerate(payload[position : position + 10]):
        value |= (byte & 127) << 7 * index
        if byte < 128:
            return value, position + index + 1
    raise MessageError("the protobuf message is truncated or malformed")


def split_field(payload: bytes | memoryview, number: int, limit: int) -> tuple[bytes, memoryview]:
    """Return a message without the sized field ``number``, and a view of that field's last value."""
    view = memoryview(payload)
    rest: list[memoryview] = []
    value = view[:0]
    for entry in wire_entries(view, limit):
        if entry.number == number and entry.sized:
            value = view[entry.value : entry.end]
        else:
            rest.append(view[entry.start : entry.end])
    return b"".join(rest), value


def sized_field(number: int, value: bytes) -> bytes:
    """Encode a field of bytes or a nested message."""
    return _packed(number << 3 | _LENGTH) + _packed(len(value)) + value


def _packed(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    out.append(value)
    return bytes(out)


def wire_timestamp(seconds: int, nanos: int) -> bytes:
    """Encode a google.protobuf.Timestamp; varints have 64 bits, negative values in two's complement."""
    return b"\x08" + _packed(seconds % 2**64) + b"\x10" + _packed(nanos)


@lru_cache(maxsize=1)
def schemas() -> Any:
    """Import the schema classes on first use, in about 50 ms."""
    require_library("google.protobuf.message", "protobuf>=5", "Foxglove messages")
    names, package = ("FrameTransform", "PointCloud", "PoseInFrame"), "foxglove_schemas_protobuf"
    modules = [require_library(f"{package}.{name}_pb2", _LIBRARY, "Foxglove messages") for name in names]
    return SimpleNamespace(**{name: getattr(module, name) for name, module in zip(names, modules, strict=True)})


def _parse(schema: Any, payload: bytes) -> Any:
    from google.protobuf.message import DecodeError

    try:
        return schema.FromString(payload)
    except (DecodeError, ValueError) as error:
        raise MessageError(f"not a {schema.DESCRIPTOR.full_name}: {str(error)[:80]}") from error


def _stamp(message: Any) -> int:
    if not message.HasField("timestamp"):
        raise MessageError(f"the {message.DESCRIPTOR.full_name} has no timestamp")
    return stamp_join(message.timestamp.seconds, message.timestamp.nanos)


def _pose(p: Any, q: Any) -> Pose:
    return checked_pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def read_cloud(payload: bytes | memoryview) -> CloudMessage:
    """Read a PointCloud and apply its ``pose``, if set; packed points without a pose remain a view."""
    head, data = split_field(payload, _DATA, MAX_FIELDS)
    cloud = _parse(schemas().PointCloud, head)
    fields = tuple((f.name, _KINDS[f.type], f.offset) for f in cloud.fields if f.type in _KINDS)
    step = cloud.point_stride
    if step == 0 or len(data) % step:
        raise MessageError(f"{len(data)} bytes of points are not a whole number of rows of {step} bytes")
    message = read_table(Table(data, fields, step, len(data) // step), _stamp(cloud))
    if not cloud.HasField("pose") or not cloud.pose.ByteSize():
        return message
    T = _pose(cloud.pose.position, cloud.pose.orientation)
    if np.array_equal(T, np.eye(4)):
        return message
    with np.errstate(over="ignore", invalid="ignore"):  # points at infinity
        return replace(message, points=transform(T, message.points))


def read_pose(payload: bytes | memoryview) -> tuple[int, Pose, str]:
    """Read stamp, pose and parent frame of a PoseInFrame or a FrameTransform, distinguished by their fields."""
    numbers = {entry.number for entry in wire_entries(payload, MAX_FIELDS)}
    if _ROTATION in numbers:
        moved = _parse(schemas().FrameTransform, bytes(payload))
        return _stamp(moved), _pose(moved.translation, moved.rotation), moved.parent_frame_id
    placed = _parse(schemas().PoseInFrame, bytes(payload))
    return _stamp(placed), _pose(placed.pose.position, placed.pose.orientation), placed.frame_id


def decode_cloud(sample: Sample) -> CloudMessage:
    """Read a foxglove.PointCloud."""
    return read_cloud(sample.payload)


def decode_odometry(sample: Sample) -> OdometryMessage:
    """Read a foxglove.PoseInFrame or foxglove.FrameTransform."""
    stamp_ns, T, _ = read_pose(sample.payload)
    return OdometryMessage(stamp_ns, T)


def decode_pose(sample: Sample) -> PoseMessage:
    """Read a PoseInFrame or FrameTransform; fields that the schema lacks are NaN or empty."""
    return bare_pose(*read_pose(sample.payload))


def write_cloud(message: CloudMessage, frame_id: str = "base_link") -> bytes:
    """Write a PointCloud without a pose: the points are already in the body frame."""
    table = write_table(message)
    cloud = schemas().PointCloud(frame_id=frame_id, point_stride=table.step)
    cloud.timestamp.seconds, cloud.timestamp.nanos = stamp_split(message.stamp_ns)
    for name, kind, offset in table.fields:
        cloud.fields.add(name=name, offset=offset, type=_NUMBERS[kind])
    return bytes(cloud.SerializeToString()) + sized_field(_DATA, bytes(table.data))


def write_transform(stamp_ns: int, T: Pose, parent: str, child: str) -> bytes:
    """Write a FrameTransform parent <- child."""
    message = schemas().FrameTransform(parent_frame_id=parent, child_frame_id=child)
    return _fill(message, stamp_ns, message.translation, message.rotation, T)


def _in_frame(stamp_ns: int, T: Pose, frame_id: str) -> Encoded:
    message = schemas().PoseInFrame(frame_id=frame_id)
    payload = _fill(message, stamp_ns, message.pose.position, message.pose.orientation, T)
    return Encoded(payload, _ENCODING + "PoseInFrame")


def _fill(message: Any, stamp_ns: int, position: Any, quaternion: Any, T: Pose) -> bytes:
    message.timestamp.seconds, message.timestamp.nanos = stamp_split(stamp_ns)
    row = pose_to_tum(T).tolist()
    for part, names, values in ((position, "xyz", row[:3]), (quaternion, "xyzw", row[3:])):
        for name, value in zip(names, values, strict=True):
            setattr(part, name, value)
    return bytes(message.SerializeToString())


def encode_cloud(message: CloudMessage) -> Encoded:
    """Write a foxglove.PointCloud."""
    return Encoded(write_cloud(message), _ENCODING + "PointCloud")


def encode_odometry(message: OdometryMessage) -> Encoded:
    """Write a foxglove.PoseInFrame in frame ``odom``."""
    return _in_frame(message.stamp_ns, message.T_odom_body, "odom")


def encode_pose(message: PoseMessage) -> Encoded:
    """Write a foxglove.PoseInFrame; it carries neither covariance nor confidence."""
    return _in_frame(message.stamp_ns, message.T_map_body, message.frame_id)


def encode_location(message: LocationMessage) -> Encoded:
    """Write a foxglove.LocationFix."""
    module: Any = require_library("foxglove_schemas_protobuf.LocationFix_pb2", _LIBRARY, "Foxglove messages")
    fix = module.LocationFix(
        frame_id="base_link",
        latitude=message.latitude,
        longitude=message.longitude,
        altitude=message.height,
        position_covariance=np.asarray(message.covariance, dtype=np.float64).ravel().tolist(),
        position_covariance_type=3,  # known
    )
    fix.timestamp.seconds, fix.timestamp.nanos = stamp_split(message.stamp_ns)
    return Encoded(fix.SerializeToString(), _ENCODING + "LocationFix")
