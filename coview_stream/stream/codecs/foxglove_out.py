"""Foxglove's protobuf schemas, written: PointCloud, PoseInFrame, FrameTransform."""

from __future__ import annotations

from typing import Any

from coview_stream.geometry import Pose, pose_to_tum
from coview_stream.stream.codecs import wire
from coview_stream.stream.codecs.checks import stamp_split
from coview_stream.stream.codecs.fields import write_table
from coview_stream.stream.codecs.foxglove import DATA, KINDS, schemas
from coview_stream.stream.messages import CloudMessage, Encoded, OdometryMessage, PoseMessage

_ENCODING = "application/protobuf;foxglove."
_NUMBERS = {kind: number for number, kind in KINDS.items()}


def _fill(message: Any, stamp_ns: int, position: Any, quaternion: Any, T: Pose) -> bytes:
    message.timestamp.seconds, message.timestamp.nanos = stamp_split(stamp_ns)
    row = pose_to_tum(T).tolist()
    for part, names, values in ((position, "xyz", row[:3]), (quaternion, "xyzw", row[3:])):
        for name, value in zip(names, values, strict=True):
            setattr(part, name, value)
    return bytes(message.SerializeToString())


def write_cloud(message: CloudMessage, frame_id: str = "base_link") -> bytes:
    """Write a PointCloud without a pose: the points are in the body frame already."""
    table = write_table(message)
    cloud = schemas().PointCloud(frame_id=frame_id, point_stride=table.step)
    cloud.timestamp.seconds, cloud.timestamp.nanos = stamp_split(message.stamp_ns)
    for name, kind, offset in table.fields:
        cloud.fields.add(name=name, offset=offset, type=_NUMBERS[kind])
    return bytes(cloud.SerializeToString()) + wire.sized_field(DATA, bytes(table.data))


def write_transform(stamp_ns: int, T: Pose, parent: str, child: str) -> bytes:
    """Write a FrameTransform parent <- child."""
    message = schemas().FrameTransform(parent_frame_id=parent, child_frame_id=child)
    return _fill(message, stamp_ns, message.translation, message.rotation, T)


def _in_frame(stamp_ns: int, T: Pose, frame_id: str) -> Encoded:
    message = schemas().PoseInFrame(frame_id=frame_id)
    payload = _fill(message, stamp_ns, message.pose.position, message.pose.orientation, T)
    return Encoded(payload, _ENCODING + "PoseInFrame")


def encode_cloud(message: CloudMessage) -> Encoded:
    """Write a foxglove.PointCloud."""
    return Encoded(write_cloud(message), _ENCODING + "PointCloud")


def encode_odometry(message: OdometryMessage) -> Encoded:
    """Write a foxglove.PoseInFrame in frame ``odom``."""
    return _in_frame(message.stamp_ns, message.T_odom_body, "odom")


def encode_pose(message: PoseMessage) -> Encoded:
    """Write a foxglove.PoseInFrame; it carries neither covariance nor confidence."""
    return _in_frame(message.stamp_ns, message.T_map_body, message.frame_id)
