"""Locations on Earth: JSON, NavSatFix and foxglove.LocationFix, written only."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from coview_stream.errors import ConfigError, require_library
from coview_stream.geometry.arrays import Floats
from coview_stream.messages import ros2
from coview_stream.messages.types import Encoded
from coview_stream.messages.validation import stamp_split

_KNOWN = 3  # covariance known, in both formats
_NAVSAT = "sensor_msgs/msg/NavSatFix"


@dataclass(frozen=True, eq=False)
class LocationMessage:
    """Where a robot is on Earth (WGS 84).

    Attributes:
        stamp_ns: sensor time, nanoseconds.
        robot: name.
        latitude: degrees, north positive. longitude: east positive.
        height: metres; see :class:`coview_stream.clouds.geo_reference.GeoReference`.
        heading: radians, clockwise from true north.
        covariance: (3, 3) east, north, up, m2.
        confidence: as of the pose.
    """

    stamp_ns: int
    robot: str
    latitude: float
    longitude: float
    height: float
    heading: float
    covariance: Floats
    confidence: float


def encode_json(message: LocationMessage) -> Encoded:
    """Write plain JSON: degrees and metres."""
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
    return Encoded(json.dumps(fields, separators=(",", ":")).encode(), "application/json")


def encode_navsat(message: LocationMessage) -> Encoded:
    """Write a sensor_msgs/NavSatFix in CDR; its service is none of a satellite (0)."""
    status = ros2.new("sensor_msgs/msg/NavSatStatus", status=0, service=0)
    fix = ros2.new(
        _NAVSAT,
        header=ros2.header(message.stamp_ns, "base_link"),
        status=status,
        latitude=message.latitude,
        longitude=message.longitude,
        altitude=message.height,
        position_covariance=np.ascontiguousarray(message.covariance, dtype=np.float64).ravel(),
        position_covariance_type=_KNOWN,
    )
    return ros2.write(fix, _NAVSAT)


def encode_foxglove(message: LocationMessage) -> Encoded:
    """Write a foxglove.LocationFix."""
    module: Any = require_library(
        "foxglove_schemas_protobuf.LocationFix_pb2", "foxglove-schemas-protobuf>=0.3", "Foxglove messages"
    )
    fix = module.LocationFix(
        frame_id="base_link",
        latitude=message.latitude,
        longitude=message.longitude,
        altitude=message.height,
        position_covariance=np.asarray(message.covariance, dtype=np.float64).ravel().tolist(),
        position_covariance_type=_KNOWN,
    )
    fix.timestamp.seconds, fix.timestamp.nanos = stamp_split(message.stamp_ns)
    return Encoded(fix.SerializeToString(), "application/protobuf;foxglove.LocationFix")


LOCATION_CODECS: Mapping[str, Callable[[LocationMessage], Encoded]] = {
    "json": encode_json,
    "cdr": encode_navsat,
    "foxglove": encode_foxglove,
}


def encode_location(message: LocationMessage, name: str) -> Encoded:
    """Write a location by the codec ``name`` of :data:`LOCATION_CODECS`."""
    if name not in LOCATION_CODECS:
        raise ConfigError(f"encoding {name!r} for locations; it must be one of {', '.join(LOCATION_CODECS)}")
    return LOCATION_CODECS[name](message)
