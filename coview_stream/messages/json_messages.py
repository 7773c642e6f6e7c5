"""JSON messages, read strictly: every value is checked, a MessageError names the field; extra fields are ignored."""

from __future__ import annotations

import json
import math
from typing import Any, NoReturn

import numpy as np

from coview_stream.errors import MessageError
from coview_stream.geometry.protection import LEVELS, ProtectionLevel
from coview_stream.geometry.transforms import Pose, place_fields
from coview_stream.messages.types import (
    Encoded,
    HypothesesMessage,
    LocationMessage,
    OdometryMessage,
    PoseMessage,
    Sample,
)
from coview_stream.messages.validation import check_size, checked_pose, stamp_from

_MAX_BYTES = 64 * 1024  # a pose takes 0.8 kB
_MAX_STATUS_BYTES = 1024 * 1024  # a node's status of a robot has 3.5 kB at most
_MAX_HYPOTHESES_BYTES = 16 * 1024  # ours stay below 3 kB
_MAX_PLACES = 64  # a newer node may send more hypotheses than this one
_PLACE_DIGITS = {"x": 2, "y": 2, "z": 2, "yaw": 3, "probability": 6, "log_ratio": 1}


def decode_odometry(sample: Sample) -> OdometryMessage:
    """Read ``{"stamp_ns", "position": [x, y, z], "orientation": [qx, qy, qz, qw]}``, odometry <- body, metres."""
    fields = read_object(sample.payload)
    return OdometryMessage(stamp_from(fields.get("stamp_ns")), _pose(fields))


def encode_odometry(message: OdometryMessage) -> Encoded:
    """Write odometry as :func:`decode_odometry` reads it."""
    return _dump({"stamp_ns": int(message.stamp_ns), **place_fields(message.T_odom_body)}, "pose")


def decode_pose(sample: Sample) -> PoseMessage:
    """Read a pose written by :func:`encode_pose`; fields after ``map_sha256`` are optional."""
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


def encode_pose(message: PoseMessage) -> Encoded:
    """Write a pose with its covariance row by row (x, y, z, roll, pitch, yaw).

    ``protection_level`` and ``T_map_odom`` (position and orientation, map <- odometry) are null if unknown. NaN is a
    MessageError.
    """
    fields = message.to_json() | {  # NaN stays in, to be refused
        "covariance": np.asarray(message.covariance, dtype=np.float64).ravel().tolist(),
        "confidence": float(message.confidence),
        "map_sha256": message.map_sha256,
        "age_s": float(message.age),
    }
    return _dump(fields, "pose")


def pose_record(pose: PoseMessage, sample: Sample) -> dict[str, Any]:
    """Return a pose's fields as in native JSON, null where its format lacks one; a JSON sample stays as it is."""
    if sample.payload[:1] == b"{":
        return read_object(sample.payload)
    return pose.to_json()


def read_status(sample: Sample) -> dict[str, Any]:
    """Read a node's status, a JSON object without required fields; MessageError if it is not an object."""
    try:
        return read_object(sample.payload, _MAX_STATUS_BYTES)
    except MessageError as error:
        raise MessageError(f"{sample.key}: the status is not a JSON object ({error})") from error


def encode_hypotheses(message: HypothesesMessage) -> Encoded:
    """Write hypotheses as JSON: ``stamp_ns, robot, map_sha256, none, places``, each place an object."""
    rows: list[dict[str, Any]] = [
        {name: round(float(value), digits) for (name, digits), value in zip(_PLACE_DIGITS.items(), row, strict=True)}
        for row in message.places
    ]
    for row, name in zip(rows, message.maps, strict=False):
        row["map"] = name
    fields = {"stamp_ns": message.stamp_ns, "robot": message.robot, "map_sha256": message.map_sha256}
    return _dump(fields | {"none": round(message.none, 6), "places": rows}, "hypothesis")


