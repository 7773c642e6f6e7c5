"""Counters, missing frames, latencies, and the deadlines of regular work."""

from __future__ import annotations

import json

import pytest

from coview_stream.stream.node.counters import Counters, Latency, MissingFrames, PoseRate, Rate

FRAME = 100_000_000  # ns


def missing(*messages):
    """Estimates after messages (frame number, sequence), 10 Hz."""
    estimate = MissingFrames()
    return [estimate.add(round(k * FRAME), sequence) for k, sequence in messages]


def unnumbered(*frames):
    return missing(*((k, None) for k in frames))


def test_each_counter_counts_independently():
    counters = Counters()
    counters.count("late")
    counters.count("missing", 3)
    document = counters.to_json()
    assert (document.pop("late"), document.pop("missing")) == (1, 3)
    assert set(document.values()) == {0}
    assert json.loads(json.dumps(document)) == document


def test_unknown_counter_is_refused():
    with pytest.raises(AttributeError):
        Counters().count("lates")


def test_latency_percentiles_in_milliseconds():
    latency = Latency()
    assert latency.to_json() == {"p50": None, "p95": None, "p99": None}
    for k in range(101):
        latency.add(0.001 * k)
    assert latency.to_json() == {"p50": 50.0, "p95": 95.0, "p99": 99.0}


def test_old_latencies_are_dropped():
    latency = Latency()
    for seconds in [9.0] * 300 + [0.01] * 600:
        latency.add(seconds)
    assert latency.to_json() == {"p50": 10.0, "p95": 10.0, "p99": 10.0}


def test_steady_stamps_count_no_missing_frames():
    assert set(unnumbered(*range(50))) == {0}
    jittered = [k + 0.2 * (-1) ** k for k in range(50)]
    assert set(unnumbered(*jittered)) == {0}


def test_stamp_gaps_count_missing_frames():
    assert unnumbered(*range(10), 11, 12)[-2:] == [1, 0]
    assert unnumbered(*range(10), 14, 15)[-2:] == [4, 0]


def test_no_missing_frames_before_rate_is_known():
    assert unnumbered(0, 1, 5, 6) == [0, 0, 0, 0]


def test_long_pause_counts_no_missing_frames():
    """A robot that was switched off for an hour has lost no frames."""
    assert unnumbered(*range(10), 36_000, 36_001)[-2:] == [0, 0]


def test_changed_rate_is_learned():
    slow = [20 + 2 * k for k in range(30)]
    assert unnumbered(*range(20), *slow)[-1] == 0


def test_sequence_numbers_count_missing_frames_exactly():
    assert missing((0, 7), (1, 8), (2, 11), (3, 12)) == [0, 0, 2, 0]
    assert missing((0, 7), (5, 8)) == [0, 0]  # a pause, but no number is missing


def test_restarted_sequence_numbers_count_no_missing_frames():
    assert missing((0, 900), (1, 1), (2, 2)) == [0, 0, 0]
    assert missing((0, 1), (1, 5_000_000)) == [0, 0]


def test_backward_stamps_count_no_missing_frames():
    assert unnumbered(*range(10), 3, 4)[-2:] == [0, 0]


def test_pose_rate_of_simultaneous_poses():
    rate = PoseRate()
    rate.add(1.0)
    rate.add(1.0)
    assert rate.rate(1.0) >= 0.0


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
