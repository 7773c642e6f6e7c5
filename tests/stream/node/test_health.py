"""Health and metrics of a node, its notices to systemd, and clients that read slowly."""

import contextlib
import http.client
import json
import os
import re
import socket
import threading
import time

import pytest
from sockets import until

from coview_stream.errors import ConfigError
from coview_stream.stream.node.health import NodeHealth, Notifier, metrics_server, prometheus_text
from coview_stream.stream.transport.http_server import MAX_CONNECTIONS
from coview_stream.stream.transport.keys import matches, node_keys
from coview_stream.stream.transport.transport import Connection

SAMPLE = re.compile(r'coview_[a-z_]+(\{[a-z_0-9]+="(\\.|[^"\\\n])*"(,[a-z_0-9]+="(\\.|[^"\\\n])*")*\})? -?[0-9.e+-]+')
KEYS = node_keys("coview", "n1")


@contextlib.contextmanager
def running(run, *more):
    """Run a service on a thread of its own."""
    stopping = threading.Event()
    thread = threading.Thread(target=run, args=(stopping, *more), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopping.set()
        thread.join(10.0)
    assert not thread.is_alive()


def test_tracking_node_is_live_and_ready(site):
    site.frame("r1", 0.0)
    document = NodeHealth(site.node).document()
    json.dumps(document)
    assert document["live"] == document["ready"] == {"ok": True, "reasons": []}
    assert document["robots"]["r1"]["state"] == "TRACKING"
    assert document["robots"]["r1"]["counters"]["received"] == 1
    assert set(document["engines"]) == {"track", "search"}


def test_pose_clock_that_stands_still_is_not_live(site):
    site.node.beat = time.monotonic() - 5.0
    document = NodeHealth(site.node).document()
    assert not document["live"]["ok"]
    assert not document["ready"]["ok"]
    assert "pose clock" in document["live"]["reasons"][0]


def test_engine_that_starts_is_not_ready_but_live(site):
    site.search.ready = False
    document = NodeHealth(site.node).document()
    assert document["live"]["ok"]
    assert document["ready"] == {"ok": False, "reasons": ["the search engine is starting"]}


def test_node_that_was_told_to_connect_is_not_ready_without(site):
    site.net.go_away()
    assert NodeHealth(site.node).ready_reasons() == []
    assert NodeHealth(site.node, needs_connection=True).ready_reasons() == ["not connected to any router or peer"]


def test_metrics_are_prometheus_text(site):
    site.frame("r1", 0.0)
    document = NodeHealth(site.node).document()
    document["version"] = 'odd " \\ \n version'
    lines = prometheus_text(document).splitlines()
    samples = [line for line in lines if not line.startswith("#")]
    assert [line for line in samples if not SAMPLE.fullmatch(line)] == []
    assert 'coview_robot_state{robot="r1",state="TRACKING"} 1' in samples
    assert 'coview_events_total{robot="r1",event="received"} 1' in samples
    assert len(samples) == len({line.rpartition(" ")[0] for line in samples})


@pytest.mark.slow
def test_health_is_published_and_answered(site):
    health = NodeHealth(site.node)
    health.answer(KEYS)
    assert site.net.query(KEYS.ask_health)["ready"]["ok"]
    assert site.net.query(KEYS.reload)["ok"] is False  # this node cannot
    with running(health.run, KEYS):
        until(lambda: site.net.samples(KEYS.health))
    assert json.loads(site.net.samples(KEYS.health)[0].payload)["live"]["ok"]


def test_keys_of_a_node_match_no_wildcard():
    for key in (KEYS.health, KEYS.ask_health, KEYS.reload):
        assert not any(matches(wild, key) for wild in ("**", "coview/**", "coview/*/*/rpc/*"))
    with pytest.raises(ConfigError, match="--node"):
        node_keys("coview", "a/b")


@pytest.fixture
def server():
    document = {"ok": True}
    made = metrics_server("127.0.0.1:0", lambda: {"ready": document})
    with running(made.run):
        yield made, document


def asked(server, method, page, **headers):
    connection = http.client.HTTPConnection(server.url[7:-1], timeout=10.0)
    connection.request(method, page, headers=headers)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, body


def test_server_has_two_pages_to_read(server):
    made, document = server
    assert asked(made, "GET", "/health") == (200, b'{"ready": {"ok": true}}\n')
    document["ok"] = False
    assert asked(made, "GET", "/health?now")[0] == 503
    assert asked(made, "GET", "/")[0] == 404
    for method in ("POST", "PUT", "DELETE", "HEAD"):
        assert asked(made, method, "/health")[0] == 501


def test_slow_endless_and_vanishing_readers_are_cut_off(server):
    made, _ = server
    host, port = made.url[7:-1].split(":")
    silent = socket.create_connection((host, int(port)))
    flood = socket.create_connection((host, int(port)))
    flood.settimeout(1.0)
    with contextlib.suppress(OSError):  # sent to nobody in the end
        for _ in range(1000):
            flood.sendall(b"GET /health HTTP/1.0\r\n" + b"X: y\r\n" * 10_000)
    gone = socket.create_connection((host, int(port)))
    gone.close()
    assert asked(made, "GET", "/health")[0] == 200
    silent.close()
    flood.close()


def test_page_of_another_site_whose_name_points_here_reads_nothing(server):
    for page in ("/health", "/metrics"):
        status, body = asked(server[0], "GET", page, Host="rebound.evil.example:9464")
        assert status == 421
        assert b"ready" not in body


@pytest.mark.slow
def test_slow_readers_elsewhere_leave_room_for_the_health_check_of_this_machine():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing
        except OSError:
            pytest.skip("this machine has no address but loopback")
        own = probe.getsockname()[0]
    made = metrics_server("0.0.0.0:0", lambda: {"ready": {"ok": True}})
    port = int(made.url.rstrip("/").rpartition(":")[2])
    with running(made.run), contextlib.ExitStack() as stack:
        for _ in range(MAX_CONNECTIONS + 16):
            slow = stack.enter_context(socket.create_connection((own, port), timeout=5))
            slow.sendall(b"GET /health HTTP/1.0\r\nX:")
        local = stack.enter_context(contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=1.5)))
        local.request("GET", "/health")  # less than they are given to send a request
        assert local.getresponse().status == 200


