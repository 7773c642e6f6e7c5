"""Notices to systemd: sent where a socket is named, and nowhere else; they stop when the node is not live."""

import contextlib
import os
import socket
import threading

import pytest
from sockets import until

from coview_stream.stream.node.health import Notifier

pytestmark = pytest.mark.skipif(not hasattr(socket, "AF_UNIX"), reason="no such sockets")


@pytest.fixture
def manager(tmp_path):
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
    stopping, asked, live = threading.Event(), [], [True]
    thread = threading.Thread(target=notifier.run, args=(stopping, lambda: asked.append(1) or live[0]))
    thread.start()
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
    stopping.set()
    thread.join(10.0)


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
