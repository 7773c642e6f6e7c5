"""The node on a network in memory: declared keys, statuses, queries, and its end."""

import json
import threading
import time

import numpy as np
import pytest
from fake_node import STEP, THREADS, Site, declared
from fake_robot import SHA, ns
from sockets import until

from coview_stream import __version__
from coview_stream.config.node import NodeConfig
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.messages import decode_pose
from coview_stream.messages.types import Sample
from coview_stream.stream.node.counters import Counters


def test_node_declares_keys_with_urgencies(pair):
    assert pair.net.subscribed == {
        "coview/r1/in/cloud": "newest",
        "coview/r1/in/odom": "all",
        "coview/r1/in/initial_pose": "all",
        "coview/r2/in/initial_pose": "all",
        "coview/r2/in/cloud": "newest",
        "coview/r2/in/odom": "all",
    }
    urgencies = {p.key: p.urgency for p in pair.net.publishers}
    assert urgencies["coview/r1/out/pose"] == "realtime"
    assert urgencies["coview/r2/out/status"] == "report"
    assert set(pair.net.announced) == {"coview/r1/alive", "coview/r2/alive"}


def test_status_has_all_documented_fields(site):
    status = site.status("r1")
    assert (status["state"], status["reason"]) == ("SEARCHING", "waiting for clouds on coview/r1/in/cloud")
    assert status["pose"]["age_s"] is None
    assert status["pose"]["confidence"] is None
    assert status["latency_ms"] == {"p50": None, "p95": None, "p99": None}
    site.frame("r1", 0.0)
    site.poses("r1")
    site.net.publish(Sample("coview/r1/in/cloud", b"", "video/raw"))
    before = time.time_ns()
    status = site.status("r1")
    assert before <= status["stamp_ns"] <= time.time_ns()
    assert (status["robot"], status["version"], status["map_sha256"]) == ("r1", __version__, SHA)
    assert (status["state"], status["reason"]) == ("TRACKING", "verified")
    assert status["last_frame_ns"] == ns(0.0)
    assert status["evidence"]["score"] == 0.8
    assert status["pose"]["age_s"] == 0.0
    assert status["pose"]["confidence"] == 0.8
    assert status["uptime_s"] >= 0.0
    assert set(status["latency_ms"]) == set(status["engine_ms"]) == {"p50", "p95", "p99"}
    assert status["engine_ms"]["p50"] == 10.0
    assert set(status["counters"]) == set(Counters().to_json())
    assert status["counters"]["unknown_encoding"] == 1
    assert any("video/raw" in text for text in status["errors"])
    assert status["connection"] == {"routers": ["memory"], "peers": [], "reconnects": 0}


def test_status_tells_what_is_corrected_and_stays_small(site):
    assert site.status("r1")["calibration"] is None
    site.frame("r1", 0.0)
    known = Calibration(np.radians(-4.1), np.radians(2.9), -0.051, 0.002)
    site.sessions["r1"].robot_state.calibration = known
    calibration = site.status("r1")["calibration"]
    assert calibration["pitch_deg"] == 2.9
    assert calibration["odometry_scale"] == 0.949
    assert calibration["says"] == known.describe()
    assert len(calibration["says"]) == 3
    assert len(site.net.samples("coview/r1/out/status")[-1].payload) < 3500


def test_pose_rate_in_status(site):
    site.frame("r1", 0.0)
    begin = time.monotonic()
    for k in range(1, 6):
        site.moves("r1", STEP * k)
        site.node.publish_poses(begin + 0.1 * k)
    site.node.reporter.publish(begin + 0.6)
    assert site.statuses("r1")[-1]["pose"]["rate_hz"] == pytest.approx(10.0)
    site.node.reporter.publish(begin + 10.0)
    assert site.statuses("r1")[-1]["pose"]["rate_hz"] == 0.0


def test_only_state_changes_are_published_between_regular_statuses(pair):
    now = time.monotonic()
    pair.node.reporter.publish(now)
    pair.node.reporter.publish(now, all_robots=False)
    assert (len(pair.statuses("r1")), len(pair.statuses("r2"))) == (1, 1)
    pair.frame("r1", 0.0)
    pair.node.reporter.publish(now, all_robots=False)
    pair.node.reporter.publish(now, all_robots=False)
    assert [s["state"] for s in pair.statuses("r1")] == ["SEARCHING", "TRACKING"]
    assert len(pair.statuses("r2")) == 1


