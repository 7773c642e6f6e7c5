"""A status stays below 3.5 kB, whatever names, reasons and errors it has to tell, and says what it left out."""

from __future__ import annotations

import json

import pytest
from fake_robot import Robot, unknown
from hypothesis import given, settings
from hypothesis import strategies as st

from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.stream.node.status import MAX_STATUS, NodeIdentity, encode_status, status
from coview_stream.stream.transport.transport import Connection

LONG = "the place that fits best is 1 in 3 to be wrong, and another one fits as well; " * 8


def told(robot, connection=None):
    return status(robot.session, connection or Connection((), ()), 0, 10.0, 100.0)


def test_usual_status_is_whole():
    document = told(Robot().localized(0.0), Connection(("a" * 32,), ("b" * 32,)))
    text = encode_status(document)
    assert len(text) <= 2500
    assert json.loads(text) == json.loads(json.dumps(document))


def worst():
    robot = Robot().localized(0.0)
    for k in range(12):
        robot.session.errors.add(f"{k}: {LONG}")
    for k in range(1, 8):
        robot.session.restart_search(f"{k} {LONG}")
        robot.frame(2.0 * k, unknown, reason=f"{k} {LONG}")
    document = told(robot, Connection(tuple("a" * 32 for _ in range(50)), tuple("b" * 32 for _ in range(50))))
    document["calibration"] = {**Calibration().to_json(), "says": [LONG] * 6}
    document["node"] = {"id": "c" * 16, "host": "h" * 64, "since": 1.0}
    document["reason"] = LONG
    document["transitions"] = (document["transitions"] or [{"reason": LONG, "evidence": document["evidence"]}]) * 5
    return document


def test_worst_status_is_cut_where_it_matters_least():
    document = worst()
    assert len(json.dumps(document)) > 2 * MAX_STATUS
    text = encode_status(document)
    assert len(text) <= MAX_STATUS
    short = json.loads(text)
    for name in ("robot", "state", "stamp_ns", "map_sha256", "pose", "counters", "latency_ms"):
        assert short[name] == document[name]
    assert {"connection", "transitions", "errors"} <= set(short["shortened"])
    assert document["reason"].startswith(short["reason"].removesuffix(" ..."))


@settings(max_examples=40, deadline=None)
@given(st.text(max_size=1500), st.text(max_size=250), st.lists(st.text(max_size=400), max_size=10))
def test_no_text_makes_it_longer(reason, host, errors):
    document = worst()
    document["reason"], document["errors"], document["node"]["host"] = reason, errors, host[:64]
    assert len(encode_status(document)) <= MAX_STATUS


@pytest.mark.parametrize("length", [1, 64, 200])
def test_long_name_of_a_robot_stays_whole(length):
    document = worst()
    document["robot"] = "r" * length
    short = json.loads(encode_status(document))
    assert short["robot"] == "r" * length


@pytest.mark.parametrize(
    "text",
    [
        b"", b"{", b"[]", b"7", b"null", b'{"node": 3}', b"[" * 100_000, b" " * 70_000,
        *(
            json.dumps({"node": {"id": "a", "term": 1, "period_s": 1.0, "ending": False} | wrong}).encode()
            for wrong in (
                {"id": ""}, {"id": 4}, {"id": "x" * 65}, {"period_s": 0}, {"period_s": -1.0}, {"period_s": 1e9},
                {"period_s": float("nan")}, {"period_s": None}, {"period_s": True}, {"ending": 1}, {"id": "a\nb"},
                {"host": "\x1b[2J"}, {"host": 3}, {"host": "x" * 65},
            )
        ),
    ],
)  # fmt: skip
def test_status_of_a_stranger_names_no_node(text):
    assert NodeIdentity.read(text) is None


def test_node_is_read_as_it_was_written():
    node = NodeIdentity("abc", "machine-7", 0.5)
    assert NodeIdentity.read(json.dumps({"state": "LOST", "node": node.to_json()}).encode()) == node
    assert NodeIdentity.read(json.dumps({"node": node.to_json(ending=True)}).encode()).ending
