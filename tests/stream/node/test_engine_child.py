"""Environment of the engines' processes."""

from __future__ import annotations

import os

import pytest

from coview_stream.stream.node.engine_child import _environment


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
