"""Hypotheses of a search on the wire: JSON below 3 kB, strictly read."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from coview_stream.errors import MessageError
from coview_stream.geometry.arrays import Floats
from coview_stream.messages.json_messages import number, read_object, text
from coview_stream.messages.types import Encoded, Sample
from coview_stream.messages.validation import stamp_from

_MAX_BYTES = 16 * 1024
_MAX_PLACES = 64  # that are read: a newer node may send more than ours do
_NAMES = ("x", "y", "z", "yaw", "probability", "log_ratio")
_DIGITS = (2, 2, 2, 3, 6, 1)


@dataclass(frozen=True, eq=False)
class HypothesesMessage:
    """Places that a search for one robot considers, none of which is known to be right.

    Attributes:
        stamp_ns: sensor time of the keyframe, nanoseconds.
        robot: name.
        places: (K, 6) float64, the most probable first: x, y, z (metres) and yaw (radians) of the body in the map's
            frame, posterior probability, log-likelihood ratio against chance.
        none: probability that the robot is at no place of the map.
        map_sha256: hash of the base map.
        maps: of several maps, the name of the one that each place is on, in whose frame it is; empty of one map.
    """

    stamp_ns: int
    robot: str
    places: Floats
    none: float
    map_sha256: str
    maps: tuple[str, ...] = ()


def encode_hypotheses(message: HypothesesMessage) -> Encoded:
    """Write hypotheses as JSON: ``stamp_ns, robot, map_sha256, none, places``, each place an object."""
    rows: list[dict[str, Any]] = [
        {name: round(float(value), digits) for name, value, digits in zip(_NAMES, row, _DIGITS, strict=True)}
        for row in message.places
    ]
    for row, name in zip(rows, message.maps, strict=False):
        row["map"] = name
    fields = {
        "stamp_ns": message.stamp_ns,
        "robot": message.robot,
        "map_sha256": message.map_sha256,
        "none": round(message.none, 6),
        "places": rows,
    }
    try:
        return Encoded(json.dumps(fields, allow_nan=False, separators=(",", ":")).encode(), "application/json")
    except ValueError as error:
        raise MessageError("JSON cannot say NaN or infinity: leave such a hypothesis out") from error


def decode_hypotheses(sample: Sample) -> HypothesesMessage:
    """Read what :func:`encode_hypotheses` writes.

    Raises:
        MessageError: it is something else; the field is named.
    """
    try:
        fields = read_object(sample.payload, _MAX_BYTES)
        rows = fields.get("places")
        if not isinstance(rows, list) or len(rows) > _MAX_PLACES:
            raise MessageError(f"places: write a list of at most {_MAX_PLACES}")
        places = np.array([_row(each) for each in rows], dtype=np.float64).reshape(-1, len(_NAMES))
        maps = tuple(text(each, "map") for each in rows) if all("map" in each for each in rows) else ()
        return HypothesesMessage(
            stamp_from(fields.get("stamp_ns")), text(fields, "robot"), places, number(fields.get("none"), "none"),
            text(fields, "map_sha256"), maps,
        )  # fmt: skip
    except MessageError as error:
        raise MessageError(f"{sample.key}: {error}") from error


def _row(place: Any) -> list[float]:
    if not isinstance(place, dict):
        raise MessageError(f"places: write objects with {', '.join(_NAMES)}")
    return [number(place.get(name), f"places.{name}") for name in _NAMES]
