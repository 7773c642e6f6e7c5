"""ROS 2 messages as CDR with its 4-byte encapsulation header, through rosbags; both byte orders.

The layouts of these types are the same from Humble to Rolling.
"""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import Any

import numpy as np

from coview_stream.errors import MessageError
from coview_stream.geometry import Pose
from coview_stream.stream.codecs.checks import bare_pose, pose_checked, stamp_join
from coview_stream.stream.codecs.fields import MAX_FIELDS, Table, read_table
from coview_stream.stream.messages import CloudMessage, OdometryMessage, PoseMessage, Sample

CLOUD = "sensor_msgs/msg/PointCloud2"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


@lru_cache(maxsize=1)
def store() -> Any:
    """Import the message types and generate their code, on first use: it takes 0.25 s."""
    from rosbags.typesys import Stores, get_typestore

    found = get_typestore(Stores.ROS2_HUMBLE)
    for name in (CLOUD, ODOMETRY, POSE):
        found.get_msgdef(name)
    return found


def _read(payload: bytes, name: str) -> Any:
    try:
        return store().deserialize_cdr(memoryview(payload), name)
    except Exception as error:  # generated code on hostile bytes; what it raises differs between versions
        raise MessageError(f"not a {name} in CDR: {type(error).__name__}: {str(error)[:80]}") from error


def _stamp(message: Any) -> int:
    return stamp_join(message.header.stamp.sec, message.header.stamp.nanosec)


def _pose(message: Any) -> Pose:
    p, q = message.pose.pose.position, message.pose.pose.orientation
    return pose_checked((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def _refuse_many_fields(payload: bytes) -> None:
    """Look ahead at the number of PointFields: rosbags would build millions of objects for a hostile one."""
    order = "<" if payload[1:2] == b"\1" else ">"
    try:
        (name,) = struct.unpack_from(order + "I", payload, 12)
        (count,) = struct.unpack_from(order + "I", payload, 16 + (name + 3 & ~3) + 8)
    except struct.error as error:
        raise MessageError(f"not a {CLOUD} in CDR: truncated") from error
    if count > MAX_FIELDS:
        raise MessageError(f"a point cloud with {count} fields; at most {MAX_FIELDS} are taken")


def decode_cloud(sample: Sample) -> CloudMessage:
    """Read a PointCloud2 of any layout. The points are a view on a little-endian payload where packed float32 x y z."""
    _refuse_many_fields(sample.payload)
    cloud = _read(sample.payload, CLOUD)
    order = ">" if cloud.is_bigendian else "<"
    fields = tuple((f.name, order + KINDS[f.datatype], f.offset) for f in cloud.fields if f.datatype in KINDS)
    table = Table(cloud.data, fields, cloud.point_step, cloud.width, cloud.height, cloud.row_step)
    return read_table(table, _stamp(cloud))


def decode_odometry(sample: Sample) -> OdometryMessage:
    """Read an Odometry; its frames and covariances are not looked at."""
    message = _read(sample.payload, ODOMETRY)
    return OdometryMessage(_stamp(message), _pose(message))


def decode_pose(sample: Sample) -> PoseMessage:
    """Read a PoseWithCovarianceStamped; what the type cannot say is NaN or empty."""
    message = _read(sample.payload, POSE)
    covariance = np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
    return bare_pose(_stamp(message), _pose(message), message.header.frame_id, covariance)
