"""ROS 2 messages as CDR with its 4-byte encapsulation header, through rosbags.

Reads both byte orders, writes little-endian. These types have the same layout from Humble to Rolling.
"""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import Any

import numpy as np

from coview_stream.errors import MessageError, require_library
from coview_stream.geometry.transforms import Pose, pose_to_tum
from coview_stream.messages import livox
from coview_stream.messages.point_fields import MAX_FIELDS, Table, read_table, write_table
from coview_stream.messages.types import CloudMessage, Encoded, LocationMessage, OdometryMessage, PoseMessage, Sample
from coview_stream.messages.validation import bare_pose, checked_pose, stamp_join, stamp_split

CLOUD = "sensor_msgs/msg/PointCloud2"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"

_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_XCDR2 = {6: "CDR2_BE", 7: "CDR2_LE", 8: "D_CDR2_BE", 9: "D_CDR2_LE", 10: "PL_CDR2_BE", 11: "PL_CDR2_LE"}
_NUMBERS = {f"<{kind}": number for number, kind in _KINDS.items()}


@lru_cache(maxsize=1)
def store() -> Any:
    """Import the message types and generate their code on first use; takes about 0.25 s."""
    typesys = require_library("rosbags.typesys", "rosbags>=0.11", "ROS 2 messages")
    types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for name in (CLOUD, ODOMETRY, POSE):
        types.get_msgdef(name)
    return types


def _check_encapsulation(payload: bytes, name: str) -> None:
    """Check the first two bytes, the encoding; the next two are options, which a reader ignores."""
    kind = int.from_bytes(payload[:2], "big")
    if len(payload) < 4:
        raise MessageError(f"not a {name} in CDR: truncated")
    if kind in _XCDR2:
        raise MessageError(
            f"a {name} in {_XCDR2[kind]} (XCDR2), which is not read: publish with XCDR1, as ROS 2 does "
            "(data representation XCDR1 in the writer's QoS)"
        )
    if kind not in (0, 1):
        encoding = "a parameter list (PL_CDR)" if kind in (2, 3) else f"encapsulation 0x{kind:04x}"
        raise MessageError(f"not a {name} in CDR: {encoding}; publish plain CDR")


def read(payload: bytes, name: str) -> Any:
    """Read a CDR message of type ``name``; MessageError if it is not one."""
    _check_encapsulation(payload, name)
    try:
        return store().deserialize_cdr(memoryview(payload), name)
    except Exception as error:  # on hostile bytes generated code raises different errors in different versions
        raise MessageError(f"not a {name} in CDR: {type(error).__name__}: {str(error)[:80]}") from error


def _stamp(message: Any) -> int:
    return stamp_join(message.header.stamp.sec, message.header.stamp.nanosec)


def _pose(message: Any) -> Pose:
    p, q = message.pose.pose.position, message.pose.pose.orientation
    return checked_pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def header_stamp(payload: bytes) -> int:
    """Read the stamp, nanoseconds, in the header of a CDR message; MessageError without one."""
    return stamp_join(*_unpack("iI", payload, 4))


def frame_id(payload: bytes, skip: int = 0) -> str:
    """Read the string after the stamp of a CDR message, or a later one: an Odometry's second is its child frame."""
    offset = 12
    for _ in range(skip):
        (length,) = _unpack("I", payload, offset)
        offset += 4 + length + 3 & ~3
    (length,) = _unpack("I", payload, offset)
    return payload[offset + 4 : offset + 4 + length].rstrip(b"\0").decode("utf-8", "replace").lstrip("/")


def _unpack(kinds: str, payload: bytes, offset: int) -> tuple[int, ...]:
    if payload[:2] not in (b"\0\0", b"\0\1"):
        raise MessageError("not a message in CDR")
    try:
        return struct.unpack_from((">", "<")[payload[1]] + kinds, payload, offset)
    except struct.error as error:
        raise MessageError("the message is truncated") from error


def _refuse_many_fields(payload: bytes) -> None:
    """Check the number of PointFields before parsing: rosbags would build an object for each of millions."""
    _check_encapsulation(payload, CLOUD)
    order = "<" if payload[1:2] == b"\1" else ">"
    try:
        (name,) = struct.unpack_from(order + "I", payload, 12)
        (count,) = struct.unpack_from(order + "I", payload, 16 + (name + 3 & ~3) + 8)
    except struct.error as error:
        raise MessageError(f"not a {CLOUD} in CDR: truncated") from error
    if count > MAX_FIELDS:
        raise MessageError(f"a point cloud with {count} fields; at most {MAX_FIELDS} are taken")


