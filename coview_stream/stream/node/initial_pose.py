"""Guess of a robot's place, as clients send it: a question's parameters, JSON, or RViz' pose."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from coview_stream.errors import ConfigError, InputError, MessageError
from coview_stream.geometry.transforms import yaw_of
from coview_stream.localization.search.place_guess import MAX_DISTANCE, PlaceGuess
from coview_stream.messages import decode_pose
from coview_stream.messages.types import Sample

_MAX_BYTES = 4096  # of a message; set by hand
_SIGMAS = 2.0  # of a covariance that are tried around its pose; set by hand
_FIELDS = ("x", "y", "yaw", "distance", "angle", "map", "within")


def guess_of_fields(fields: Mapping[str, Any]) -> PlaceGuess:
    """Return the guess of named numbers or their texts: x and y, and perhaps yaw, distance and angle (radians, metres).

    With ``map``, a name, they are in the frame of that one of several maps; ``within``: as of a :class:`PlaceGuess`.

    Raises:
        InputError: x or y is missing, a name is unknown, or a value is no number or out of its range.
    """
    unknown = sorted(set(fields) - set(_FIELDS))
    if unknown or "x" not in fields or "y" not in fields:
        what = f"{unknown[0]!r} is unknown" if unknown else "x or y is missing"
        raise InputError(f"initial pose: {what}; give x, y and perhaps yaw, distance, angle, within (metres, radians)")
    numbers: dict[str, float] = {}
    of = fields.get("map")
    if not isinstance(of, str | None):
        raise InputError(f"initial pose: map is {str(of)[:40]!r}, which is no name")
    for name, value in fields.items():
        if name == "map":
            continue
        if value is None and name in ("yaw", "within"):
            continue
        try:
            if isinstance(value, bool):
                raise TypeError("it is a truth value")
            numbers[name] = float(value)
        except (TypeError, ValueError) as error:
            raise InputError(f"initial pose: {name} is {str(value)[:40]!r}, which is no number") from error
    try:
        return PlaceGuess(**numbers, map=of)
    except ConfigError as error:
        raise InputError(f"initial pose: {error}") from error


def decode_guess(sample: Sample) -> PlaceGuess:
    """Read a message: JSON with the fields of :func:`guess_of_fields`, or a PoseWithCovarianceStamped in CDR.

    Raises:
        InputError: it is neither, or names no place.
    """
    payload = bytes(sample.payload[: _MAX_BYTES + 1])
    if len(payload) > _MAX_BYTES:
        raise MessageError(f"{sample.key}: an initial pose of more than {_MAX_BYTES} bytes")
    if not payload.lstrip().startswith(b"{"):
        pose = decode_pose(sample, "cdr")
        spread = math.sqrt(max(float(np.nanmax(np.diag(pose.covariance)[:2])), 0.0)) if pose.covariance.size else 0.0
        turn = math.sqrt(max(float(np.nan_to_num(pose.covariance[5, 5])), 0.0)) if pose.covariance.size else 0.0
        return guess_of_fields({
            "x": pose.T_map_body[0, 3], "y": pose.T_map_body[1, 3], "yaw": yaw_of(pose.T_map_body),
            "distance": min(max(_SIGMAS * spread, 3.0), MAX_DISTANCE), "angle": min(max(_SIGMAS * turn, 0.3), math.pi),
            "map": None if pose.frame_id in ("", "map") else pose.frame_id,
        })  # fmt: skip
    try:
        fields = json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise MessageError(f"{sample.key}: no JSON ({str(error)[:80]})") from error
    return guess_of_fields(fields)
