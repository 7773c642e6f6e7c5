"""Decoding and encoding of messages: one table of codecs for each kind.

============  ===========================================  ===================================================
codec         in                                           out
============  ===========================================  ===================================================
``xyz``       clouds: float32 rows, stamp attached         the same
``xyzi``      the same with a fourth column                the same
``json``      odometry, poses                              odometry, poses
``cdr``       PointCloud2 (or Livox CustomMsg), Odometry,  PointCloud2, Odometry,
              PoseWithCovarianceStamped                    PoseWithCovarianceStamped
``foxglove``  PointCloud; PoseInFrame or FrameTransform    PointCloud; PoseInFrame
``keelson``   the same, each in a core.Envelope            PointCloud; FrameTransform, each in a core.Envelope
============  ===========================================  ===================================================

Stamps are nanoseconds of the sensor's clock, lengths metres; poses are 4x4, odometry <- body or map <- body.
For any bytes, decoding returns a message or raises :class:`MessageError` (:class:`OversizedError` if too large,
:class:`EncodingError` if no codec knows the encoding or supports this kind of message). An ``option`` or ``hint``
that is not a codec for this kind of message raises :class:`ConfigError`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Generic, NamedTuple, TypeVar

from coview_stream.errors import ConfigError, MessageError
from coview_stream.messages import foxglove, json_messages, keelson, raw, ros2
from coview_stream.messages.choose import MessageKind, codec_for
from coview_stream.messages.types import CloudMessage, Encoded, LocationMessage, OdometryMessage, PoseMessage, Sample
from coview_stream.messages.validation import (
    MAX_PAYLOAD,
    MAX_POINTS,
    OversizedError,
    RefusedError,
    check_size,
    read_attachment,
)

__all__ = [
    "CLOUD_CODECS",
    "LOCATION_CODECS",
    "MAX_PAYLOAD",
    "MAX_POINTS",
    "ODOMETRY_CODECS",
    "POSE_CODECS",
    "OversizedError",
    "decode_cloud",
    "decode_odometry",
    "decode_pose",
    "encode_cloud",
    "encode_location",
    "encode_odometry",
    "encode_pose",
    "prepare",
]

M = TypeVar("M")
C = TypeVar("C")


class Codec(NamedTuple, Generic[M]):
    """One encoding for one kind of message: a function that reads a sample, and one that writes a message."""

    decode: Callable[[Sample], M]
    encode: Callable[[M], Encoded]


CLOUD_CODECS: Mapping[str, Codec[CloudMessage]] = {
    "xyz": Codec(raw.decode_xyz, raw.encode_xyz),
    "xyzi": Codec(raw.decode_xyzi, raw.encode_xyzi),
    "foxglove": Codec(foxglove.decode_cloud, foxglove.encode_cloud),
    "cdr": Codec(ros2.decode_cloud, ros2.encode_cloud),
    "keelson": Codec(keelson.decode_cloud, keelson.encode_cloud),
}
ODOMETRY_CODECS: Mapping[str, Codec[OdometryMessage]] = {
    "json": Codec(json_messages.decode_odometry, json_messages.encode_odometry),
    "foxglove": Codec(foxglove.decode_odometry, foxglove.encode_odometry),
    "cdr": Codec(ros2.decode_odometry, ros2.encode_odometry),
    "keelson": Codec(keelson.decode_odometry, keelson.encode_odometry),
}
POSE_CODECS: Mapping[str, Codec[PoseMessage]] = {
    "json": Codec(json_messages.decode_pose, json_messages.encode_pose),
    "foxglove": Codec(foxglove.decode_pose, foxglove.encode_pose),
    "cdr": Codec(ros2.decode_pose, ros2.encode_pose),
    "keelson": Codec(keelson.decode_pose, keelson.encode_pose),
}
LOCATION_CODECS: Mapping[str, Callable[[LocationMessage], Encoded]] = {
    "json": json_messages.encode_location,
    "cdr": ros2.encode_location,
    "foxglove": foxglove.encode_location,
}
_PREPARE: Mapping[str, Callable[[], object]] = {
    "foxglove": foxglove.schemas,
    "keelson": foxglove.schemas,
    "cdr": ros2.store,
}


def decode_cloud(
    sample: Sample, option: str | None = None, hint: str | None = None, max_payload: int = MAX_PAYLOAD
) -> CloudMessage:
    """Read a lidar frame; ``sequence`` is set if the attachment is rmw_zenoh's."""
    message = _decode("cloud", CLOUD_CODECS, sample, option, hint, max_payload)
    _, sequence = read_attachment(sample.attachment)
    return message if sequence is None else replace(message, sequence=sequence)


def decode_odometry(
    sample: Sample, option: str | None = None, hint: str | None = None, max_payload: int = MAX_PAYLOAD
) -> OdometryMessage:
    """Read an odometry sample."""
    return _decode("odometry", ODOMETRY_CODECS, sample, option, hint, max_payload)


def decode_pose(sample: Sample, option: str | None = None, hint: str | None = None) -> PoseMessage:
    """Read a published pose; formats other than JSON leave robot, confidence, map and age empty or NaN."""
    return _decode("pose", POSE_CODECS, sample, option, hint)


def encode_cloud(message: CloudMessage, name: str) -> Encoded:
    """Write a lidar frame with codec ``name`` of :data:`CLOUD_CODECS`."""
    return _named("cloud", CLOUD_CODECS, name).encode(message)


def encode_odometry(message: OdometryMessage, name: str) -> Encoded:
    """Write an odometry sample with codec ``name`` of :data:`ODOMETRY_CODECS`."""
    return _named("odometry", ODOMETRY_CODECS, name).encode(message)


def encode_pose(message: PoseMessage, name: str) -> Encoded:
    """Write a pose with codec ``name`` of :data:`POSE_CODECS`; JSON refuses NaN (MessageError)."""
    return _named("pose", POSE_CODECS, name).encode(message)


def encode_location(message: LocationMessage, name: str) -> Encoded:
    """Write a location with codec ``name`` of :data:`LOCATION_CODECS`; locations cannot be read."""
    return _named("locations", LOCATION_CODECS, name)(message)


def prepare(*names: str) -> None:
    """Import the libraries of the named codecs now; otherwise the first frame waits 0.25 s."""
    for name in names:
        _PREPARE.get(name, lambda: None)()


def _named(kind: str, codecs: Mapping[str, C], name: str) -> C:
    if name not in codecs:
        raise ConfigError(f"encoding {name!r} for {kind}; it must be one of {', '.join(codecs)}")
    return codecs[name]


def _decode(
    kind: MessageKind,
    codecs: Mapping[str, Codec[M]],
    sample: Sample,
    option: str | None,
    hint: str | None,
    max_payload: int = MAX_PAYLOAD,
) -> M:
    try:
        check_size(sample.payload, max_payload, sample.size)
    except OversizedError as error:
        raise OversizedError(f"{sample.key}: {error}") from error
    if sample.refused:
        raise RefusedError(f"{sample.key}: {sample.refused}")
    name = codec_for(kind, codecs, sample, option, hint)
    try:
        return codecs[name].decode(sample)
    except MessageError as error:
        raise type(error)(f"{sample.key}: {error}") from error
