"""Who is connected: what counts as a reconnection, and what only comes and goes."""

from __future__ import annotations

import logging

import pytest

from coview_stream.stream.node.status import ConnectionMonitor
from coview_stream.stream.transport.transport import Connection


def looks(link, *connections):
    for routers, peers in connections:
        link.update(Connection(tuple(routers), tuple(peers)))
    return link.reconnects


@pytest.fixture
def said(caplog):
    caplog.set_level(logging.INFO, "coview_stream.node")
    return lambda: [(r.levelname, r.getMessage()) for r in caplog.records]


def test_first_router_is_not_a_reconnection(said):
    assert looks(ConnectionMonitor(), ("", ""), ("A", ""), ("A", "")) == 0
    assert said() == [("INFO", "connected to router A")]


def test_returning_router_is_a_reconnection(said):
    assert looks(ConnectionMonitor(), ("A", ""), ("", ""), ("A", ""), ("", ""), ("A", "")) == 2
    assert said()[1:3] == [
        ("WARNING", "router A is gone: no subscriber can be reached"),
        ("INFO", "connected to router A again"),
    ]


def test_router_replaced_between_two_polls_is_a_reconnection(said):
    assert looks(ConnectionMonitor(), ("A", ""), ("B", ""), ("B", "")) == 1
    assert said()[-1] == ("INFO", "connected to router B instead of A")


def test_router_replaced_after_outage_and_additional_router():
    link = ConnectionMonitor()
    assert looks(link, ("A", ""), ("", ""), ("B", "")) == 1
    assert looks(link, ("BC", "")) == 1  # no router was missed


def test_losing_one_of_two_routers_is_a_reconnection(said):
    link = ConnectionMonitor()
    assert looks(link, ("AB", ""), ("A", ""), ("AB", "")) == 1
    assert said()[-2:] == [("WARNING", "router B is gone"), ("INFO", "connected to router B again")]


def test_peers_are_not_reconnections(said):
    assert looks(ConnectionMonitor(), ("", "p"), ("", ""), ("", "pq"), ("", "q")) == 0
    assert {level for level, _ in said()} == {"INFO"}
    assert said()[-1][1] == "peer p is gone"


def test_connected_peer_does_not_hide_router_loss():
    assert looks(ConnectionMonitor(), ("A", "p"), ("", "p"), ("A", "p")) == 1
