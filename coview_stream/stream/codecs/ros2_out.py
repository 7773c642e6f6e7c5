"""ROS 2 messages written as little-endian CDR, through rosbags."""

from __future__ import annotations

from typing import Any

import numpy as np

from coview_stream.errors import MessageError
from coview_stream.geometry import Pose, pose_to_tum
from coview_stream.stream.codecs.checks import stamp_split
from coview_stream.stream.codecs.fields import write_table
from coview_stream.stream.codecs.ros2 import CLOUD, KINDS, ODOMETRY, POSE, store
from coview_stream.stream.messages import CloudMessage, Encoded, OdometryMessage, PoseMessage

_NUMBERS = {f"<{kind}": number for number, kind in KINDS.items()}


def _new(type_name: str, /, **fields: Any) -> Any:
    return store().types[type_name](**fields)


def _write(message: Any, name: str) -> Encoded:
    payload = bytes(store().serialize_cdr(message, name, little_endian=True))
    return Encoded(payload, f"application/cdr;{name}")


def _header(stamp_ns: int, frame_id: str) -> Any:
    sec, nanosec = stamp_split(stamp_ns)
    if not -(2**31) <= sec < 2**31:
        raise MessageError(f"stamp {stamp_ns} ns exceeds the 32-bit seconds of a ROS header")
    stamp = _new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return _new("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def _pose_out(T: Pose, covariance: Any) -> Any:
    x, y, z, qx, qy, qz, qw = pose_to_tum(T).tolist()
    position = _new("geometry_msgs/msg/Point", x=x, y=y, z=z)
    orientation = _new("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw)
    pose = _new("geometry_msgs/msg/Pose", position=position, orientation=orientation)
    rows = np.ascontiguousarray(covariance, dtype=np.float64).ravel()
    return _new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=rows)


def encode_cloud(message: CloudMessage) -> Encoded:
    """Write a PointCloud2 in frame ``base_link``."""
    table = write_table(message)
    field = "sensor_msgs/msg/PointField"
    return _write(
        _new(
            CLOUD,
            header=_header(message.stamp_ns, "base_link"),
            height=1,
            width=table.width,
            fields=[_new(field, name=n, offset=o, datatype=_NUMBERS[k], count=1) for n, k, o in table.fields],
            is_bigendian=False,
            point_step=table.step,
            row_step=table.step * table.width,
            data=np.frombuffer(table.data, np.uint8),
            is_dense=bool(np.isfinite(message.points).all()),
        ),
        CLOUD,
    )


def encode_odometry(message: OdometryMessage) -> Encoded:
    """Write an Odometry ``odom`` <- ``base_link``; covariances and velocities are zero: not known."""
    zero = dict.fromkeys("xyz", 0.0)
    twist = _new(
        "geometry_msgs/msg/Twist",
        linear=_new("geometry_msgs/msg/Vector3", **zero),
        angular=_new("geometry_msgs/msg/Vector3", **zero),
    )
    return _write(
        _new(
            ODOMETRY,
            header=_header(message.stamp_ns, "odom"),
            child_frame_id="base_link",
            pose=_pose_out(message.T_odom_body, np.zeros(36)),
            twist=_new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        ),
        ODOMETRY,
    )


def encode_pose(message: PoseMessage) -> Encoded:
    """Write a PoseWithCovarianceStamped in the map frame; covariance order x, y, z, roll, pitch, yaw, as there."""
    header = _header(message.stamp_ns, message.frame_id)
    return _write(_new(POSE, header=header, pose=_pose_out(message.T_map_body, message.covariance)), POSE)
