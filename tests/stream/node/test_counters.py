"""Missing frames, latencies, and the deadlines of regular work."""

from __future__ import annotations

import pytest

from coview_stream.stream.node.counters import Latency, MissingFrames, PoseRate, Rate

FRAME = 100_000_000  # ns


STEADY = tuple(range(10))


@pytest.mark.parametrize(
    ("frames", "missed"),
    [
        ([k + 0.2 * (-1) ** k for k in range(50)], 0),  # jitter
        ((*STEADY, 11, 12), 1),
        ((*STEADY, 14, 15), 4),
        ((0, 1, 5, 6), 0),  # before the rate is known
        ((*STEADY, 36_000, 36_001), 0),  # a robot that was switched off for an hour has lost no frames
        ((*STEADY, 3, 4), 0),  # a restarted clock
    ],
)
def test_gaps_between_stamps_count_missing_frames(frames, missed):
    estimate = MissingFrames()
    assert sum(estimate.add(round(k * FRAME), None) for k in frames) == missed


def test_changed_rate_is_learned():
    estimate = MissingFrames()
    assert [estimate.add(k * FRAME, None) for k in (*range(20), *range(20, 80, 2))][-1] == 0


@pytest.mark.parametrize(
    ("frames", "missed"),
    [
        (((0, 7), (1, 8), (2, 11), (3, 12)), 2),
        (((0, 7), (5, 8)), 0),  # a pause, but no number is missing
        (((0, 900), (1, 1), (2, 2)), 0),  # a restarted sender
        (((0, 1), (1, 5_000_000)), 0),
    ],
)
def test_sequence_numbers_count_missing_frames_exactly(frames, missed):
    estimate = MissingFrames()
    assert sum(estimate.add(k * FRAME, sequence) for k, sequence in frames) == missed


def test_latency_percentiles_in_milliseconds_of_the_newest():
    latency = Latency()
    assert latency.to_json() == {"p50": None, "p95": None, "p99": None}
    for k in range(101):
        latency.add(0.001 * k)
    assert latency.to_json() == {"p50": 50.0, "p95": 95.0, "p99": 99.0}
    for _ in range(600):
        latency.add(0.01)
    assert latency.to_json() == {"p50": 10.0, "p95": 10.0, "p99": 10.0}


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
    assert rate.remaining(60.3) == pytest.approx(0.2)
    assert rate.remaining(65.0) == 0.0


def test_slack_catches_up_late_ticks():
    rate = Rate(100.0, 0.0, slack=0.05)
    assert rate.take_tick(0.0)
    assert rate.take_tick(0.045)  # due at 0.01; the next ones are caught up
    assert ticks(rate, [0.045, 0.0451, 0.0452, 0.0453]) == [0.045, 0.0451, 0.0452]
    assert rate.remaining(0.0453) == pytest.approx(0.0047)
    assert rate.take_tick(0.2)  # later than the slack: go on from here
    assert not rate.take_tick(0.2)
    assert rate.remaining(0.2) == pytest.approx(0.01)
