"""Failures of one robot and of the engines, and whose turn it is."""

from __future__ import annotations

import time

import numpy as np
import pytest
from robots import ns, query, unknown
from sites import STEP, Site

from coview_stream.errors import CloudError
from coview_stream.stream.messages import Sample


@pytest.fixture
def site():
    made = Site("r1")
    made.node.declare()
    return made


@pytest.fixture
def pair():
    made = Site("r1", "r2")
    made.node.declare()
    return made


def test_one_robots_garbage_and_failures_are_its_own(pair):
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
    assert any("ZeroDivisionError: boom" in error for error in bad["errors"])
    assert good["state"] == "TRACKING"
    assert good["errors"] == []
    assert {n: c for n, c in good["counters"].items() if c} == {
        "received": 10,
        "processed": 10,
        "odometry_received": 10,
        "fixes": 1,
        "poses": 10,
    }


def test_a_rejected_frame_leaves_the_pose(site):
    site.frame("r1", 0.0)
    site.engine.failing["r1"] = CloudError("cloud has 3 finite points")
    site.frame("r1", STEP)
    assert site.poses("r1")[-1].stamp_ns == ns(STEP)
    status = site.status("r1")
    assert (status["state"], status["counters"]["rejected"]) == ("TRACKING", 1)
    assert status["errors"] == ["r1: frames of no use; the first: cloud has 3 finite points"]


def test_an_engine_that_died_has_forgotten_all_robots(pair):
    for name in ("r1", "r2"):
        pair.frame(name, 0.0)
    pair.track.dead = True
    pair.frame("r1", STEP)
    for name in ("r1", "r2"):
        status = pair.status(name)
        assert (status["state"], status["reason"]) == ("LOST", "the engine was started again")
        assert status["counters"]["engine_restarts"] == 1
        assert pair.poses(name) == []
    for name in ("r1", "r2"):
        pair.frame(name, 2 * STEP)
        assert pair.status(name)["state"] == "TRACKING"


def test_a_search_engine_that_died_loses_no_place(pair):
    def ask(job):
        return unknown(job, ask=query())

    pair.frame("r1", 0.0)
    pair.engine.answer = ask
    pair.sees("r2", 0.0)
    pair.search.dead = True
    pair.work("r2")
    assert pair.status("r1")["state"] == "TRACKING"
    status = pair.status("r2")
    assert status["counters"]["searches"] == 1
    pair.frame("r2", STEP)
    assert pair.status("r2")["counters"]["searches"] == 2


def test_robots_take_turns():
    names = ("r1", "r2", "r3", "r4")
    site = Site(*names)
    site.node.declare()
    served = []
    for k in range(40):
        for name in names:
            for flood in range(10 if name == "r2" else 1):  # one sends ten times as much
                site.sees(name, STEP * k + 0.001 * flood)
        session, job = site.node.next_job("track")
        served.append(job.robot)
        site.node.work("track", session, job)
    assert served == list(names) * 10