def decode_cloud(sample: Sample) -> CloudMessage:
    """Read a PointCloud2 of any layout, or a Livox CustomMsg; packed little-endian float32 x y z remain a view."""
    if livox.is_custom(sample.payload):
        return livox.decode(sample.payload)
    _refuse_many_fields(sample.payload)
    cloud = read(sample.payload, CLOUD)
    order = ">" if cloud.is_bigendian else "<"
    fields = tuple((f.name, order + _KINDS[f.datatype], f.offset) for f in cloud.fields if f.datatype in _KINDS)
    table = Table(cloud.data, fields, cloud.point_step, cloud.width, cloud.height, cloud.row_step)
    return read_table(table, _stamp(cloud))


def decode_odometry(sample: Sample) -> OdometryMessage:
    """Read an Odometry; its frames and covariances are ignored."""
    message = read(sample.payload, ODOMETRY)
    return OdometryMessage(_stamp(message), _pose(message))


def decode_pose(sample: Sample) -> PoseMessage:
    """Read a PoseWithCovarianceStamped; fields that the type lacks are NaN or empty."""
    message = read(sample.payload, POSE)
    covariance = np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
    return bare_pose(_stamp(message), _pose(message), message.header.frame_id, covariance)


def new(type_name: str, /, **fields: Any) -> Any:
    """Return a message of a ROS type with these fields."""
    return store().types[type_name](**fields)


def write(message: Any, name: str) -> Encoded:
    """Write a message of type ``name`` in CDR, little-endian."""
    payload = bytes(store().serialize_cdr(message, name, little_endian=True))
    return Encoded(payload, f"application/cdr;{name}")


def header(stamp_ns: int, frame_id: str) -> Any:
    """Return a std_msgs/Header; MessageError if the stamp exceeds its 32-bit seconds."""
    sec, nanosec = stamp_split(stamp_ns)
    if not -(2**31) <= sec < 2**31:
        raise MessageError(f"stamp {stamp_ns} ns exceeds the 32-bit seconds of a ROS header")
    stamp = new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return new("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def _pose_out(T: Pose, covariance: Any) -> Any:
    x, y, z, qx, qy, qz, qw = pose_to_tum(T).tolist()
    position = new("geometry_msgs/msg/Point", x=x, y=y, z=z)
    orientation = new("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw)
    pose = new("geometry_msgs/msg/Pose", position=position, orientation=orientation)
    rows = np.ascontiguousarray(covariance, dtype=np.float64).ravel()
    return new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=rows)


def encode_cloud(message: CloudMessage, frame_id: str = "base_link") -> Encoded:
    """Write a PointCloud2 in a frame."""
    table = write_table(message)
    field = "sensor_msgs/msg/PointField"
    return write(
        new(
            CLOUD,
            header=header(message.stamp_ns, frame_id),
            height=1,
            width=table.width,
            fields=[new(field, name=n, offset=o, datatype=_NUMBERS[k], count=1) for n, k, o in table.fields],
            is_bigendian=False,
            point_step=table.step,
            row_step=table.step * table.width,
            data=np.frombuffer(table.data, np.uint8),
            is_dense=bool(np.isfinite(message.points).all()),
        ),
        CLOUD,
    )


def encode_odometry(message: OdometryMessage) -> Encoded:
    """Write an Odometry ``odom`` <- ``base_link``; zero covariances and velocities mean unknown."""
    zero = dict.fromkeys("xyz", 0.0)
    twist = new(
        "geometry_msgs/msg/Twist",
        linear=new("geometry_msgs/msg/Vector3", **zero),
        angular=new("geometry_msgs/msg/Vector3", **zero),
    )
    return write(
        new(
            ODOMETRY,
            header=header(message.stamp_ns, "odom"),
            child_frame_id="base_link",
            pose=_pose_out(message.T_odom_body, np.zeros(36)),
            twist=new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        ),
        ODOMETRY,
    )


def encode_pose(message: PoseMessage) -> Encoded:
    """Write a PoseWithCovarianceStamped in the map frame; covariance order x, y, z, roll, pitch, yaw."""
    head = header(message.stamp_ns, message.frame_id)
    return write(new(POSE, header=head, pose=_pose_out(message.T_map_body, message.covariance)), POSE)


def encode_location(message: LocationMessage) -> Encoded:
    """Write a sensor_msgs/NavSatFix; service 0: no satellite system."""
    status = new("sensor_msgs/msg/NavSatStatus", status=0, service=0)
    fix = new(
        "sensor_msgs/msg/NavSatFix",
        header=header(message.stamp_ns, "base_link"),
        status=status,
        latitude=message.latitude,
        longitude=message.longitude,
        altitude=message.height,
        position_covariance=np.ascontiguousarray(message.covariance, dtype=np.float64).ravel(),
        position_covariance_type=3,  # known
    )
    return write(fix, "sensor_msgs/msg/NavSatFix")
