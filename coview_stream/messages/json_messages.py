"""JSON odometry, poses and statuses, strictly read.

Every value is checked, and what is wrong is a MessageError that names the field; extra fields are ignored.
"""

from __future__ import annotations

import json
import math
from typing import Any, NoReturn

import numpy as np

from coview_stream.errors import MessageError
from coview_stream.geometry.pose_numbers import place_fields
from coview_stream.geometry.protection import ProtectionLevel
from coview_stream.geometry.transforms import Pose, pose_to_tum
from coview_stream.messages.types import Encoded, OdometryMessage, PoseMessage, Sample
from coview_stream.messages.validation import check_size, checked_pose, stamp_from

_ENCODING = "application/json"
_MAX_BYTES = 64 * 1024  # a pose has 0.8 kB
_MAX_STATUS_BYTES = 1024 * 1024  # a status has a few kB for each robot


def decode_odometry(sample: Sample) -> OdometryMessage:
    """Read ``{"stamp_ns", "position": [x, y, z], "orientation": [qx, qy, qz, qw]}``, odometry <- body, metres."""
    fields = read_object(sample.payload)
    return OdometryMessage(stamp_from(fields.get("stamp_ns")), _pose(fields))


def decode_pose(sample: Sample) -> PoseMessage:
    """Read what :func:`encode_pose` writes; what follows ``map_sha256`` may be missing."""
    fields = read_object(sample.payload)
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
        protection=_protection(fields.get("protection_level")),
        T_map_odom=_transform(fields.get("T_map_odom")),
    )


def encode_odometry(message: OdometryMessage) -> Encoded:
    """Write what :func:`decode_odometry` reads."""
    return _dump(message.stamp_ns, message.T_odom_body, {}, {})


def encode_pose(message: PoseMessage) -> Encoded:
    """Write a pose with its covariance in rows, (x, y, z, roll, pitch, yaw).

    Fields: stamp_ns, robot, state, position, orientation, covariance, confidence, map_sha256, age_s, frame_id,
    protection_level and T_map_odom (position and orientation, map <- odometry; null where they are not known).
    NaN is a MessageError.
    """
    after = {
        "covariance": np.asarray(message.covariance, dtype=np.float64).ravel().tolist(),
        "confidence": float(message.confidence),
        "map_sha256": message.map_sha256,
        "age_s": float(message.age),
        "frame_id": message.frame_id,
        "protection_level": None if message.protection is None else message.protection.to_json(),
        "T_map_odom": None if message.T_map_odom is None else place_fields(message.T_map_odom),
    }
    before = {"robot": message.robot, "state": message.state}
    return _dump(message.stamp_ns, message.T_map_body, before, after)


def read_status(sample: Sample) -> dict[str, Any]:
    """Read a node's status, a JSON object; no field of it is required.

    Raises:
        MessageError: it is none.
    """
    try:
        return read_object(sample.payload, _MAX_STATUS_BYTES)
    except MessageError as error:
        raise MessageError(f"{sample.key}: the status is no JSON object ({error})") from error


def pose_record(pose: PoseMessage, sample: Sample) -> dict[str, Any]:
    """Return a pose's fields as in the native JSON, null where its format does not carry one.

    A sample that is JSON is returned as it came, with any fields that a newer node added.
    """
    if sample.payload[:1] == b"{":
        return read_object(sample.payload)
    return pose.to_json()


def read_object(payload: bytes, limit: int = _MAX_BYTES) -> dict[str, Any]:
    """Read the fields of a JSON object of at most ``limit`` bytes; no field twice, no NaN, else MessageError."""
    check_size(payload, limit)
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
    """Return field ``name``, a list of ``count`` finite numbers."""
    values = fields.get(name)
    if not isinstance(values, list) or len(values) != count:
        raise MessageError(f"{name}: write a list of {count} numbers")
    return [number(value, name) for value in values]


def text(fields: dict[str, Any], name: str, default: str | None = None) -> str:
    """Return field ``name``, a text that can be written as UTF-8."""
    value = fields.get(name, default)
    if not isinstance(value, str) or any("\ud800" <= letter <= "\udfff" for letter in value):
        raise MessageError(f"{name}: write a text")
    return value


def _pose(fields: dict[str, Any]) -> Pose:
    return checked_pose(numbers(fields, "position", 3), numbers(fields, "orientation", 4))


def _transform(value: object) -> Pose | None:
    if value is None:
        return None
    if not isinstance(value, dict):
        raise MessageError("T_map_odom: write position and orientation")
    try:
        return _pose(value)
    except MessageError as error:
        raise MessageError(f"T_map_odom: {error}") from error


def _protection(value: object) -> ProtectionLevel | None:
    if value is None:
        return None
    if not isinstance(value, dict):
        raise MessageError("protection_level: write m and deg")
    return ProtectionLevel(
        number(value.get("m"), "protection_level.m"), number(value.get("deg"), "protection_level.deg")
    )


def _dump(stamp_ns: int, T: Pose, before: dict[str, Any], after: dict[str, Any]) -> Encoded:
    row = pose_to_tum(T).tolist()
    fields = {"stamp_ns": int(stamp_ns), **before, "position": row[:3], "orientation": row[3:], **after}
    try:
        return Encoded(json.dumps(fields, allow_nan=False, separators=(",", ":")).encode(), _ENCODING)
    except ValueError as error:
        raise MessageError("JSON cannot say NaN or infinity: leave such a pose out") from error


def _no_constant(name: str) -> NoReturn:
    raise MessageError(f"{name} is no JSON number")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise MessageError("a field occurs twice")
    return found
