"""The page in a headless Chromium while frames stream: robots drawn, states told, the node lost and found."""

import json
import threading

import numpy as np
import pytest
from fake_robot import KEYS, SHA, cloud, ns
from sockets import until
from web_driver import Browser

from coview_stream.basemap.summary import MapView
from coview_stream.geometry.protection import ProtectionLevel
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.messages import encode_pose
from coview_stream.messages.json_messages import encode_hypotheses
from coview_stream.messages.types import HypothesesMessage, PoseMessage, Sample
from coview_stream.stream.transport.memory_transport import MemoryTransport
from coview_stream.viewers.session_feed import SessionFeed, topics_of_robots
from coview_stream.viewers.web_page import WebPage

pytestmark = pytest.mark.slow

LEVEL, LATENCY = ProtectionLevel(2.5, 1.0, 2.0, 1.5), {"p50": 12.0, "p99": 34.0}
TRACKING = [0, 114, 178]  # colour of the state in the light theme
WRONG = "one place leads: wrong 1 in 2,300, 1 in 10,000 needed <b>&amp;"


def square_map():
    """A plain of 80 m with a block on it."""
    axis = np.arange(-40.0, 40.0, 0.5, dtype=np.float32)
    x, y = (each.ravel() for each in np.meshgrid(axis, axis))
    high = (np.abs(x - 20.0) < 6.0) & (np.abs(y - 20.0) < 6.0)
    points = np.column_stack([x, y, np.where(high, 8.0, 0.0)]).astype(np.float32)
    return MapView(np.array([593_000.0, 5_789_000.0, 40.0]), points, ~high, None, SHA)


class Streaming:
    """A robot that drives in a circle, ten poses and scans a second, and its node's statuses."""

    def __init__(self, view):
        self.net, self.view = MemoryTransport(), view
        self.state, self.reason = "TRACKING", "verified"
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        k = 0
        ring = np.linspace(0.0, 2.0 * np.pi, 400, dtype=np.float32)
        points = np.column_stack([8.0 * np.cos(ring), 8.0 * np.sin(ring), np.ones_like(ring)])
        while not self._ended.wait(0.1):
            k += 1
            yaw = 0.02 * k
            position = self.view.origin + np.array([-15.0 + 10.0 * np.cos(yaw), 10.0 * np.sin(yaw), 1.0])
            T = pose_from(rot_z(yaw), position)
            pose = PoseMessage(ns(0.1 * k), "r1", "TRACKING", T, 0.01 * np.eye(6), 0.99999, SHA, 0.1, "map", LEVEL)
            if self.state == "TRACKING":
                self._put(KEYS.pose, encode_pose(pose, "json"))
            else:
                places = np.array([[*position, yaw, 0.6, 9.0], [*(position + 30.0), 1.0, 0.3, 8.0]])
                self._put(KEYS.hypotheses, encode_hypotheses(HypothesesMessage(1, "r1", places, 0.1, SHA)))
            self.net.publish(cloud(0.1 * k, points))
            status = {"state": self.state, "reason": self.reason, "latency_ms": LATENCY, "map_sha256": SHA}
            self.net.publish(Sample(KEYS.status, json.dumps(status).encode(), "application/json"))

    def _put(self, key, encoded):
        self.net.publish(Sample(key, encoded.payload, encoded.encoding))

    def end(self):
        self._ended.set()
        self._thread.join(5.0)


@pytest.fixture
def stream():
    made = Streaming(square_map())
    yield made
    made.end()


@pytest.fixture
def browser(tmp_path):
    made = Browser(tmp_path / "profile")
    yield made
    made.close()


def served(stream, address="127.0.0.1:0"):
    page = WebPage(address)
    feed = SessionFeed(stream.net, topics_of_robots([KEYS]), stream.view)
    feed.add(page.sink)
    feed.start()
    return page, feed


def cards(browser):
    return browser.run("return document.getElementById('cards').innerText")


def drawn(browser):
    return json.loads(browser.run("return document.getElementById('map').dataset.drawn || '{}'"))


def pixel(browser, x, y):
    script = "const [x, y] = arguments; const context = document.getElementById('map').getContext('2d');"
    return browser.run(f"{script} return [...context.getImageData(x, y, 1, 1).data]", x, y)


def robot_is_blue(browser):
    """Whether the pixel where a robot says it was drawn has its state's colour; it may have been drawn anew since."""
    x, y, state = drawn(browser).get("r1", (0, 0, ""))
    return state == "TRACKING" and np.abs(np.array(pixel(browser, x, y)[:3]) - TRACKING).max() < 40


def test_robot_is_seen_searching_tracking_and_through_a_restart(stream, browser):
    page, feed = served(stream)
    try:
        stream.state, stream.reason = "AMBIGUOUS", WRONG
        browser.open(page.url)
        until(lambda: WRONG in cards(browser), 20.0)  # the whole reason, and as text
        until(lambda: "60.0 %" in cards(browser))
        assert "AMBIGUOUS" in cards(browser)
        assert drawn(browser) == {}

        stream.state, stream.reason = "TRACKING", "verified"
        until(lambda: "r1" in drawn(browser))
        until(lambda: robot_is_blue(browser))
        first = drawn(browser)["r1"][:2]
        until(lambda: np.hypot(*np.subtract(drawn(browser)["r1"][:2], first)) > 3.0)
        told = cards(browser)
        for text in ("TRACKING", "verified", "p50 12, p99 34 ms", "1 in 100,000", "2.00 m", " Hz"):
            assert text in told
        assert "60.0 %" not in told  # no place is considered any more

        browser.run("document.querySelector('.follow').click()")
        size = browser.run("const c = document.getElementById('map'); return [c.width / 2, c.height / 2]")
        until(lambda: np.abs(np.subtract(drawn(browser)["r1"][:2], size)).max() <= 2)

        address = page.url.removeprefix("http://").strip("/")
        feed.close()
        until(lambda: "connection lost" in browser.run("return document.getElementById('link').textContent"), 20.0)
        until(lambda: drawn(browser)["r1"][2] == "silent", 20.0)
        page, feed = served(stream, address)
        until(lambda: browser.run("return document.getElementById('link').textContent") == "live", 20.0)
        until(lambda: drawn(browser)["r1"][2] == "TRACKING", 20.0)

        browser.run("document.getElementById('theme').click(); document.getElementById('theme').click()")
        until(lambda: browser.run("return document.documentElement.dataset.theme") == "dark")
        refused = [
            text for text in browser.complaints() if "ERR_CONNECTION" not in text and "ERR_INCOMPLETE" not in text
        ]
        assert refused == []
    finally:
        feed.close()
