"""Engines that a node starts: all of them, or none is left running."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from coview_stream.stream.node import serve
from coview_stream.stream.node.engine_process import CancelledError, DiedError


class RecordedEngine:
    """An engine without a process, that fails to start if it is the one named."""

    fails: str | None = None
    made: dict[str, RecordedEngine]

    def __init__(self, kind, *_, **__):
        self.kind, self.calls = kind, []
        self.made[kind] = self

    def start(self):
        self.calls.append("start")
        if self.kind == self.fails:
            raise DiedError(f"the {self.kind} engine died")

    def wait_prepared(self, cancelled):
        if cancelled():
            raise CancelledError("the engine is no longer wanted")

    def close(self):
        self.calls.append("close")


class RecordedChild:
    closed = False

    def close(self):
        self.closed = True


@pytest.fixture
def engine(monkeypatch):
    monkeypatch.setattr(RecordedEngine, "made", {}, raising=False)
    monkeypatch.setattr(RecordedEngine, "fails", None)
    monkeypatch.setattr(serve, "EngineProcess", RecordedEngine)
    return RecordedEngine


@pytest.fixture
def loads(monkeypatch):
    """Loads of the map, each of which may hash all of its file."""
    made = []

    def load(path, key=None):
        made.append(path)
        sha256 = "b" * 64
        return SimpleNamespace(
            parameters={}, sha256=sha256, site_sha256=sha256, path=None, identity=None, require_features=lambda _: None
        )

    monkeypatch.setattr(serve, "load_map", load)
    return made


OPTIONS = serve.ServeOptions(Path("site.coview"), [])


def test_engine_that_does_not_start_ends_those_before_it(engine, loads, monkeypatch):
    monkeypatch.setattr(engine, "fails", "search")
    with pytest.raises(DiedError, match="search"):
        serve.start_engines(OPTIONS, {"track": RecordedChild(), "search": RecordedChild()})
    assert engine.made["track"].calls == ["start", "close"]
    assert engine.made["search"].calls == ["start", "close"]


def test_new_map_is_loaded_once(engine, loads, monkeypatch):
    monkeypatch.setattr(serve, "start_children", lambda _: {"track": RecordedChild(), "search": RecordedChild()})
    opened = serve.open_map(OPTIONS, "a" * 64, lambda: False)
    assert opened is not None
    assert loads == [OPTIONS.map_path]
    assert serve.open_map(OPTIONS, "b" * 64, lambda: False) is None


def test_opening_that_is_cancelled_leaves_nothing_running(engine, loads, monkeypatch):
    children = {"track": RecordedChild(), "search": RecordedChild()}
    monkeypatch.setattr(serve, "start_children", lambda _: children)
    with pytest.raises(CancelledError):
        serve.open_map(OPTIONS, "a" * 64, lambda: bool(loads))
    assert engine.made
    assert all(each.calls == ["start", "close"] for each in engine.made.values())
    assert all(child.closed for child in children.values())
