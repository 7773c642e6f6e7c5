"""Keelson (RISE, maritime): a ``core.Envelope`` around a Foxglove message.

Field 1 of the envelope is ``enclosed_at`` (google.protobuf.Timestamp), field 2 ``payload`` (bytes). Only the inner
message's stamp is used: ``enclosed_at`` is not a sensor time.
"""

from __future__ import annotations

from coview_stream.errors import MessageError
from coview_stream.messages import foxglove
from coview_stream.messages.foxglove import sized_field, split_field, wire_timestamp
from coview_stream.messages.types import CloudMessage, Encoded, OdometryMessage, PoseMessage, Sample
from coview_stream.messages.validation import bare_pose, stamp_split

_ENCODING = "application/protobuf;core.Envelope"
_ENCLOSED_AT = 1  # number of the field
_PAYLOAD = 2
_MAX_ENTRIES = 64  # fields of an envelope; usual are two


def _open(envelope: bytes) -> memoryview:
    _, payload = split_field(envelope, _PAYLOAD, _MAX_ENTRIES)
    if not payload:
        raise MessageError("the core.Envelope has no payload")
    return payload


def _close(stamp_ns: int, payload: bytes) -> Encoded:
    """Write an envelope with the sensor's time, because a codec has no clock."""
    enclosed_at = wire_timestamp(*stamp_split(stamp_ns))
    envelope = sized_field(_ENCLOSED_AT, enclosed_at) + sized_field(_PAYLOAD, payload)
    return Encoded(envelope, _ENCODING)


def decode_cloud(sample: Sample) -> CloudMessage:
    """Read a foxglove.PointCloud in an envelope."""
    return foxglove.read_cloud(_open(sample.payload))


def decode_odometry(sample: Sample) -> OdometryMessage:
    """Read a foxglove.FrameTransform or PoseInFrame in an envelope."""
    stamp_ns, T, _ = foxglove.read_pose(_open(sample.payload))
    return OdometryMessage(stamp_ns, T)


def decode_pose(sample: Sample) -> PoseMessage:
    """Read a PoseInFrame or FrameTransform in an envelope; fields that the schema lacks are NaN or empty."""
    return bare_pose(*foxglove.read_pose(_open(sample.payload)))


def encode_cloud(message: CloudMessage) -> Encoded:
    """Write a foxglove.PointCloud in an envelope."""
    return _close(message.stamp_ns, foxglove.write_cloud(message))


def encode_odometry(message: OdometryMessage) -> Encoded:
    """Write a foxglove.FrameTransform ``odom`` <- ``base_link`` in an envelope."""
    inner = foxglove.write_transform(message.stamp_ns, message.T_odom_body, "odom", "base_link")
    return _close(message.stamp_ns, inner)


def encode_pose(message: PoseMessage) -> Encoded:
    """Write a foxglove.FrameTransform map frame <- robot in an envelope."""
    inner = foxglove.write_transform(message.stamp_ns, message.T_map_body, message.frame_id, message.robot)
    return _close(message.stamp_ns, inner)
