"""JSON odometry and poses, strictly read: what is not exactly right is refused, extra fields are ignored."""

from __future__ import annotations

import json
import math
from typing import Any, NoReturn

import numpy as np

from coview_stream.errors import MessageError
from coview_stream.geometry import Pose, pose_to_tum
from coview_stream.stream.codecs.checks import check_size, pose_checked, stamp_from
from coview_stream.stream.messages import Encoded, OdometryMessage, PoseMessage, Sample

_ENCODING = "application/json"
_MAX_BYTES = 64 * 1024  # a pose has 0.8 kB


def _no_constant(name: str) -> NoReturn:
    raise MessageError(f"{name} is no JSON number")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise MessageError("a field occurs twice")
    return found


def _load(payload: bytes) -> dict[str, Any]:
    check_size(payload, _MAX_BYTES)
    try:
        found = json.loads(payload, parse_constant=_no_constant, object_pairs_hook=_unique)
    except MessageError:
        raise
    except (ValueError, RecursionError) as error:
        raise MessageError(f"no JSON: {str(error)[:80]}") from error
    if not isinstance(found, dict):
        raise MessageError("the JSON is no object with fields")
    return found


def _number(value: object, name: str) -> float:
    try:
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            return float(value)
    except OverflowError:  # an integer beyond the floats
        pass
    raise MessageError(f"{name}: not a finite number")


def _numbers(fields: dict[str, Any], name: str, count: int) -> list[float]:
    values = fields.get(name)
    if not isinstance(values, list) or len(values) != count:
        raise MessageError(f"{name}: write a list of {count} numbers")
    return [_number(value, name) for value in values]


def _text(fields: dict[str, Any], name: str, default: str | None = None) -> str:
    value = fields.get(name, default)
    if not isinstance(value, str) or any("\ud800" <= letter <= "\udfff" for letter in value):
        raise MessageError(f"{name}: write a text")
    return value


def _pose(fields: dict[str, Any]) -> Pose:
    return pose_checked(_numbers(fields, "position", 3), _numbers(fields, "orientation", 4))


def decode_odometry(sample: Sample) -> OdometryMessage:
    """Read ``{"stamp_ns", "position": [x, y, z], "orientation": [qx, qy, qz, qw]}``, odometry <- body, metres."""
    fields = _load(sample.payload)
    return OdometryMessage(stamp_from(fields.get("stamp_ns")), _pose(fields))


def decode_pose(sample: Sample) -> PoseMessage:
    """Read what :func:`encode_pose` writes; ``age_s`` and ``frame_id`` may be missing."""
    fields = _load(sample.payload)
    return PoseMessage(
        stamp_ns=stamp_from(fields.get("stamp_ns")),
        robot=_text(fields, "robot"),
        state=_text(fields, "state"),
        T_map_body=_pose(fields),
        covariance=np.array(_numbers(fields, "covariance", 36)).reshape(6, 6),
        confidence=_number(fields.get("confidence"), "confidence"),
        map_sha256=_text(fields, "map_sha256"),
        age=_number(fields.get("age_s", 0.0), "age_s"),
        frame_id=_text(fields, "frame_id", "map"),
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
