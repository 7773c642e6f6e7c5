"""Scores of the peers: what is right, what is vouched for, and how they stand beside ours."""

import math

import pytest

from bench.peers.peers import OURS, Trial, compared, milliseconds


def answer(metres, degrees=0.5, vouched=True, seconds=0.1):
    return {"seconds": seconds, "vouched": vouched, "metres": metres, "degrees": degrees, "megabytes": 100.0}


def tried(name, *answers, scene="town", trouble=""):
    return Trial(name, scene, 5, list(answers), trouble)


def test_right_and_vouched_for_are_two_things():
    far = answer(40.0)
    done = tried("X", answer(0.2), answer(2.9), answer(0.1, 5.1), far, answer(0.3, vouched=False), answer(None, None))
    assert len(done.right()) == 2
    assert done.false_accepts() == 3
    assert done.figures()["metres"] == pytest.approx(1.55)
    assert milliseconds([done]) == pytest.approx(100.0)
    nothing = tried("X", answer(None, None, vouched=False))
    assert nothing.false_accepts() == 0
    assert math.isnan(nothing.figures()["metres"])


def test_rows_put_every_peer_beside_ours():
    ours = [tried(OURS, *[answer(0.1, seconds=0.2)] * 5)]
    theirs = [tried("X", answer(0.1, seconds=1.0), answer(30.0), answer(30.0, vouched=False), answer(0.5))]
    right, time, false = compared(theirs, ours, ours=False)
    assert (right.ours, right.baseline, right.ratio, right.holds) == (100.0, 50.0, 2.0, True)
    assert (time.ours, time.baseline, time.holds) == (pytest.approx(200.0), pytest.approx(100.0), None)
    assert (false.ours, false.holds) == (1, None)
    right, *_ = compared(ours, theirs, ours=False)
    assert right.holds is False
    late = [tried(OURS, answer(50.0), answer(0.1))]
    right, *_ = compared([tried("X", answer(0.1))], late, ours=False)
    assert right.ours == 0.0
    accepts, *_ = compared(ours, ours, ours=True)
    assert accepts.holds is True
    accepts, *_ = compared([tried(OURS, answer(30.0))], ours, ours=True)
    assert accepts.holds is False


def test_a_peer_without_answers_informs_but_ours_fails():
    silent = [tried("X", trouble="not installed; pip install x")]
    (row,) = compared(silent, [tried(OURS, answer(0.1))], ours=False)
    assert row.holds is None
    assert "pip install x" in row.name
    (row,) = compared([tried(OURS, trouble="exit code 1")], [], ours=True)
    assert row.holds is False
