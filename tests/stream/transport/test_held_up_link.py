"""Links that are held up or thin: callers do not wait for them, and odometry goes before clouds."""

import logging
import threading
import time
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest
from bad_link import BadLink
from sockets import until
from zenoh_routers import Router

from coview_stream import RobotClient
from coview_stream.messages.types import Encoded
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.zenoh_io import Writer, ZenohPublisher
from coview_stream.stream.transport.zenoh_transport import open_transport

CLOUD = np.random.default_rng(1).uniform(-30, 30, (20_000, 3)).astype(np.float32)  # 240 kB: 2 s at 1 Mbit/s


@pytest.fixture
def linked():
    """A link that may go bad, the client of a robot behind it, and the odometry that a node on its other side gets."""
    with Router() as router, BadLink(router.endpoint) as link, closing(open_transport([router.endpoint])) as node:
        robot, came = RobotClient("r1", link.endpoint), []
        node.subscribe(robot.keys.odometry, came.append, "all")
        node.subscribe(robot.keys.cloud, lambda sample: None, "newest")
        assert robot.wait_for_node(20.0)
        yield link, robot, came
        robot.close()
    until(lambda: not any(thread.name in ("coview closing", "coview writer") for thread in threading.enumerate()), 20.0)


@pytest.mark.slow
def test_half_open_link_holds_up_nothing_that_a_client_calls(linked):
    link, robot, _ = linked
    link.mode("silent")
    longest, end, stamp = 0.0, time.monotonic() + 4.0, 0.0
    while time.monotonic() < end:
        begin, stamp = time.monotonic(), stamp + 0.005
        robot.send_odometry(np.eye(4), stamp)
        robot.send_cloud(CLOUD, stamp)
        longest = max(longest, time.monotonic() - begin)
    assert longest < 1.0  # zenoh's own waits are of many seconds; encoding is of milliseconds
    begin = time.monotonic()
    robot.close()
    assert time.monotonic() - begin < 4.0


@pytest.mark.slow
def test_odometry_goes_before_clouds_on_a_thin_link(linked):
    link, robot, came = linked
    link.mode("thin")
    sent, end = 0, time.monotonic() + 11.0
    while time.monotonic() < end:
        sent += 1
        robot.send_odometry(np.eye(4), 0.05 * sent)
        if sent % 2 == 0:
            robot.send_cloud(CLOUD, 0.05 * sent)
        time.sleep(0.05)
    assert len(came) > 0.4 * sent  # in order of putting it is 0.1: each cloud takes 2 s


@pytest.mark.slow
def test_odometry_that_waits_is_sent_before_a_client_closes(linked):
    _, robot, came = linked
    for number in range(500):
        robot.send_odometry(np.eye(4), 0.005 * number)
    robot.close()
    until(lambda: len(came) == 500, 10.0)


def test_oldest_messages_give_way_and_that_is_logged(caplog):
    guard = RateLimitedErrors(logging.getLogger("coview_stream.test"))
    writer, sent = Writer(guard), []
    publisher = ZenohPublisher("k", guard, writer)
    publisher.put(Encoded(b"before there is a session"))
    publisher.attach(SimpleNamespace(put=lambda payload, **options: sent.append(int(payload))))
    for number in range(1030):
        publisher.put(Encoded(str(number).encode()))
    assert "the oldest odometry is dropped" in caplog.text
    assert not writer.flush(0.01)
    threading.Thread(target=writer.run, daemon=True).start()
    assert writer.flush(10.0)
    assert sent == list(range(6, 1030))  # 1024 wait
    writer.end()
    publisher.put(Encoded(b"after"))
    assert writer.flush(0.01)
