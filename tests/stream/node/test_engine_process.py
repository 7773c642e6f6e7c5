"""Engine runners: results and failures of jobs, and an engine in a process of its own that dies and comes back."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from multiprocessing.connection import Connection

import numpy as np
import pytest
from fake_node import InlineRunner
from fake_robot import tracking
from sockets import until

from coview_stream.basemap.basemap import BaseMap
from coview_stream.errors import CloudError, CoViewError, InputError
from coview_stream.localization.state import State
from coview_stream.stream.node import engine_process, worker
from coview_stream.stream.node.engine_child import EngineChild
from coview_stream.stream.node.engine_process import (
    CancelledError,
    DiedError,
    EngineProcess,
    FailedError,
    RejectedError,
)
from coview_stream.stream.node.jobs import FrameJob


def job(points=None, robot="r1", stamp_ns=1_000_000_000):
    return FrameJob(robot, 1, stamp_ns, np.zeros((20, 3), np.float32) if points is None else points, np.eye(4))


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


def test_completed_job_returns_its_result():
    engine = Engine()
    assert InlineRunner(engine).run(job()).fix.state is State.TRACKING
    assert engine.forgotten == []


def test_rejected_job_keeps_the_engine_state():
    engine = Engine(CloudError("cloud has 3 finite points"))
    with pytest.raises(RejectedError, match="3 finite points"):
        InlineRunner(engine).run(job())
    assert engine.forgotten == []


def test_failed_engine_forgets_the_robot_and_returns_traceback():
    engine = Engine(ZeroDivisionError("by nothing"))
    with pytest.raises(FailedError) as caught:
        InlineRunner(engine).run(job(robot="r7"))
    assert engine.forgotten == ["r7"]
    assert str(caught.value).strip().splitlines()[-1] == "ZeroDivisionError: by nothing"
    assert "Traceback" in str(caught.value)
    engine.error = None
    assert InlineRunner(engine).run(job()).fix.state is State.TRACKING


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
def test_killed_engine_process_is_restarted(world_file, world_drive):
    process = EngineProcess("track", str(world_file), BaseMap.load(world_file).sha256)
    good = job(world_drive.clouds[0])
    try:
        process.start()
        process.wait_ready()
        first = process.pid
        result = process.run(good)
        assert result.fix.state is State.SEARCHING
        assert result.request is not None
        np.testing.assert_array_equal(result.request.cloud, world_drive.clouds[0])
        with pytest.raises(RejectedError, match="finite points"):
            process.run(job(np.zeros((3, 3), np.float32)))
        later = job(world_drive.clouds[0], stamp_ns=1_100_000_000)
        assert process.run(later).request is None  # the same child, and it remembers: no keyframe without driving on
        assert process.pid == first

        os.kill(first, signal.SIGKILL)
        with pytest.raises(DiedError, match="track engine died"):
            process.run(good)
        result = process.run(good)
        assert process.pid != first
        assert result.request is not None  # and this one remembers nothing
    finally:
        second = process.pid
        process.close()
    assert process.pid is None
    until(lambda: not alive(second), 5.0)
    with pytest.raises(DiedError, match="closed"):
        process.run(good)
    process.close()


@pytest.mark.slow
def test_idle_engine_that_is_killed_is_reaped_reported_and_started_again(world_file):
    process = EngineProcess("search", str(world_file), BaseMap.load(world_file).sha256)
    try:
        process.start()
        process.wait_prepared()
        process.watch()
        first = process.pid
        os.kill(first, signal.SIGKILL)
        with pytest.raises(DiedError, match=r"search engine died \(by signal 9\)"):
            until(process.watch, 10.0)
        assert not alive(first)  # nor a zombie
        assert process.pid is None
        process.watch()
        assert process.pid not in (None, first)
        until(lambda: process.watch() or not process._awaited, 60.0)  # ready before a job asks
    finally:
        process.close()
    with pytest.raises(DiedError, match="closed"):
        process.watch()


@pytest.mark.slow
def test_idle_engine_that_cannot_open_its_map_says_why(world_file):
    process = EngineProcess("track", str(world_file), "0" * 64)
    try:
        process.start()
        with pytest.raises(DiedError, match="replaced by another map"):
            until(process.watch, 60.0)
    finally:
        process.close()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_stopped_engine_is_ended_during_a_job(world_file, world_drive):
    process = EngineProcess("track", str(world_file), BaseMap.load(world_file).sha256)
    try:
        process.start()
        process.wait_prepared()
        process.end_stopped()
        process.end_stopped()
        assert process.run(job(world_drive.clouds[0])).fix.state is State.SEARCHING
        os.kill(process.pid, signal.SIGSTOP)
        failed = []

        def run():
            with pytest.raises(DiedError) as caught:
                process.run(job(world_drive.clouds[0]))
            failed.append(str(caught.value))

        thread = threading.Thread(target=run)
        thread.start()
        until(lambda: process.end_stopped() or failed, 10.0)  # not thirty seconds
        thread.join(10.0)
        assert process.run(job(world_drive.clouds[0])).request is not None
    finally:
        process.close()


@pytest.mark.slow
def test_child_that_was_started_before_is_the_first(world_file, world_drive):
    child = EngineChild("track")
    process = EngineProcess("track", str(world_file), BaseMap.load(world_file).sha256, None, child=child)
    try:
        process.start()
        assert process.pid == child.take()[0].pid
        child.close()  # does nothing: it is the engine's
        assert process.run(job(world_drive.clouds[0])).fix.state is State.SEARCHING
        os.kill(process.pid, signal.SIGKILL)
        with pytest.raises(DiedError):
            process.run(job())
        assert process.run(job(world_drive.clouds[0])).request is not None  # another one
    finally:
        process.close()


@pytest.mark.slow
@pytest.mark.parametrize("adopted", [False, True])
def test_child_without_a_map_ends_when_it_is_closed(adopted):
    child = EngineChild("search")
    pid = child._process.pid
    assert alive(pid)
    EngineProcess("search", "unused", "0" * 64, child=child).close() if adopted else child.close()
    assert not alive(pid)
    child.close()


@pytest.mark.slow
def test_child_ends_with_its_parent():
    code = "from coview_stream.stream.node.engine_child import EngineChild; print(EngineChild('track')._process.pid)"
    paths = os.pathsep.join(p for p in sys.path if p)
    pid = int(subprocess.check_output([sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": paths}))
    until(lambda: not alive(pid), 30.0)


@pytest.mark.slow
def test_unreadable_map_fails_wait_ready(tmp_path):
    broken = tmp_path / "broken.coview"
    broken.write_bytes(b"no map at all")
    process = EngineProcess("search", str(broken), "0" * 64)
    try:
        process.start()
        with pytest.raises(CoViewError, match=r"broken\.coview"):
            process.wait_ready()
    finally:
        process.close()
    assert process.pid is None


def test_engine_that_cannot_prepare_reports_why_each_time(monkeypatch):
    """And the child ends: the next job starts another, which may do better."""

    class Unprepared(Engine):
        kernels = ()

        def prepare(self):
            raise InputError("ground.onnx: no weights of the ground network; train them")

    monkeypatch.setattr("coview_stream.stream.node.engines.open_engine", lambda *given: Unprepared())
    ended = []

    class Thread:
        """A child that is a thread of this process."""

        def __init__(self, kind, nice):
            self.ours, theirs = socket.socketpair()
            given = [str(theirs.detach()), kind, str(nice)]
            threading.Thread(target=lambda: ended.append(worker.main(given)), daemon=True).start()

        def take(self):
            return None, Connection(self.ours.detach())

    monkeypatch.setattr(engine_process, "EngineChild", Thread)
    monkeypatch.setattr("coview_stream.stream.node.engines.kernels_of", lambda kind: ((), ()))
    process = EngineProcess("search", "unused", "0" * 64)
    for times in (1, 2):
        with pytest.raises(DiedError, match=r"no weights of the ground network; train them"):
            process.run(job())
        until(lambda times=times: ended == [1] * times, 5.0)
    process.close()


@pytest.mark.slow
def test_replaced_map_is_reported_each_time(world_file):
    process = EngineProcess("track", str(world_file), "0" * 64)
    try:
        for _ in range(2):
            with pytest.raises(DiedError, match=r"has been replaced by another map; start the node \(serve\) again"):
                process.run(job())
    finally:
        process.close()


@pytest.mark.slow
def test_hung_worker_is_killed_during_send(world_file, world_drive):
    process = EngineProcess("track", str(world_file), BaseMap.load(world_file).sha256, job_timeout=30.0)
    good = job(world_drive.clouds[0])
    try:
        process.start()
        process.run(good)
        first = process.pid
        os.kill(first, signal.SIGSTOP)
        process.job_timeout = 0.3
        with pytest.raises(DiedError, match=r"no answer for 0\.3 s"):
            process.run(job(np.zeros((1_000_000, 3), np.float32)))  # far more than a pipe holds
        until(lambda: not alive(first), 5.0)
        process.job_timeout = 30.0
        assert process.run(good).request is not None
    finally:
        process.close()


def with_child(process, program):
    """Give a process a child that runs ``program``, which finds its end of the pipe as ``fd``."""
    ours, theirs = socket.socketpair()
    with theirs:
        code = f"import os, time; fd = {theirs.fileno()}\n{program}"
        process._child = subprocess.Popen([sys.executable, "-c", code], pass_fds=[theirs.fileno()])
    process._pipe = Connection(ours.detach())


@pytest.mark.slow
def test_truncated_answer_kills_the_worker():
    process = EngineProcess("search", "unused", "0" * 64, job_timeout=0.3)
    with_child(process, "os.write(fd, (1000).to_bytes(4, 'big') + b'half'); time.sleep(60)")
    child = process.pid
    with pytest.raises(DiedError, match=r"search engine had no answer for 0\.3 s"):
        process.run(job())
    until(lambda: not alive(child), 5.0)
    process.close()


@pytest.mark.slow
def test_opening_has_its_own_timeout_and_can_be_cancelled():
    process = EngineProcess("track", "unused", "0" * 64, job_timeout=0.01, open_timeout=0.3)
    with_child(process, "time.sleep(60)")
    process._awaited = ["ready", "prepared"]
    asked = []

    def cancelled():
        asked.append(1)
        return len(asked) == 2

    with pytest.raises(CancelledError, match="track"):
        process.wait_ready(cancelled)
    with pytest.raises(DiedError, match=r"no answer for 0\.3 s"):
        process.wait_ready()
    process.close()


@pytest.mark.slow
def test_wait_until_prepared_can_be_cancelled():
    process = EngineProcess("track", "unused", "0" * 64, open_timeout=5.0)
    with_child(process, "time.sleep(60)")
    process._awaited = ["prepared"]
    with pytest.raises(CancelledError, match="track"):
        process.wait_prepared(lambda: True)
    process.close()


@pytest.mark.slow
def test_close_ends_a_running_job():
    process = EngineProcess("track", "unused", "0" * 64)
    with_child(process, "time.sleep(60)")
    timer = threading.Timer(0.2, process.close)
    timer.start()
    with pytest.raises(DiedError, match="died"):
        process.run(job())
    timer.join()
    until(lambda: "coview-watch-track" not in [thread.name for thread in threading.enumerate()])
