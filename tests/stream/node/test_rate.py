"""Rate on a fake clock: absolute deadlines, and no catching up."""

from __future__ import annotations

import pytest

from coview_stream.stream.node.counters import Rate


def ticks(rate, times):
    return [now for now in times if rate.take_tick(now)]


def test_first_tick_is_immediate_then_periodic():
    rate = Rate(4.0, 100.0)
    assert ticks(rate, [100.0, 100.1, 100.25, 100.3, 100.5, 100.74, 100.75]) == [100.0, 100.25, 100.5, 100.75]


def test_late_ticks_do_not_delay_later_ones():
    rate = Rate(4.0, 0.0)
    # each 0.2 s late: due times stay multiples of a period
    assert ticks(rate, [0.2, 0.45, 0.7, 0.95]) == [0.2, 0.45, 0.7, 0.95]
    assert rate.due == pytest.approx(1.0)


def test_no_catching_up_after_a_long_pause():
    rate = Rate(4.0, 0.0)
    assert rate.take_tick(0.0)
    assert ticks(rate, [60.0, 60.01, 60.1, 60.24, 60.25]) == [60.0, 60.25]


def test_remaining_time_until_next_tick():
    rate = Rate(4.0, 0.0)
    assert rate.remaining(0.0) == 0.0
    rate.take_tick(0.0)
    assert rate.remaining(0.1) == pytest.approx(0.15)
    assert rate.remaining(5.0) == 0.0


def test_slack_catches_up_late_ticks():
    rate = Rate(100.0, 0.0, slack=0.05)
    assert rate.take_tick(0.0)
    assert rate.take_tick(0.045)  # due at 0.01; the next ones are caught up
    assert [rate.take_tick(0.045), rate.take_tick(0.0451), rate.take_tick(0.0452), rate.take_tick(0.0453)] == [
        True,
        True,
        True,
        False,
    ]
    assert rate.remaining(0.0453) == pytest.approx(0.0047)
    assert rate.take_tick(0.2)  # later than the slack: go on from here
    assert not rate.take_tick(0.2)
    assert rate.remaining(0.2) == pytest.approx(0.01)
