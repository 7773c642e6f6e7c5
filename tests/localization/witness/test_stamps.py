"""Stamps of clouds: what they say about a lag of the clouds."""

import numpy as np
import pytest

from coview_stream.localization.witness.faults import LAGS
from coview_stream.localization.witness.stamps import step_stamps

RNG = np.random.default_rng(4)


def stamps(newest, usual=None):
    """Return the stamps of a step with the newest distances, after usual ones."""
    all_of_them = np.cumsum([0.0, *(np.full(100, 0.1) if usual is None else usual), *newest])
    return step_stamps(all_of_them, all_of_them[-1 - len(newest)], all_of_them[-1])


def test_period_is_found_where_frames_are_left_out():
    usual = 0.1 * RNG.integers(3, 8, 60) + RNG.normal(0.0, 0.0003, 60)
    assert stamps([0.5], usual).period == pytest.approx(0.1, rel=0.01)


def test_parts_of_a_turn_that_come_together_are_no_turns():
    usual = np.tile([1e-4, 0.2], 50)
    assert stamps([0.2], usual).period > 0.001


@pytest.mark.parametrize("usual", [np.full(100, 0.1), 0.1 * RNG.integers(3, 8, 100)])
def test_stretched_distances_are_of_a_lag_that_grows(usual):
    seen = stamps(1.1 * usual[-6:], usual)
    longer = 0.1 * float(usual[-6:].sum())
    assert float(seen.allow(np.array(longer), 0.001)) > 10.0
    even = stamps(usual[-6:], usual)
    assert float(even.allow(np.array(longer), 0.001)) < 0.1
    assert even.hole == 0.0


def test_a_hole_is_of_a_lag_as_long():
    seen = stamps([0.1, 0.1, 1.1, 0.1])
    assert seen.hole == pytest.approx(1.0)
    assert float(seen.allow(np.array(1.0))) > 10.0
    assert float(seen.allow(np.array(0.0))) == 1.0
    assert float(seen.allow(np.array(0.5))) < 3.0
    shares = seen.stalled(LAGS)
    assert shares.sum() == pytest.approx(1.0)
    assert LAGS[shares.argmax()] == pytest.approx(1.0)
    assert not stamps([0.1] * 5).stalled(LAGS).any()


def test_stamps_without_a_rhythm_say_nothing_of_short_lags():
    usual = RNG.uniform(0.1, 1.0, 200)
    assert 0.2 < float(stamps([0.5], usual).allow(np.array(0.05))) < 5.0


def test_lags_that_end_are_no_more_likely():
    assert float(stamps([0.1] * 5).allow(np.array(-0.3))) < 0.2


@pytest.mark.parametrize("period", [0.05, 0.1, 0.1001, 0.2, 2.0])
def test_period_of_even_stamps_is_no_part_of_it(period):
    begin = 1.7e9 if period > 0.1 else 1000.0
    even = begin + period * np.arange(120.0) + 1e-6 * np.arange(120)
    assert step_stamps(even, even[-9], even[-1]).period == pytest.approx(period, rel=0.01)
