"""Errors, missing frames, latencies, and the deadlines of regular work."""

import pytest

from coview_stream.stream.node.counters import ErrorLog, Latency, MissingFrames, PoseRate, Rate

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


@pytest.mark.parametrize(
    ("times", "taken"),
    [
        ([0.0, 0.1, 0.25, 0.3, 0.5, 0.74, 0.75], [0.0, 0.25, 0.5, 0.75]),  # the first at once
        ([0.2, 0.45, 0.7, 0.95, 1.0], [0.2, 0.45, 0.7, 0.95, 1.0]),  # due at multiples of the period
        ([0.0, 60.0, 60.01, 60.1, 60.24, 60.25], [0.0, 60.0, 60.25]),  # nothing is made up for after a pause
    ],
)
def test_ticks_are_periodic(times, taken):
    assert ticks(Rate(4.0, 0.0), times) == taken


def test_slack_catches_up_late_ticks():
    rate = Rate(100.0, 0.0, slack=0.05)
    assert rate.take_tick(0.0)
    assert rate.take_tick(0.045)  # due at 0.01; the next ones are caught up
    assert ticks(rate, [0.045, 0.0451, 0.0452, 0.0453]) == [0.045, 0.0451, 0.0452]
    assert rate.remaining(0.0453) == pytest.approx(0.0047)
    assert rate.take_tick(0.2)  # later than the slack: go on from here
    assert not rate.take_tick(0.2)
    assert rate.remaining(0.2) == pytest.approx(0.01)
    assert rate.remaining(0.3) == 0.0


def test_kind_of_error_is_logged_once_however_often_it_begins_again(caplog):
    """A robot that is lost and found in turns, with a bad message each time, must not use up what may be logged."""
    errors = ErrorLog()
    for k in range(30):
        errors.add_first("r1: malformed messages", f"{k} bytes")
        assert errors.texts[-1].endswith(f"; the first: {k} bytes")
        errors.clear()
    errors.add_first("r1: failed searches", "out of memory")
    assert caplog.messages == [
        "r1: malformed messages; the first: 0 bytes",
        "r1: failed searches; the first: out of memory",
    ]
