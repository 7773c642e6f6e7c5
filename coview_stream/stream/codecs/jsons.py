"""JSON odometry and poses, strictly read: what is not exactly right is refused, extra fields are ignored."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from coview_stream.errors import MessageError
from coview_stream.geometry import Pose, pose_to_tum
from coview_stream.stream.codecs.checks import pose_checked, stamp_from
from coview_stream.stream.codecs.strict_json import load, number, numbers, text
from coview_stream.stream.messages import Encoded, OdometryMessage, PoseMessage, Sample

_ENCODING = "application/json"


def _pose(fields: dict[str, Any]) -> Pose:
    return pose_checked(numbers(fields, "position", 3), numbers(fields, "orientation", 4))


def decode_odometry(sample: Sample) -> OdometryMessage:
    """Read ``{"stamp_ns", "position": [x, y, z], "orientation": [qx, qy, qz, qw]}``, odometry <- body, metres."""
    fields = load(sample.payload)
    return OdometryMessage(stamp_from(fields.get("stamp_ns")), _pose(fields))


def decode_pose(sample: Sample) -> PoseMessage:
    """Read what :func:`encode_pose` writes; ``age_s`` and ``frame_id`` may be missing."""
    fields = load(sample.payload)
    return PoseMessage(
        stamp_ns=stamp_from(fields.get("stamp_ns")),
        robot=text(fields, "robot"),
        state=text(fields, "state"),
        T_map_body=_pose(fields),
        covariance=np.array(numbers(fields, "covariance", 36)).reshape(6, 6),
        confidence=number(fields.get("confidence"), "confidence"),
        map_sha256=text(fields, "map_sha256"),
        age=number(fields.get("age_s", 0.0), "age_s"),
        frame_id=text(fields, "frame_id", "map"),
    )


def _dump(stamp_ns: int, T: Pose, before: dict[str, Any], after: dict[str, Any]) -> Encoded:
    row = pose_to_tum(T).tolist()
    fields = {"stamp_ns": int(stamp_ns), **before, "position": row[:3], "orientation": row[3:], **after}
    try:
        return Encoded(json.dumps(fields, allow_nan=False, separators=(",", ":")).encode(), _ENCODING)
    except ValueError as error:
        raise MessageError("JSON cannot say NaN or infinity: leave such a pose out") from error


def encode_odometry(message: OdometryMessage) -> Encoded:
    """Write what :func:`decode_odometry` reads."""
    return _dump(message.stamp_ns, message.T_odom_body, {}, {})


def encode_pose(message: PoseMessage) -> Encoded:
    """Write a pose with its covariance in rows, (x, y, z, roll, pitch, yaw).

    Fields: stamp_ns, robot, state, position, orientation, covariance, confidence, map_sha256, age_s, frame_id.
    NaN is a MessageError.
    """
    after = {
        "covariance": np.asarray(message.covariance, dtype=np.float64).ravel().tolist(),
        "confidence": float(message.confidence),
        "map_sha256": message.map_sha256,
        "age_s": float(message.age),
        "frame_id": message.frame_id,
    }
    before = {"robot": message.robot, "state": message.state}
    return _dump(message.stamp_ns, message.T_map_body, before, after)
