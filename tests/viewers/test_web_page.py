"""The server of the web page: its files and events, refusals, and that it waits for no client."""

import contextlib
import http.client
import json
import re
import socket
import time
from importlib import resources

import numpy as np
import pytest
from sockets import until

from coview_stream.errors import ConfigError
from coview_stream.messages.types import PoseMessage
from coview_stream.stream.transport.http_server import MAX_CONNECTIONS, known_host
from coview_stream.viewers.web_page import WebPage
from coview_stream.viewers.web_sink import MAX_PAGES


@pytest.fixture
def served():
    page = WebPage("127.0.0.1:0")
    yield page
    page.close()


def port(page):
    return int(page.url.rsplit(":", 1)[1].strip("/"))


def get(page, path, host=None, method="GET"):
    connection = http.client.HTTPConnection("127.0.0.1", port(page), timeout=10)
    connection.request(method, path, headers={} if host is None else {"Host": host})
    answer = connection.getresponse()
    body = b"" if path == "/events" and answer.status == 200 else answer.read()
    return answer, body


def pose(robot="r1", x=0.0):
    T = np.eye(4)
    T[0, 3] = x
    return PoseMessage(1, robot, "TRACKING", T, np.eye(6), 0.9, "ab")


def test_the_page_and_its_parts_come_with_headers_that_bind_them(served):
    answer, body = get(served, "/")
    assert answer.status == 200
    policy = answer.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert answer.headers["Access-Control-Allow-Origin"] is None
    assert answer.headers["X-Content-Type-Options"] == "nosniff"
    for part in re.findall(r'(?:src|href)="([^"]+)"', body.decode()):
        assert get(served, f"/{part}")[0].status == 200, part


def test_all_scripts_that_are_imported_are_served(served):
    folder = resources.files("coview_stream.viewers") / "web"
    for name in [each.name for each in folder.iterdir() if each.name.endswith(".js")]:
        for other in re.findall(r'from "\./([\w.]+)"', (folder / name).read_text(encoding="utf-8")):
            assert get(served, f"/{other}")[0].status == 200, other


def test_nothing_in_the_page_comes_from_elsewhere():
    folder = resources.files("coview_stream.viewers") / "web"
    for file in folder.iterdir():
        found = re.findall(r"https?://[^\s\"']+", file.read_text(encoding="utf-8"))
        assert [url for url in found if url != "http://www.w3.org/2000/svg"] == [], file.name


@pytest.mark.parametrize(
    ("request_of", "paths", "status"),
    [
        ({}, ["/../web_page.py", "/%2e%2e/web_page.py", "/map/", "/map/ab", "/nothing", "//etc"], 404),
        *(({"method": method}, ["/"], 501) for method in ("POST", "PUT", "DELETE", "OPTIONS")),
        ({"host": "evil.example:8642"}, ["/", "/events", "/map/ab"], 421),
    ],
)
def test_unknown_paths_methods_and_hosts_are_refused(served, request_of, paths, status):
    for path in paths:
        assert get(served, path, **request_of)[0].status == status, path


def test_hosts_are_known_by_address_by_localhost_and_by_their_own_name():
    for header in (
        "127.0.0.1:8642",
        "[::1]:8642",
        "localhost",
        "LOCALHOST:1",
        "192.168.0.7:80",
        "rover.lan:8642",
        "coview:9464",
    ):
        assert known_host(header, "rover.lan"), header
    for header in (
        None,
        "",
        "evil.example",
        "localhost.evil.example",
        "127.0.0.1.evil.example",
        "[evil]",
        ":80",
        "rover.lan",
    ):
        assert not known_host(header, "127.0.0.1"), header


def test_events_come_as_they_are_published(served):
    answer, _ = get(served, "/events")
    assert answer.headers["Content-Type"].startswith("text/event-stream")
    served.sink.pose(pose(x=3.5))
    for line in answer:
        if line.startswith(b"data:") and b"robot" in line and b"stamp" in line:
            assert json.loads(line[5:])["x"] == 3.5
            break


def test_too_many_pages_are_told_so(served):
    kept = [get(served, "/events") for _ in range(MAX_PAGES)]
    assert get(served, "/events")[0].status == 503
    assert get(served, "/")[0].status == 200
    del kept


@pytest.mark.slow
def test_a_page_that_reads_nothing_is_dropped_and_holds_up_nobody(served):
    with socket.create_connection(("127.0.0.1", port(served))) as idle:
        idle.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        idle.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        hub = served.sink._hub
        until(lambda: hub.pages == 1)
        longest, end = 0.0, time.monotonic() + 20.0
        while hub.pages and time.monotonic() < end:
            before = time.monotonic()
            served.sink.status("r1", {"reason": "x" * 400, "errors": ["y" * 400] * 8})
            longest = max(longest, time.monotonic() - before)
            time.sleep(0.001)
        assert hub.pages == 0
    assert longest < 0.2  # far below the time that the page was waited for by its own thread


@pytest.mark.slow
def test_more_connections_than_allowed_are_hung_up_on(served):
    with contextlib.ExitStack() as stack:

        def connect():
            return stack.enter_context(socket.create_connection(("127.0.0.1", port(served)), timeout=5))

        for _ in range(MAX_CONNECTIONS):
            connect().sendall(b"GET / HT")  # half a request
        time.sleep(0.5)  # they have been accepted
        assert connect().recv(1) == b""


@pytest.mark.parametrize("address", ["127.0.0.1:99999", "127.0.0.1:x", "203.0.113.9:0"])
def test_an_address_that_cannot_be_listened_on_is_refused_with_a_remedy(address):
    with pytest.raises(ConfigError, match=r"--web .* such as 127\.0\.0\.1:8642"):
        WebPage(address)


def test_an_address_that_others_reach_is_warned_of(caplog):
    with caplog.at_level("WARNING"):
        WebPage("0.0.0.0:0").close()
    assert "no password" in caplog.text
