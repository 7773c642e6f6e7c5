"""Clocks around stages: they add up, keep what a class method is, and leave nothing behind."""

import time

from bench.where import clocks, shown, stages


class Owner:
    @classmethod
    def make(cls, value):
        return cls, value

    def work(self, seconds):
        time.sleep(seconds)
        return seconds


def test_stages_are_timed_and_put_back():
    before = dict(vars(Owner))
    with clocks([("make", Owner, "make"), ("work", Owner, "work")]) as spent:
        assert Owner.make(3) == (Owner, 3)
        assert [Owner().work(0.01) for _ in range(2)] == [0.01, 0.01]
    assert spent["work"] >= 0.02
    assert 0 < spent["make"] < spent["work"]
    assert dict(vars(Owner)) == before
    assert Owner().work(0) == 0
    assert spent["work"] < 10


def test_every_stage_exists():
    with clocks(stages()) as spent:
        assert not spent


def test_only_stages_that_ran_are_shown():
    text = shown([{"step": 0.002, "  registration": 0.001}, {"step": 0.004}])
    assert [line.split("|")[1].strip() for line in text.splitlines()[2:]] == ["step", "· registration"]
    assert "3.00" in text
