"""Engine runners: results and failures of jobs, and an engine in a process of its own that dies and comes back."""

import contextlib
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import traceback
from multiprocessing.connection import Connection
from types import SimpleNamespace

import numpy as np
import pytest
from fake_node import Runner
from sockets import until

from coview_stream.basemap.basemap import BaseMap
from coview_stream.stream.node import engine_process
from coview_stream.stream.node.engine_process import (
    CancelledError,
    DiedError,
    EngineChild,
    EngineProcess,
    FailedError,
    RejectedError,
    engine_environment,
)
from coview_stream.stream.node.engine_queue import FrameJob


def job(points=None, robot="r1", stamp_ns=1_000_000_000):
    return FrameJob(robot, 1, stamp_ns, np.zeros((20, 3), np.float32) if points is None else points, np.eye(4))


def test_failed_engine_forgets_the_robot_and_returns_traceback():
    def run(job):
        raise ZeroDivisionError("by nothing")

    forgotten = []
    with pytest.raises(FailedError) as caught:
        Runner(SimpleNamespace(run=run, forget=forgotten.append)).run(job(robot="r7"))
    assert forgotten == ["r7"]
    assert str(caught.value).strip().splitlines()[-1] == "ZeroDivisionError: by nothing"
    assert "Traceback" in str(caught.value)


@pytest.fixture
def engine():
    """Make engine processes, and close them at the end."""
    made = []

    def make(kind, path=None, **more):
        sha256 = "0" * 64 if path is None else BaseMap.load(path).sha256
        made.append(EngineProcess(kind, str(path or "unused"), **{"sha256": sha256} | more))
        return made[-1]

    yield make
    for process in made:
        process.close()


@contextlib.contextmanager
def checked(process):
    """Check a process as the feed of the engines does, but more often; a stopped one is left alone."""
    over = threading.Event()

    def check():
        while not over.wait(0.05):
            process.end_hung_job()

    thread = threading.Thread(target=check)
    thread.start()
    yield
    over.set()
    thread.join()


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
@pytest.mark.parametrize("adopted", [False, True])
def test_child_without_a_map_ends_when_it_is_closed(engine, adopted):
    child = EngineChild("search")
    pid = child.process.pid
    assert alive(pid)
    engine("search", child=child).close() if adopted else child.close()
    assert not alive(pid)
    child.close()


@pytest.mark.slow
def test_hung_worker_is_killed_during_send(engine, world_file, world_drive):
    process = engine("track", world_file, job_timeout=30.0)
    good = job(world_drive.clouds[0])
    process.start()
    process.run(good)
    first = process.pid
    os.kill(first, signal.SIGSTOP)
    process.job_timeout = 0.3
    with checked(process), pytest.raises(DiedError, match=r"no answer for 0\.3 s") as caught:
        process.run(job(np.zeros((1_000_000, 3), np.float32)))  # far more than a pipe holds
    frames = [frame for frame, _ in traceback.walk_tb(caught.value.__cause__.__traceback__)]
    views = [value for frame in frames for value in frame.f_locals.values() if isinstance(value, memoryview)]
    assert all(isinstance(view.obj, bytes) for view in views)  # Python 3.12.1 crashes on views of a BytesIO
    until(lambda: not alive(first), 5.0)
    process.job_timeout = 30.0
    assert process.run(good).request is not None


READY = "[pipe.send((name, None)) for name in ('ready', 'prepared')]\n"


class Program:
    """A child that runs a program, which has its end of the pipe as ``pipe``, its descriptor as ``fd``."""

    def __init__(self, program):
        ours, theirs = socket.socketpair()
        with theirs:
            start = (
                f"import os, time, multiprocessing.connection as mc; fd = {theirs.fileno()}; pipe = mc.Connection(fd)"
            )
            command = [sys.executable, "-c", f"{start}\n{program}"]
            self.process = subprocess.Popen(command, pass_fds=[theirs.fileno()], start_new_session=True)
        self.pipe = Connection(ours.detach())

    close = EngineChild.close


