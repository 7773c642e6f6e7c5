"""Hypotheses and locations: strictly read, and as other readers see them."""

import json
import math

import numpy as np
import pytest

from coview_stream.errors import ConfigError, MessageError
from coview_stream.messages import encode_location, ros2
from coview_stream.messages.json_messages import decode_hypotheses, encode_hypotheses
from coview_stream.messages.types import HypothesesMessage, LocationMessage, Sample

KEY = "coview/r1/out/hypotheses"


def message(count):
    row = [593123.456, 5789123.456, -123.456, -3.14159, 0.123456789, -1234.56]
    return HypothesesMessage(1_700_000_000_000_000_000, "r1", np.tile(row, (count, 1)), 0.25, "ab" * 32)


def read(payload):
    return decode_hypotheses(Sample(KEY, payload))


def test_twenty_places_in_utm_coordinates_fit_three_kilobytes():
    payload = encode_hypotheses(message(20)).payload
    assert len(payload) < 3000
    back = read(payload)
    assert np.allclose(back.places, message(20).places, atol=0.06)
    assert (back.none, back.robot) == (0.25, "r1")


def test_no_place_is_a_message_too():
    assert read(encode_hypotheses(message(0)).payload).places.shape == (0, 6)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("places", None), ("places", [3]), ("places", [{"x": 1}]), ("places", [{}] * 65), ("none", None),
        ("none", "1"), ("robot", 3), ("stamp_ns", "now"),
    ],
)  # fmt: skip
def test_malformed_hypotheses_are_refused_with_their_key(name, value):
    fields = json.loads(encode_hypotheses(message(1)).payload) | {name: value}
    with pytest.raises(MessageError, match=KEY):
        read(json.dumps(fields).encode())


def test_nan_in_hypotheses_is_not_written():
    with pytest.raises(MessageError, match="NaN"):
        encode_hypotheses(HypothesesMessage(1, "r1", np.full((1, 6), np.nan), 0.5, ""))


LOCATION = LocationMessage(
    1_700_000_000_000_000_005, "r1", 50.123456789, -8.5, 101.25, math.radians(270), np.diag([1.0, 2.0, 3.0]), 0.999
)


def test_location_in_json():
    fields = json.loads(encode_location(LOCATION, "json").payload)
    assert (fields["latitude"], fields["longitude"], fields["height"]) == (50.123456789, -8.5, 101.25)
    assert (fields["heading_deg"], fields["stamp_ns"]) == (270.0, LOCATION.stamp_ns)
    assert fields["covariance_enu"] == [1, 0, 0, 0, 2, 0, 0, 0, 3]


def test_location_as_navsatfix_and_of_foxglove():
    from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix

    encoded = encode_location(LOCATION, "cdr")
    assert encoded.encoding == "application/cdr;sensor_msgs/msg/NavSatFix"
    ros = ros2.store().deserialize_cdr(encoded.payload, "sensor_msgs/msg/NavSatFix")
    assert (ros.header.stamp.sec, ros.header.stamp.nanosec) == (1_700_000_000, 5)
    assert ros.position_covariance_type == 3
    foxglove = LocationFix.FromString(encode_location(LOCATION, "foxglove").payload)
    assert (foxglove.timestamp.seconds, foxglove.timestamp.nanos) == (1_700_000_000, 5)
    for fix in (ros, foxglove):
        assert (fix.latitude, fix.longitude, fix.altitude) == (50.123456789, -8.5, 101.25)
        assert list(fix.position_covariance) == [1, 0, 0, 0, 2, 0, 0, 0, 3]


def test_other_encodings_of_locations_are_refused():
    with pytest.raises(ConfigError, match="json, cdr, foxglove"):
        encode_location(LOCATION, "nmea")
