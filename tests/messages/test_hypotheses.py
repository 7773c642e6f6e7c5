"""Hypotheses on the wire: small, and strictly read."""

from __future__ import annotations

import json

import numpy as np
import pytest

from coview_stream.errors import MessageError
from coview_stream.messages.json_messages import decode_hypotheses, encode_hypotheses
from coview_stream.messages.types import HypothesesMessage, Sample

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
def test_what_is_none_is_refused_with_its_key(name, value):
    fields = json.loads(encode_hypotheses(message(1)).payload) | {name: value}
    with pytest.raises(MessageError, match=KEY):
        read(json.dumps(fields).encode())


def test_nan_is_not_written():
    with pytest.raises(MessageError, match="NaN"):
        encode_hypotheses(HypothesesMessage(1, "r1", np.full((1, 6), np.nan), 0.5, ""))