@pytest.mark.parametrize("address", ["", "nonsense", "127.0.0.1:", "127.0.0.1:99999999", "192.0.2.7:9464"])
def test_bad_address_is_refused(address):
    with pytest.raises(ConfigError, match="--metrics"):
        metrics_server(address, dict)


@pytest.mark.slow
def test_telling_goes_on_after_something_could_not_be_told(site):
    calls = []

    def connection():
        calls.append(1)
        if len(calls) == 1:
            raise RuntimeError("the session is being renewed")
        return Connection(routers=("r",))

    site.net.connection = connection
    with running(NodeHealth(site.node, needs_connection=True).run, KEYS):
        until(lambda: len(calls) > 1)


def test_a_page_that_cannot_be_made_is_reported(caplog):
    def document():
        raise KeyError("engines")

    made = metrics_server("127.0.0.1:0", document)
    with running(made.run), contextlib.suppress(http.client.HTTPException, OSError):
        asked(made, "GET", "/health")
    until(lambda: "metrics" in caplog.text and "engines" in caplog.text)


@pytest.fixture
def manager(tmp_path):
    if not hasattr(socket, "AF_UNIX"):
        pytest.skip("no such sockets")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(10.0)
        yield listening


def test_notices_reach_the_manager(manager):
    notifier = Notifier({"NOTIFY_SOCKET": manager.getsockname()})
    assert notifier.watchdog_period is None
    notifier.ready("serves r1")
    assert manager.recv(500) == b"READY=1\nSTATUS=serves r1"
    notifier.reloading(True, "changing the map")
    first, second, _ = manager.recv(500).decode().splitlines()
    assert first == "RELOADING=1"
    assert int(second.removeprefix("MONOTONIC_USEC=")) > 0
    notifier.reloading(False, "serves r1")
    assert manager.recv(500).startswith(b"READY=1")
    notifier.stopping()
    assert manager.recv(500) == b"STOPPING=1"
    notifier.ready("too late")
    notifier.reloading(True, "too late")
    notifier.reloading(False, "too late")
    manager.setblocking(False)
    with pytest.raises(BlockingIOError):
        manager.recv(500)


def test_watchdog_is_fed_while_the_node_is_live(manager):
    given = {"NOTIFY_SOCKET": manager.getsockname(), "WATCHDOG_USEC": "40000", "WATCHDOG_PID": str(os.getpid())}
    notifier = Notifier(given)
    assert notifier.watchdog_period == pytest.approx(0.02)
    asked, live = [], [True]
    with running(notifier.run, lambda: asked.append(1) or live[0]):
        assert manager.recv(500) == b"WATCHDOG=1"
        live[0] = False
        manager.setblocking(False)
        count = len(asked)
        until(lambda: len(asked) > count + 1)
        with contextlib.suppress(BlockingIOError):
            while True:  # those from before
                manager.recv(500)
        count = len(asked)
        until(lambda: len(asked) > count + 3)
        with pytest.raises(BlockingIOError):
            manager.recv(500)


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"WATCHDOG_USEC": "1000"},
        {"NOTIFY_SOCKET": "/nowhere", "WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"},
        {"NOTIFY_SOCKET": "@nobody", "WATCHDOG_USEC": "soon"},
        {"NOTIFY_SOCKET": "@nobody", "WATCHDOG_USEC": "0"},
    ],
)
def test_nothing_happens_elsewhere(given):
    notifier = Notifier(given)
    assert notifier.watchdog_period is None
    notifier.ready("x")
    notifier.stopping()
    notifier.run(threading.Event(), lambda: True)