@pytest.mark.slow
def test_truncated_answer_kills_the_worker(engine):
    child = Program(READY + "os.write(fd, (1000).to_bytes(4, 'big') + b'half'); time.sleep(60)")
    process = engine("search", child=child, job_timeout=0.3)
    pid = child.process.pid
    with checked(process), pytest.raises(DiedError, match=r"search engine had no answer for 0\.3 s"):
        process.run(job())
    until(lambda: not alive(pid), 5.0)


@pytest.mark.slow
def test_opening_has_its_own_timeout_and_can_be_cancelled(engine):
    child = Program("time.sleep(60)")
    process = engine("track", child=child, job_timeout=0.01, open_timeout=0.3)
    process.start()
    asked = []

    def cancelled():
        asked.append(1)
        return len(asked) == 2

    with pytest.raises(CancelledError, match="track"):
        process.wait_ready(cancelled)
    with pytest.raises(DiedError, match=r"no answer for 0\.3 s"):
        process.wait_ready()


@pytest.mark.slow
def test_every_step_of_a_start_begins_the_wait_anew(engine, monkeypatch, caplog):
    steps = "for k in (1, 2, 2, 3):\n    pipe.send(('step', f'{pipe.recv()} {k} of 3'))\n"
    child = Program("pipe.recv()\n" + steps + READY)
    process = engine("track", child=child, open_timeout=120.0)
    now = 0.0
    monkeypatch.setattr(engine_process, "time", SimpleNamespace(monotonic=lambda: now))
    process.start()

    def step():
        nonlocal now
        now += 100.0
        child.pipe.send("compiling")
        assert child.pipe.poll(60.0)
        return False

    with caplog.at_level(logging.INFO):
        process.wait_prepared(step)
    assert process.ready
    assert caplog.messages == [f"track engine: compiling {k} of 3" for k in (1, 2, 3)]


@pytest.mark.slow
def test_engine_that_cannot_prepare_says_why(engine):
    child = Program("pipe.send(('ready', None)); pipe.send(('error', 'ground.npz: no weights; train them'))")
    process = engine("search", child=child)
    with pytest.raises(DiedError, match="no weights; train them"):
        process.run(job())
    assert process.pid is None


@pytest.mark.slow
def test_close_ends_a_running_job(engine):
    process = engine("track", child=Program(READY + "time.sleep(60)"))
    timer = threading.Timer(0.5, process.close)
    timer.start()
    with pytest.raises(DiedError, match="died"):
        process.run(job())
    timer.join()
    for again in (process.watch, lambda: process.run(job())):
        with pytest.raises(DiedError, match="closed"):
            again()


@pytest.mark.parametrize(("cores", "threads"), [(1, "1"), (2, "1"), (8, "7")])
def test_searches_leave_a_core_to_the_others(monkeypatch, available_cores, cores, threads):
    available_cores(cores)
    monkeypatch.delenv("COVIEW_THREADS", raising=False)
    assert engine_environment("search")["COVIEW_THREADS"] == threads
    assert "COVIEW_THREADS" not in engine_environment("track")


def test_threads_that_the_user_asks_for_are_given(monkeypatch):
    monkeypatch.setenv("COVIEW_THREADS", "5")
    assert {engine_environment(kind)["COVIEW_THREADS"] for kind in ("search", "track")} == {"5"}
    assert engine_environment("search")["OPENBLAS_NUM_THREADS"] == "1"


LACKING = """
from coview_stream.errors import DependencyError
from coview_stream.stream.node.engine_process import work
class Engine:
    prepared = ""
    def prepare(self):
        pass
    def prepare_later(self):
        self.prepared = ", also later"
        raise DependencyError("no scipy")
    def rest(self):
        pass
    def run(self, job):
        self.on_doubt()
        raise DependencyError("no scipy" + self.prepared)
work(pipe, "odometry", lambda *args: Engine())
"""


@pytest.mark.slow
def test_library_that_is_missing_is_the_jobs_error(engine):
    process, doubts = engine("odometry", child=Program(LACKING)), []
    process.on_doubt = lambda: doubts.append(process.ready)

    def error():
        with pytest.raises(RejectedError, match="no scipy") as caught:
            process.run(job())
        return str(caught.value)

    until(lambda: error() == "no scipy, also later", 20.0)
    assert doubts
    assert all(doubts)