def decode_hypotheses(sample: Sample) -> HypothesesMessage:
    """Read hypotheses written by :func:`encode_hypotheses`; a MessageError names the wrong field."""
    try:
        fields = read_object(sample.payload, _MAX_HYPOTHESES_BYTES)
        rows = fields.get("places")
        if not isinstance(rows, list) or len(rows) > _MAX_PLACES:
            raise MessageError(f"places: write a list of at most {_MAX_PLACES}")
        if not all(isinstance(row, dict) for row in rows):
            raise MessageError(f"places: write objects with {', '.join(_PLACE_DIGITS)}")
        values = [[number(row.get(name), f"places.{name}") for name in _PLACE_DIGITS] for row in rows]
        places = np.array(values, dtype=np.float64).reshape(-1, len(_PLACE_DIGITS))
        maps = tuple(text(row, "map") for row in rows) if all("map" in row for row in rows) else ()
        return HypothesesMessage(
            stamp_ns=stamp_from(fields.get("stamp_ns")),
            robot=text(fields, "robot"),
            places=places,
            none=number(fields.get("none"), "none"),
            map_sha256=text(fields, "map_sha256"),
            maps=maps,
        )
    except MessageError as error:
        raise MessageError(f"{sample.key}: {error}") from error


def encode_location(message: LocationMessage) -> Encoded:
    """Write a location as JSON, in degrees and metres."""
    fields = {
        "stamp_ns": int(message.stamp_ns),
        "robot": message.robot,
        "latitude": round(message.latitude, 9),
        "longitude": round(message.longitude, 9),
        "height": round(message.height, 4),
        "heading_deg": round(math.degrees(message.heading), 3),
        "covariance_enu": np.asarray(message.covariance, dtype=np.float64).ravel().tolist(),
        "confidence": None if math.isnan(message.confidence) else message.confidence,
    }
    return _dump(fields, "location")


def read_object(payload: bytes, limit: int = _MAX_BYTES) -> dict[str, Any]:
    """Read the fields of a JSON object of at most ``limit`` bytes; MessageError for a repeated field or NaN."""
    check_size(payload, limit)
    try:
        fields = json.loads(payload, parse_constant=_refuse_constant, object_pairs_hook=_unique)
    except MessageError:
        raise
    except (ValueError, RecursionError) as error:
        raise MessageError(f"no JSON: {str(error)[:80]}") from error
    if not isinstance(fields, dict):
        raise MessageError("the JSON is not an object with fields")
    return fields


def number(value: object, name: str) -> float:
    """Return ``value`` if it is a finite number; the MessageError names the field ``name``."""
    try:
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            return float(value)
    except OverflowError:  # an integer too large for a float
        pass
    raise MessageError(f"{name}: not a finite number")


def numbers(fields: dict[str, Any], name: str, count: int) -> list[float]:
    """Return field ``name``, a list of ``count`` finite numbers."""
    values = fields.get(name)
    if not isinstance(values, list) or len(values) != count:
        raise MessageError(f"{name}: write a list of {count} numbers")
    return [number(value, name) for value in values]


def text(fields: dict[str, Any], name: str, default: str | None = None) -> str:
    """Return field ``name``, a text that UTF-8 can encode."""
    value = fields.get(name, default)
    if not isinstance(value, str) or any("\ud800" <= letter <= "\udfff" for letter in value):
        raise MessageError(f"{name}: write a text")
    return value


def _dump(fields: dict[str, Any], noun: str) -> Encoded:
    try:
        return Encoded(json.dumps(fields, allow_nan=False, separators=(",", ":")).encode(), "application/json")
    except ValueError as error:
        raise MessageError(f"JSON cannot say NaN or infinity: leave such a {noun} out") from error


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
        raise MessageError(f"protection_level: write {', '.join(LEVELS)}")
    metres, degrees, horizontal, vertical = (number(value.get(name), f"protection_level.{name}") for name in LEVELS)
    return ProtectionLevel(metres, degrees, horizontal, vertical)


def _refuse_constant(name: str) -> NoReturn:
    raise MessageError(f"{name} is not a JSON number")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) != len(pairs):
        raise MessageError("a field occurs twice")
    return fields
