"""Lanes: what a job may come to, and an engine in a process of its own that dies and comes back."""

from __future__ import annotations

import os
import signal

import numpy as np
import pytest
from live import until
from robots import tracking

from coview_stream.basemap.basemap import BaseMap
from coview_stream.errors import CloudError, CoViewError
from coview_stream.fix import State
from coview_stream.stream.jobs import FrameJob
from coview_stream.stream.lane import DiedError, FailedError, InlineLane, ProcessLane, RejectedError


def job(points=None, robot="r1"):
    return FrameJob(
        robot, 1, 1_000_000_000, np.zeros((20, 3), np.float32) if points is None else points, np.eye(4)
    )


class Engine:
    """Does what it is told."""

    def __init__(self, error=None):
        self.error = error
        self.forgotten = []

    def run(self, job):
        if self.error is not None:
            raise self.error
        return tracking(job)

    def forget(self, robot):
        self.forgotten.append(robot)


def test_a_job_done():
    engine = Engine()
    assert InlineLane(engine).run(job()).fix.state is State.TRACKING
    assert engine.forgotten == []


def test_a_job_rejected_costs_the_job_only():
    engine = Engine(CloudError("cloud has 3 finite points"))
    with pytest.raises(RejectedError, match="3 finite points"):
        InlineLane(engine).run(job())
    assert engine.forgotten == []


def test_an_engine_that_failed_forgets_the_robot_and_says_where():
    engine = Engine(ZeroDivisionError("by nothing"))
    with pytest.raises(FailedError) as caught:
        InlineLane(engine).run(job(robot="r7"))
    assert engine.forgotten == ["r7"]
    assert str(caught.value).strip().splitlines()[-1] == "ZeroDivisionError: by nothing"
    assert "Traceback" in str(caught.value)
    engine.error = None
    assert InlineLane(engine).run(job()).fix.state is State.TRACKING


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_process_works_is_killed_and_works_again(world_file, world_drive):
    lane = ProcessLane("track", str(world_file), BaseMap.load(world_file).sha256)
    good = job(world_drive.clouds[0])
    try:
        lane.start()
        lane.wait_ready()
        first = lane.pid
        result = lane.run(good)
        assert result.fix.state is State.SEARCHING
        assert result.query is not None
        np.testing.assert_array_equal(result.query.cloud, world_drive.clouds[0])
        with pytest.raises(RejectedError, match="finite points"):
            lane.run(job(np.zeros((3, 3), np.float32)))
        assert (
            lane.run(good).query is None
        )  # the same child, and it remembers: no keyframe without driving on
        assert lane.pid == first

        os.kill(first, signal.SIGKILL)
        with pytest.raises(DiedError, match="track engine died"):
            lane.run(good)
        result = lane.run(good)
        assert lane.pid != first
        assert result.query is not None  # and this one remembers nothing
    finally:
        second = lane.pid
        lane.close()
    assert lane.pid is None
    until(lambda: not alive(second), 5.0)
    with pytest.raises(DiedError, match="closed"):
        lane.run(good)
    lane.close()


def test_a_map_that_cannot_be_opened(tmp_path):
    broken = tmp_path / "broken.coview"
    broken.write_bytes(b"no map at all")
    lane = ProcessLane("search", str(broken), "0" * 64)
    try:
        lane.start()
        with pytest.raises(CoViewError, match=r"broken\.coview"):
            lane.wait_ready()
    finally:
        lane.close()
    assert lane.pid is None
