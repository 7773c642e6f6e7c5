"""Locations on Earth as other readers see them."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from coview_stream.errors import ConfigError
from coview_stream.messages import encode_location, ros2
from coview_stream.messages.types import LocationMessage

MESSAGE = LocationMessage(
    1_700_000_000_000_000_005, "r1", 50.123456789, -8.5, 101.25, math.radians(270), np.diag([1.0, 2.0, 3.0]), 0.999
)


def test_json():
    fields = json.loads(encode_location(MESSAGE, "json").payload)
    assert (fields["latitude"], fields["longitude"], fields["height"]) == (50.123456789, -8.5, 101.25)
    assert (fields["heading_deg"], fields["stamp_ns"]) == (270.0, MESSAGE.stamp_ns)
    assert fields["covariance_enu"] == [1, 0, 0, 0, 2, 0, 0, 0, 3]


def test_navsatfix():
    encoded = encode_location(MESSAGE, "cdr")
    assert encoded.encoding == "application/cdr;sensor_msgs/msg/NavSatFix"
    fix = ros2.store().deserialize_cdr(encoded.payload, "sensor_msgs/msg/NavSatFix")
    assert (fix.latitude, fix.longitude, fix.altitude) == (50.123456789, -8.5, 101.25)
    assert (fix.header.stamp.sec, fix.header.stamp.nanosec) == (1_700_000_000, 5)
    assert list(fix.position_covariance) == [1, 0, 0, 0, 2, 0, 0, 0, 3]
    assert fix.position_covariance_type == 3


def test_foxglove():
    from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix

    encoded = encode_location(MESSAGE, "foxglove")
    fix = LocationFix.FromString(encoded.payload)
    assert (fix.latitude, fix.longitude, fix.altitude) == (50.123456789, -8.5, 101.25)
    assert (fix.timestamp.seconds, fix.timestamp.nanos) == (1_700_000_000, 5)
    assert list(fix.position_covariance) == [1, 0, 0, 0, 2, 0, 0, 0, 3]


def test_other_encodings_are_refused():
    with pytest.raises(ConfigError, match="json, cdr, foxglove"):
        encode_location(MESSAGE, "nmea")
