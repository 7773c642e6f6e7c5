"""Statuses: bounded in size, with the router's reconnections and the places that a search considers."""

import json
import logging
import time
from dataclasses import replace

import numpy as np
import pytest
from fake_robot import SHA, Robot, search_request, search_result, tracking, unknown
from hypothesis import given, settings
from hypothesis import strategies as st

from coview_stream.basemap.basemap import BaseMap
from coview_stream.errors import TransportError
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.search.acceptance import Considered
from coview_stream.messages.json_messages import decode_hypotheses
from coview_stream.stream.node.robot_endpoints import MapViewAnswer
from coview_stream.stream.node.status import MAX_STATUS, ConnectionMonitor, encode_status, status
from coview_stream.stream.transport.keys import NodeIdentity
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
    document["reason"], document["robot"] = LONG, "r" * 200
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


@pytest.mark.parametrize(
    "text",
    [
        b"", b"{", b"[]", b"7", b"null", b'{"node": 3}', b"[" * 100_000, b" " * 70_000,
        *(
            json.dumps({"node": {"id": "a", "period_s": 1.0, "ending": False} | wrong}).encode()
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


GONE = ("WARNING", "router A is gone: no subscriber can be reached")


@pytest.mark.parametrize(
    ("connections", "reconnects", "lines"),
    [
        ((" ", "A", "A"), 0, [("INFO", "connected to router A")]),
        (("A", " ", "A", " ", "A"), 2, [GONE, ("INFO", "connected to router A again")]),
        (("A", "B", "B"), 1, [("INFO", "connected to router B instead of A")]),  # between two looks
        (("A", " ", "B", "BC"), 1, [("INFO", "connected to router C")]),  # no router was missed
        (("AB", "A", "AB"), 1, [("WARNING", "router B is gone"), ("INFO", "connected to router B again")]),
        ((" p", " ", " pq", " q"), 0, [("INFO", "peer p is gone")]),
        (("A p", " p", "A p"), 1, [GONE, ("INFO", "connected to router A again")]),
    ],
)
def test_a_router_that_comes_back_or_is_replaced_is_a_reconnection(caplog, connections, reconnects, lines):
    caplog.set_level(logging.INFO, "coview_stream.node")
    monitor = ConnectionMonitor()
    for text in connections:
        routers, _, peers = text.partition(" ")
        monitor.update(Connection(tuple(routers), tuple(peers)))
    assert monitor.reconnects == reconnects
    assert [(record.levelname, record.getMessage()) for record in caplog.records][-len(lines) :] == lines


PLACES = Considered(1.5, np.array([[1.0, 2.0, 3.0, 0.5, 0.7, 9.0], [4.0, 5.0, 6.0, -0.5, 0.1, 2.0]]), 0.2)


@pytest.fixture
def searched(site):
    """The session of a robot that has been searched for once, in vain."""
    session = site.sessions["r1"]
    site.engine.answer = lambda job: unknown(job, ask=search_request())
    site.sees("r1", 0.0)
    site.node.feeds[0].work("track", session, session.take_job("track"))
    session.handle_result(session.take_job("search"), replace(search_result(), considered=PLACES), time.monotonic())
    return session


def published(site, all_robots=True):
    site.node.reporter.publish(time.monotonic(), all_robots)
    return [decode_hypotheses(s) for s in site.net.samples(site.keys["r1"].hypotheses)]


def test_places_go_out_with_the_status_of_each_second(site, searched):
    assert published(site, all_robots=False) == []  # a change of state brings none
    (message,) = published(site)
    assert np.allclose(message.places, PLACES.places)
    assert (message.none, message.stamp_ns, message.map_sha256) == (0.2, 1_500_000_000, SHA)


@pytest.mark.parametrize("how", ["found", "begun anew"])
def test_of_a_robot_with_a_place_or_another_odometry_frame_no_places_go_out(site, searched, how):
    if how == "found":
        site.engine.answer = tracking
        site.frame("r1", 0.1)
    else:
        searched.restart_search("asked to search again", forget=True)
    assert searched.state()[0].has_place == (how == "found")
    assert published(site) == []


def test_another_kind_of_reason_is_logged_but_not_each_number(site, caplog):
    caplog.set_level(logging.INFO, "coview_stream.node")
    reasons = iter(["no place fits", "14 places would fit", "13 places would fit", "no place fits"])
    site.engine.answer = lambda job: unknown(job, reason=next(reasons))
    now, lines = time.monotonic(), []
    site.node.reporter.publish(now)
    for k in range(4):
        site.frame("r1", 0.1 * k)
        for later in (1.0, 19.0):
            caplog.clear()
            site.node.reporter.publish(now + 20.0 * k + later)
            lines.append(caplog.messages)
    first, other = ["r1: SEARCHING (no place fits)"], ["r1: SEARCHING (14 places would fit)"]
    assert lines == [[], first, [], other, [], [], first, []]


def test_a_map_view_is_of_the_map_that_is_served(site, world_file):
    served = [BaseMap.load(world_file).sha256]
    key = site.keys["r1"].map_view
    site.net.answer(key, MapViewAnswer({served[0]: world_file, "00": world_file}, lambda: served[0]))
    view = site.net.query(key)
    assert view["map_sha256"] == served[0]
    assert view["count"] > 1000
    assert site.net.query(key) is view  # made once
    served[0] = "00"
    with pytest.raises(TransportError, match="another map"):
        site.net.query(key)
