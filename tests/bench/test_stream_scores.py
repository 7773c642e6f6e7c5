"""Scores of a stream of poses and statuses; no sockets, no clock."""

import numpy as np
import pytest

from bench.stream import scores as stream_scores
from bench.stream.processes import EPOCH_NS
from bench.stream.scores import Posed, Told
from coview_stream.geometry.transforms import pose_from, rot_z

SECOND = 10**9


def posed(arrival, stamp_ns=0, T=None, age=np.nan):
    return Posed(arrival, stamp_ns, np.eye(4) if T is None else T, age)


def told(arrival, state="TRACKING", **fields):
    return Told(arrival, {"state": state, **fields})


@pytest.mark.parametrize(
    ("shift", "degrees", "count"),
    [(1.99, 0.0, 0), (2.01, 0.0, 1), (0.0, 4.9, 0), (0.0, 5.1, 1), (0.0, -5.1, 1), (np.nan, 0.0, 1)],
)
def test_a_pose_is_false_beyond_two_metres_or_five_degrees(shift, degrees, count):
    true = pose_from(rot_z(1.0), [100.0, -50.0, 3.0])
    wrong = true @ pose_from(rot_z(np.radians(degrees)), [0.0, shift, 0.0])
    metres, turned = stream_scores.errors([posed(0.0, 7, wrong)], lambda stamp: {7: true}[stamp])
    assert stream_scores.false_poses(metres, turned) == count
    if shift == 1.99:
        assert metres[0] == pytest.approx(1.99)
    if degrees == 4.9:
        assert turned[0] == pytest.approx(4.9)


def test_intervals_count_unless_the_robot_was_known_to_be_untracked():
    arrivals = [0.0, 0.1, 0.2, 3.0, 3.1, 4.6]
    everything = stream_scores.tracking_intervals(arrivals, [told(0.15), told(3.5)])
    np.testing.assert_allclose(everything, [0.1, 0.1, 2.8, 0.1, 1.5])
    known = stream_scores.tracking_intervals(arrivals, [told(0.15), told(1.0, "LOST"), told(2.9)])
    np.testing.assert_allclose(known, [0.1, 0.1, 0.1, 1.5])
    assert stream_scores.rate_hz(known[:3]) == pytest.approx(10.0)
    assert stream_scores.rate_hz(np.array([0.2, 0.3])) == pytest.approx(4.0)
    assert np.isnan(stream_scores.rate_hz(np.array([])))


def test_jitter_is_the_distance_from_the_period_either_way():
    intervals = np.array([0.1] * 98 + [0.06, 0.14])
    assert stream_scores.jitter_ms(intervals) == pytest.approx(40.0)
    assert np.isnan(stream_scores.jitter_ms(np.array([])))


def test_share_posed():
    assert stream_scores.share_posed([0.05, 0.1, 0.65], 0.0, 1.0) == pytest.approx(0.4)
    assert stream_scores.share_posed([5.0], 0.0, 1.0) == 0.0


def test_fairness():
    assert stream_scores.jain([3.0, 3.0, 3.0]) == pytest.approx(1.0)
    assert stream_scores.jain([1.0, 0.0, 0.0, 0.0]) == pytest.approx(0.25)
    assert stream_scores.jain([0.0, 0.0]) == 0.0


def test_reactions_and_staleness_are_counted_from_the_put_of_the_frame():
    puts = np.array([[EPOCH_NS + k * SECOND / 10, 50.0 + k / 10] for k in range(20)])
    stamp = EPOCH_NS + 3 * SECOND / 10
    seen = [(50.35, stamp + 1000), (50.45, stamp), (50.9, stamp + 2e8), (51.0, EPOCH_NS + 5 * SECOND)]
    np.testing.assert_allclose(stream_scores.reaction(puts, seen), [0.05, 0.4])
    np.testing.assert_allclose(stream_scores.staleness(puts, seen), [0.05, 0.15, 0.4])
    assert stream_scores.staleness(np.zeros((0, 2)), seen).size == 0


def test_statuses_and_ages_name_frames():
    assert stream_scores.corrected([posed(1.0, 5 * SECOND, age=0.25), posed(2.0)]) == [(1.0, 4.75e9)]
    rows = [told(1.0, last_frame_ns=7), told(2.0), told(3.0, last_frame_ns=None), told(4.0, counters={"dropped": 3})]
    assert stream_scores.processed(rows) == [(1.0, 7.0)]
    assert stream_scores.counter(rows, "dropped") == 3
    assert stream_scores.counter([*rows, told(5.0)], "dropped") == 3
    assert stream_scores.counter(rows, "late") is None
