"""JSON odometry and poses, strictly read: what is not exactly right is refused, extra fields are ignored."""

# FOLDED coview_stream/messages/json_messages.py: """JSON objects from strangers: every value is checked, and what is wrong is a MessageError that names the field."""
# FOLDED coview_stream/messages/json_messages.py: """Poses and statuses as plain JSON data, for whoever passes them on."""

from __future__ import annotations

import json
import math
from typing import Any, NoReturn

import numpy as np

from coview_stream.errors import MessageError
from coview_stream.geometry.transforms import Pose, pose_to_tum
from coview_stream.messages.types import Encoded, OdometryMessage, PoseMessage, Sample
from coview_stream.messages.validation import check_size, pose_checked, stamp_from

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


_MAX_BYTES = 64 * 1024  # a pose has 0.8 kB


def _no_constant(name: str) -> NoReturn:
    raise MessageError(f"{name} is no JSON number")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise MessageError("a field occurs twice")
    return found


def load(payload: bytes) -> dict[str, Any]:
    """Fields of a JSON object; no field twice, no NaN."""
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


def number(value: object, name: str) -> float:
    """Check that ``value`` is a finite number, and return it."""
    try:
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            return float(value)
    except OverflowError:  # an integer beyond the floats
        pass
    raise MessageError(f"{name}: not a finite number")


def numbers(fields: dict[str, Any], name: str, count: int) -> list[float]:
    """Field ``name``, a list of ``count`` finite numbers."""
    values = fields.get(name)
    if not isinstance(values, list) or len(values) != count:
        raise MessageError(f"{name}: write a list of {count} numbers")
    return [number(value, name) for value in values]


def text(fields: dict[str, Any], name: str, default: str | None = None) -> str:
    """Field ``name``, a text that can be written as UTF-8."""
    value = fields.get(name, default)
    if not isinstance(value, str) or any("\ud800" <= letter <= "\udfff" for letter in value):
        raise MessageError(f"{name}: write a text")
    return value


def read_status(sample: Sample) -> dict[str, Any]:
    """Status of a node, a JSON object; no field of it is required.

    Raises:
        MessageError: it is none.
    """
    try:
        status = json.loads(sample.payload, parse_constant=_reject_constant)
    except (ValueError, RecursionError) as error:
        raise MessageError(f"{sample.key}: the status is no JSON ({error})") from error
    if not isinstance(status, dict):
        raise MessageError(f"{sample.key}: the status is no JSON object")
    return status


def pose_record(pose: PoseMessage, sample: Sample) -> dict[str, Any]:
    """Fields of a pose as in the native JSON, null where its format does not carry one.

    A sample that is JSON is given as it came, with whatever fields a newer node added.
    """
    if sample.payload[:1] == b"{":
        found: dict[str, Any] = json.loads(sample.payload)
        return found
    row = pose_to_tum(pose.T_map_body).tolist()
    return {
        "stamp_ns": pose.stamp_ns,
        "robot": pose.robot,
        "state": pose.state,
        "position": row[:3],
        "orientation": row[3:],
        "covariance": None if np.isnan(pose.covariance).any() else pose.covariance.ravel().tolist(),
        "confidence": _known(pose.confidence),
        "map_sha256": pose.map_sha256 or None,
        "age_s": _known(pose.age),
        "frame_id": pose.frame_id,
    }


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _reject_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON number")