@pytest.mark.parametrize(("ask", "state", "received"), [("relocalize", "LOST", 1), ("reset", "SEARCHING", 0)])
def test_request_restarts_one_robot(pair, ask, state, received):
    for name in ("r1", "r2"):
        pair.frame(name, 0.0)
    reply = pair.net.query(f"coview/r1/rpc/{ask}", {"why": "test"})
    assert (reply["ok"], reply["robot"], reply["state"]) == (True, "r1", state)
    json.dumps(reply)
    assert pair.status("r1")["counters"]["received"] == received
    assert pair.status("r2")["state"] == "TRACKING"
    pair.frame("r1", STEP)
    assert pair.status("r1")["state"] == "TRACKING"


def test_close_publishes_last_status_once(site):
    site.frame("r1", 0.0)
    site.status("r1")
    site.node.close()
    last = site.statuses("r1")[-1]
    assert (last["state"], last["reason"]) == ("LOST", "the node is shutting down")
    assert site.net.closed
    assert site.net.announced == ()
    assert (site.track.closed, site.search.closed) == (1, 1)
    count = len(site.net.published)
    site.node.close()
    assert (len(site.net.published), site.track.closed) == (count, 1)


def test_node_with_threads_end_to_end():
    site = Site("r1", "r2", config=NodeConfig(pose_rate=50.0, status_rate=0.05, odometry_timeout=0.2))
    site.node.start()
    try:
        until(lambda: site.statuses("r1"))
        clock = iter(range(100_000))

        def localized():
            k = next(clock)
            site.sees("r1", 0.02 * k)
            site.moves("r2", 0.02 * k)
            return len(site.net.samples("coview/r1/out/pose")) >= 5

        until(localized)
        # the regular status comes every 20 s only: these are told because they change
        until(lambda: site.statuses("r1")[-1]["state"] == "LOST")
        states = [s["state"] for s in site.statuses("r1")]
        assert states[0] == "SEARCHING"
        assert "TRACKING" in states
        assert "no odometry" in site.statuses("r1")[-1]["reason"]
        assert site.net.samples("coview/r2/out/pose") == []
        assert len(site.statuses("r2")) <= 2
        stamps = [decode_pose(s).stamp_ns for s in site.net.samples("coview/r1/out/pose")]
        assert stamps == sorted(stamps)
    finally:
        site.node.close()
    assert site.net.raised == []
    assert site.net.closed
    assert not [t for t in threading.enumerate() if t.name in THREADS]
    assert "shutting down" in site.statuses("r1")[-1]["reason"]


@pytest.mark.parametrize("part", [pytest.param("network", marks=pytest.mark.slow), "publisher"])
def test_close_does_not_wait_for_a_stuck_network(part):
    site = Site("r1")
    site.node.start() if part == "network" else site.node.declare()
    stuck = threading.Event()
    if part == "network":
        site.net.close = stuck.wait
    else:
        for publisher in site.net.publishers:
            publisher.put = lambda message: stuck.wait()
    begin = time.monotonic()
    assert site.node.close(timeout=0.6) is False
    assert time.monotonic() - begin < 5.0
    if part == "network":
        assert (site.track.closed, site.search.closed) == (1, 1)
        assert "shutting down" in site.statuses("r1")[-1]["reason"]
    stuck.set()
    until(lambda: site.node.close(timeout=0.0))


@pytest.mark.parametrize(("away", "losses"), [(True, 0), (False, 1)])
def test_pause_explained_by_network_outage_keeps_the_place(away, losses):
    site = declared("r1")
    site.frame("r1", 0.0)
    site.status("r1")
    if away:
        site.net.go_away()
        site.node.reporter.publish(time.monotonic())
        site.net.come_back()
    site.frame("r1", 4.0)
    status = site.status("r1")
    assert (status["counters"]["losses"], status["connection"]["reconnects"]) == (losses, int(away))
