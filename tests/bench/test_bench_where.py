"""Clocks around stages: they add up, keep what a class method is, and leave nothing behind."""

from types import SimpleNamespace

from bench.speed import where
from bench.speed.where import clocks, shown, stages


class Owner:
    now = 0.0

    @classmethod
    def make(cls, value):
        Owner.now += 1.0
        return cls, value

    def work(self, seconds):
        Owner.now += seconds
        return seconds


def test_stages_are_timed_and_put_back(monkeypatch):
    monkeypatch.setattr(where, "time", SimpleNamespace(perf_counter=lambda: Owner.now))
    monkeypatch.setattr(Owner, "now", 0.0)
    before = dict(vars(Owner))
    with clocks([("make", Owner, "make"), ("work", Owner, "work")]) as spent:
        assert Owner.make(3) == (Owner, 3)
        assert [Owner().work(seconds) for seconds in (2.0, 4.0)] == [2.0, 4.0]
    assert spent == {"make": 1.0, "work": 6.0}
    assert dict(vars(Owner)) == before | {"now": 7.0}
    assert Owner().work(8.0) == 8.0
    assert spent == {"make": 1.0, "work": 6.0}


def test_every_stage_exists():
    with clocks(stages()) as spent:
        assert not spent


def test_only_stages_that_ran_are_shown():
    text = shown([{"step": 0.002, "  registration": 0.001}, {"step": 0.004}])
    assert [line.split("|")[1].strip() for line in text.splitlines()[2:]] == ["step", "· registration"]
    assert "3.00" in text
