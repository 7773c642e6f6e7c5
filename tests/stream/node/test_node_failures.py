"""Failures of one robot and of the engines, and whose turn it is."""

import json
import time

import numpy as np
import pytest
from fake_node import STEP, Site, declared
from fake_robot import ns, search_request, tracking, unknown
from sockets import until

from coview_stream.config.node import NodeConfig
from coview_stream.errors import CloudError
from coview_stream.localization.result import Fix
from coview_stream.localization.state import State
from coview_stream.messages.types import Sample
from coview_stream.stream.node.engine_process import DiedError
from coview_stream.stream.node.engine_queue import FrameResult
from coview_stream.stream.node.health import NodeHealth


@pytest.mark.slow
@pytest.mark.parametrize("error", [ValueError("a\x1b[2J"), RecursionError("deep"), MemoryError(), LookupError("utf")])
def test_service_goes_on_after_any_exception_which_health_shows(error):
    site, calls = Site("r1"), []

    def service(stopping):
        calls.append(1)
        if len(calls) < 3:
            raise error
        stopping.wait()

    site.node.start({"map source": service})
    try:
        until(lambda: len(calls) == 3)
        document = NodeHealth(site.node).document()
        assert document["live"] == {"ok": True, "reasons": []}
        assert type(error).__name__ in document["faults"]["map source"]
        assert document["faults"]["map source"].isprintable()
    finally:
        site.node.close(5.0)


def test_statuses_of_strangers_silence_no_robot(site):
    claims = {"id": "0", "period_s": 60.0, "term": 1e9, "ending": False, "host": "elsewhere"}
    stranger = {"robot": "r1", "state": "TRACKING", "stamp_ns": 2**62, "node": claims}
    for k in range(5):
        site.net.publish(Sample("coview/r1/out/status", json.dumps(stranger).encode(), "application/json"))
        site.frame("r1", STEP * k)
        assert len(site.poses("r1")) == k + 1
    assert site.status("r1")["state"] == "TRACKING"
    assert NodeHealth(site.node).document()["ready"]["ok"]


def test_failures_of_one_robot_do_not_affect_others(pair):
    rng = np.random.default_rng(5)
    pair.engine.failing["r1"] = ZeroDivisionError("boom")
    for k in range(10):
        for key in ("coview/r1/in/cloud", "coview/r1/in/odom"):
            for encoding in ("", "application/json", "application/cdr", "video/raw", "application/protobuf"):
                pair.net.publish(Sample(key, rng.bytes(50), encoding))
        pair.frame("r1", STEP * k)
        pair.frame("r2", STEP * k)
        pair.node.publish_poses(time.monotonic())
    assert pair.net.raised == []
    assert len(pair.net.samples("coview/r2/out/pose")) == 10
    assert pair.net.samples("coview/r1/out/pose") == []
    bad, good = pair.status("r1"), pair.status("r2")
    assert bad["counters"]["engine_errors"] == 10
    assert bad["counters"]["malformed"] + bad["counters"]["unknown_encoding"] == 50
    assert "r1: frames that the engine failed at; the first: ZeroDivisionError: boom" in bad["errors"]
    assert good["state"] == "TRACKING"
    assert good["errors"] == []
    assert {n: c for n, c in good["counters"].items() if c} == {
        "received": 10,
        "processed": 10,
        "odometry_received": 10,
        "fixes": 1,
        "poses": 10,
    }


def test_rejected_frame_keeps_the_pose(site):
    site.frame("r1", 0.0)
    site.engine.failing["r1"] = CloudError("cloud has 3 finite points")
    site.frame("r1", STEP)
    assert site.poses("r1")[-1].stamp_ns == ns(STEP)
    status = site.status("r1")
    assert (status["state"], status["counters"]["rejected"]) == ("TRACKING", 1)
    assert status["errors"] == ["r1: frames of no use; the first: cloud has 3 finite points"]


def test_dead_track_engine_loses_all_robots(pair):
    for name in ("r1", "r2"):
        pair.frame(name, 0.0)
    pair.track.dead = True
    pair.frame("r1", STEP)
    for name in ("r1", "r2"):
        status = pair.status(name)
        assert (status["state"], status["reason"]) == ("LOST", "the engine was started again: the track engine died")
        assert status["counters"]["engine_restarts"] == 1
        assert pair.poses(name) == []
    for name in ("r1", "r2"):
        pair.frame(name, 2 * STEP)
        assert pair.status(name)["state"] == "TRACKING"


@pytest.mark.slow
def test_engine_that_died_while_idle_is_reported(pair, caplog):
    pair.frame("r1", 0.0)

    def dead():
        raise DiedError("the search engine died (by signal 9)")

    pair.search.watch = dead
    pair.node.feeds[0].watch("search")
    status = pair.status("r1")
    assert (status["state"], status["counters"]["engine_restarts"]) == ("TRACKING", 1)
    assert status["errors"] == ["the search engine is started again: the search engine died (by signal 9)"]
    assert "by signal 9" in caplog.text
    pair.track.watch = dead
    pair.node.feeds[0].watch("track")
    assert pair.status("r1")["state"] == "LOST"


