"""Environment of the engines' processes, and what they do while no job waits."""

from __future__ import annotations

import os
import socket
import threading
from multiprocessing.connection import Connection

import pytest

from coview_stream.errors import DependencyError
from coview_stream.stream.node import engines, worker
from coview_stream.stream.node.engine_child import Opening, _environment


@pytest.mark.parametrize(("cores", "threads"), [(1, "1"), (2, "1"), (8, "7")])
def test_searches_leave_a_core_to_the_others(monkeypatch, cores, threads):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(cores)), raising=False)
    monkeypatch.delenv("COVIEW_THREADS", raising=False)
    assert _environment("search")["COVIEW_THREADS"] == threads
    assert "COVIEW_THREADS" not in _environment("track")


def test_threads_that_the_user_asks_for_are_given(monkeypatch):
    monkeypatch.setenv("COVIEW_THREADS", "5")
    assert {_environment(kind)["COVIEW_THREADS"] for kind in ("search", "track")} == {"5"}
    assert _environment("search")["OPENBLAS_NUM_THREADS"] == "1"


class LackingEngine:
    """An engine without a library that only its jobs need."""

    def __init__(self):
        self.asked = threading.Event()

    def prepare(self):
        """Do nothing."""

    def prepare_later(self):
        self.asked.set()
        raise DependencyError("no gtsam")

    def run(self, job):
        raise DependencyError("no gtsam")


def test_library_that_is_missing_is_the_jobs_error(monkeypatch):
    engine = LackingEngine()
    monkeypatch.setattr(engines, "open_engine", lambda *args: engine)
    monkeypatch.setattr(worker, "_set_group_nice", lambda nice: None)
    ours, theirs = socket.socketpair()
    with Connection(ours.detach()) as pipe:
        child = threading.Thread(target=worker.main, args=([str(theirs.detach()), "odometry", "0"],), daemon=True)
        child.start()
        pipe.send(Opening("map", "hash", "trimmed-icp", "auto", 1e-4))
        assert pipe.recv() == ("ready", None)
        assert pipe.recv() == ("prepared", None)
        assert engine.asked.wait(10.0)
        pipe.send("job")
        assert pipe.poll(10.0)
        assert pipe.recv() == ("rejected", "no gtsam")
    child.join(10.0)
    assert not child.is_alive()