REPLACED = "site.coview: has been replaced by another map; start the node (serve) again"


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["track", "search"])
def test_repeated_engine_restart_reason_is_reported(pair, engine, caplog):
    def die(text):
        def run(job):
            raise DiedError(text)

        return run

    if engine == "track":
        for name in ("r1", "r2"):
            pair.frame(name, 0.0)
    pair.engine.answer = lambda job: unknown(job, ask=search_request())
    for k, text in enumerate(["it died", REPLACED, REPLACED, REPLACED], 1):
        getattr(pair, engine).run = die(text)
        pair.frame("r1", STEP * k)
    for name in ("r1", "r2"):
        status = pair.status(name)
        assert f"the {engine} engine is started again: {REPLACED}" in status["errors"]
        assert (REPLACED in status["reason"]) == (engine == "track")
        assert status["counters"]["losses"] == (engine == "track")
    lines = [r.getMessage() for r in caplog.records if "is started again" in r.getMessage()]
    assert len(lines) == 2  # each text once, for all robots
    assert "it died" in lines[0]
    assert REPLACED in lines[1]


def test_engine_death_is_reported_before_first_frame(site):
    site.track.dead = True
    site.frame("r1", 0.0)
    assert site.status("r1")["reason"] == "frames at which the engine failed: 1; see errors"


def test_dead_search_engine_loses_no_place(pair):
    pair.frame("r1", 0.0)
    pair.engine.answer = lambda job: unknown(job, ask=search_request())
    pair.sees("r2", 0.0)
    pair.search.dead = True
    pair.work("r2")
    assert pair.status("r1")["state"] == "TRACKING"
    status = pair.status("r2")
    counters = status["counters"]
    assert (counters["searches"], counters["search_errors"], counters["engine_restarts"]) == (0, 1, 1)
    assert any("engine died" in text for text in status["errors"])
    pair.frame("r2", STEP)
    assert pair.status("r2")["counters"]["searches"] == 1


def test_robots_are_served_round_robin():
    names = ("r1", "r2", "r3", "r4")
    site = declared(*names)
    served = []
    for k in range(40):
        for name in names:
            for flood in range(10 if name == "r2" else 1):  # one sends ten times as much
                site.sees(name, STEP * k + 0.001 * flood)
        session, job = site.node.feeds[0].next_job("track")
        served.append(job.robot)
        site.node.feeds[0].work("track", session, job)
    assert served == list(names) * 10


@pytest.mark.slow
def test_repeated_failures_are_rate_limited_in_the_log(site, caplog):
    site.engine.failing["r1"] = ValueError("bad frame")
    for k in range(50):
        site.frame("r1", STEP * k)
    assert site.status("r1")["counters"]["engine_errors"] == 50
    lines = [r.getMessage() for r in caplog.records if r.levelname == "ERROR"]
    assert len(lines) == 1
    assert "r1: the track engine" in lines[0]
    assert "bad frame" in lines[0]
    site.track.run = lambda job: 1 / 0
    for k in range(50, 60):
        site.frame("r1", STEP * k)
    assert len([r for r in caplog.records if "unexpected" in r.getMessage()]) == 1


class UnwritableEvidence:
    """Evidence that cannot be written."""

    reason = "none"

    def to_json(self):
        raise RuntimeError("cannot be written")


def unwritable(job, evidence):
    return FrameResult(Fix(job.stamp_ns * 1e-9, State.SEARCHING, evidence=evidence), None, 0.01, ())


def test_failing_status_of_one_robot_does_not_affect_others(pair):
    good = pair.engine.answer
    pair.engine.answer = lambda job: unwritable(job, UnwritableEvidence())
    pair.frame("r1", 0.0)
    for _ in range(3):
        pair.node.reporter.publish(time.monotonic())
    assert len(pair.statuses("r2")) == 3
    assert pair.statuses("r1") == []
    pair.engine.answer = good
    pair.frame("r1", STEP)
    assert pair.status("r1")["robot"] == "r1"


def test_unknown_connection_does_not_stop_statuses(pair):
    def fail():
        raise RuntimeError("cannot ask")

    pair.net.connection = fail
    assert pair.status("r1")["connection"] == {"routers": [], "peers": [], "reconnects": 0}
    assert len(pair.statuses("r2")) == 1


@pytest.mark.slow
def test_failing_status_is_not_retried_in_a_loop():
    config = NodeConfig(pose_rate=200.0, status_rate=2.0)
    site = Site("r1", config=config)
    asked = []

    class Counting(UnwritableEvidence):
        def to_json(self):
            asked.append(time.monotonic())
            return super().to_json()

    site.engine.answer = lambda job: unwritable(job, Counting())
    site.node.start()
    try:
        site.sees("r1", 0.0)
        until(lambda: len(asked) >= 3)
    finally:
        site.node.close()
    assert asked[2] - asked[0] > 0.5


def test_unencodable_pose_of_one_robot_does_not_affect_others():
    site = declared("r1", "r2")
    site.engine.answer = lambda job: tracking(job, sigma=float("nan") if job.robot == "r1" else 0.1)
    for name in ("r1", "r2"):
        site.frame(name, 0.0)
    site.node.publish_poses(time.monotonic())
    assert len(site.net.samples("coview/r2/out/pose")) == 1
