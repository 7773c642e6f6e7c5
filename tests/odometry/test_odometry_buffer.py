"""The odometry buffer: poses between samples, and which samples continue it."""

import numpy as np
import pytest
from fake_robot import message, ns, pose
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from coview_stream.config.node import NodeConfig
from coview_stream.geometry.transforms import pose_from
from coview_stream.messages.types import OdometryMessage
from coview_stream.odometry.buffer import OdometryBuffer, SampleKind

STRAYS = (SampleKind.OUT_OF_ORDER, SampleKind.DUPLICATE)


def buffer(*samples, **limits):
    """A buffer that took in samples (sensor seconds, x, y, yaw) without delay."""
    taken = OdometryBuffer(NodeConfig(**limits))
    for seconds, *place in samples:
        taken.add(message(seconds, *place), seconds)
    return taken


def steady(odometry, begin, end, rate=20.0, **place):
    """Verdicts on samples of a steady drive without delay."""
    times = begin + np.arange(round((end - begin) * rate) + 1) / rate
    return [odometry.add(message(t, **place), t) for t in times]


def test_pose_between_samples_is_interpolated():
    turn = Rotation.from_rotvec([0.1, -0.2, 0.3])
    before = pose_from(Rotation.from_rotvec([0.0, 0.4, 0.0]).as_matrix(), [1.0, 2.0, 3.0])
    after = pose_from(before[:3, :3] @ turn.as_matrix(), [1.4, 1.8, 3.1])
    odometry = OdometryBuffer(NodeConfig())
    odometry.add(OdometryMessage(ns(0.0), before), 0.0)
    odometry.add(OdometryMessage(ns(0.1), after), 0.1)
    T = odometry.at(ns(0.025))
    np.testing.assert_allclose(T[:3, 3], [1.1, 1.95, 3.025], atol=1e-9)
    quarter = before[:3, :3] @ Rotation.from_rotvec(0.25 * turn.as_rotvec()).as_matrix()
    np.testing.assert_allclose(T[:3, :3], quarter, atol=1e-9)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


def test_pose_at_a_sample_is_the_sample():
    odometry = buffer((0.0, 1.0), (0.1, 1.1), (0.2, 1.2))
    for seconds, x in ((0.0, 1.0), (0.1, 1.1), (0.2, 1.2)):
        np.testing.assert_array_equal(odometry.at(ns(seconds)), pose(x))


def test_covered_time_span():
    empty = buffer()
    assert empty.covers(ns(0.0)) == 1
    assert empty.at(ns(0.0)) is None
    odometry = buffer((1.0,), (1.1,))
    assert [odometry.covers(ns(t)) for t in (0.9, 1.0, 1.05, 1.1, 1.2)] == [-1, 0, 0, 0, 1]
    assert odometry.at(ns(0.9)) is None
    assert odometry.at(ns(1.2)) is None


def test_nothing_is_interpolated_across_a_gap():
    odometry = buffer((0.0, 0.0), (0.3, 0.1), max_gap=0.2)
    assert odometry.at(ns(0.15)) is None
    np.testing.assert_array_equal(odometry.at(ns(0.3)), pose(0.1))
    assert buffer((0.0, 0.0), (0.2, 0.1), max_gap=0.2).at(ns(0.15)) is not None


def test_steady_samples_continue():
    odometry = buffer()
    assert set(steady(odometry, 0.0, 2.0)) == {SampleKind.CONTINUES}
    assert odometry.newest.stamp_ns == ns(2.0)
    assert odometry.arrived == 2.0
    assert odometry.travelled == pytest.approx(4.0)
    assert odometry.turned == pytest.approx(0.0)


def test_turns_add_up_in_both_directions():
    odometry = buffer((0.0, 0, 0, 0.0), (0.1, 0, 0, 0.2), (0.2, 0, 0, -0.1))
    assert odometry.turned == pytest.approx(0.5)
    assert odometry.travelled == 0.0


@pytest.mark.parametrize(
    ("pause", "intake"),
    [
        (0.5, SampleKind.CONTINUES),
        (0.51, SampleKind.GAP),
        (1.9, SampleKind.GAP),
        (2.1, SampleKind.OUTAGE),
        (4.9, SampleKind.OUTAGE),
        (600.0, SampleKind.OUTAGE),
    ],
)
def test_stamp_pause_is_a_gap_or_an_outage(pause, intake):
    odometry = buffer((1.0, 0.0))
    assert odometry.add(message(1.0 + pause, 0.0), 1.0 + pause) is intake
    assert odometry.newest.stamp_ns == ns(1.0 + pause)
    assert odometry.covers(ns(1.0)) == (-1 if intake is SampleKind.OUTAGE else 0)


@pytest.mark.parametrize(
    ("stamp", "kind"), [(0.2, SampleKind.DUPLICATE), (0.1, SampleKind.OUT_OF_ORDER)], ids=["duplicate", "older"]
)
def test_stray_sample_is_ignored(stamp, kind):
    odometry = buffer((0.0, 0.0), (0.2, 0.2))
    assert odometry.add(message(stamp, 0.7), 0.4) is kind
    assert odometry.arrived == 0.2
    assert odometry.travelled == pytest.approx(0.2)
    np.testing.assert_allclose(odometry.at(ns(stamp)), pose(stamp), atol=1e-12)
    assert odometry.add(message(0.3, 0.3), 0.45) is SampleKind.CONTINUES


@pytest.mark.parametrize(
    ("seconds", "x", "yaw", "intake"),
    [
        (0.01, 0.95, 0.0, SampleKind.CONTINUES),
        (0.01, 1.05, 0.0, SampleKind.JUMP),
        (0.01, -1.05, 0.0, SampleKind.JUMP),
        (0.01, 0.0, np.radians(23), SampleKind.JUMP),  # 20 rad/s are 11 degrees then, and 20 are always allowed
        (0.01, 0.0, np.radians(19), SampleKind.CONTINUES),
        (0.1, 5.4, 0.0, SampleKind.CONTINUES),
        (0.1, 5.6, 0.0, SampleKind.JUMP),
        (0.1, 0.0, 1.9, SampleKind.CONTINUES),
        (0.1, 0.0, 2.1, SampleKind.JUMP),
    ],
)
def test_motion_beyond_max_speed_is_a_jump(seconds, x, yaw, intake):
    assert buffer((0.0, 0.0)).add(message(seconds, x, 0.0, yaw), seconds) is intake


@pytest.mark.parametrize("speed", [0.0, 1.5, 10.0, 30.0])
def test_jump_limit_depends_on_recent_speed(speed):
    """Half a metre, and three times its speed of the last seconds and three metres per second more."""
    most = 0.5 + 0.1 * (3.0 * speed + 3.0)
    for off, intake in ((-0.05, SampleKind.CONTINUES), (0.05, SampleKind.JUMP)):
        odometry = buffer(*((0.1 * k, 0.1 * k * speed) for k in range(11)))
        fast = min(most, 0.5 + 0.1 * 50.0)
        assert odometry.add(message(1.1, speed + fast + off), 1.1) is intake


def test_jump_clears_the_buffer():
    odometry = buffer((0.0, 0.0), (0.1, 0.5))
    assert odometry.add(message(0.2, 500.0), 0.2) is SampleKind.JUMP
    assert odometry.covers(ns(0.1)) == -1
    assert odometry.travelled == 0.0
    np.testing.assert_array_equal(odometry.at(ns(0.2)), pose(500.0))
    assert odometry.add(message(0.3, 500.1), 0.3) is SampleKind.CONTINUES


@pytest.mark.parametrize("stray", [3600.0, 1e9, -3600.0, -1e9, 8.0])
def test_stray_stamp_does_not_block_later_samples(stray):
    odometry = buffer()
    steady(odometry, 0.0, 1.0)
    assert odometry.add(message(stray, 2.0), 1.01) in STRAYS
    assert set(steady(odometry, 1.05, 3.0)) == {SampleKind.CONTINUES}


def test_repeated_strays_are_not_a_clock_restart():
    """Another sender, an hour behind, on the same key: between them come ours."""
    odometry = buffer()
    for k in range(100):
        t = 0.05 * k
        assert odometry.add(message(t), t) is SampleKind.CONTINUES
        assert odometry.add(message(t - 3600.0, 7.0), t + 0.01) is not SampleKind.RESTART


@pytest.mark.parametrize(
    ("before", "after", "kind"), [(100.0, 1.0, SampleKind.RESTART), (0.0, 3600.0, SampleKind.OUTAGE)]
)
def test_clock_that_was_set_is_accepted_after_running_on(before, after, kind):
    odometry = buffer()
    steady(odometry, before, before + 1.0)
    arrived = before + 1.05 + 0.05 * np.arange(25)
    verdicts = [odometry.add(message(after + 0.05 * k, 0.1 * k), now) for k, now in enumerate(arrived.tolist())]
    at = verdicts.index(kind)
    assert set(verdicts[:at]) == {SampleKind.OUT_OF_ORDER}
    assert 20 <= at <= 21  # after a second, not before
    assert set(verdicts[at + 1 :]) == {SampleKind.CONTINUES}
    assert odometry.covers(ns(before + 0.5)) == (1 if after < before else -1)  # the old clock's samples are gone
    assert odometry.newest.stamp_ns == ns(after + 1.2)


def test_restarted_slow_clock_needs_five_samples():
    odometry = buffer((100.0, 0.0))
    verdicts = [odometry.add(message(float(k), 0.0), 101.0 + k) for k in range(6)]
    assert verdicts == [SampleKind.OUT_OF_ORDER] * 4 + [SampleKind.RESTART, SampleKind.GAP]


def test_backward_stamps_are_not_a_clock_restart():
    odometry = buffer()
    steady(odometry, 100.0, 101.0)
    for k in range(200):
        assert odometry.add(message(100.9 - 0.05 * k), 101.05 + 0.05 * k) in STRAYS
    assert odometry.newest.stamp_ns == ns(101.0)
    assert odometry.arrived == 101.0


def test_history_is_bounded_in_time():
    odometry = buffer(odometry_history=2.0)
    steady(odometry, 0.0, 10.0)
    assert odometry.covers(ns(7.99)) == -1
    assert odometry.covers(ns(8.0)) == 0


def test_segment_around_a_sweep():
    odometry = buffer((0.0, 0.0), (0.1, 0.1), (0.2, 0.2), (0.3, 0.3), (0.4, 0.4))

    def stamps(begin, end):
        segment = odometry.around(ns(begin), ns(end))
        assert segment.poses.shape == (len(segment.stamps), 4, 4)
        np.testing.assert_allclose(segment.poses[:, 0, 3], (segment.stamps - ns(0.0)) * 1e-9, atol=1e-9)
        return [round((s - ns(0.0)) * 1e-9, 3) for s in segment.stamps.tolist()]

    assert stamps(0.12, 0.22) == [0.1, 0.2, 0.3]
    assert stamps(0.1, 0.3) == [0.1, 0.2, 0.3]
    assert stamps(0.25, 0.25) == [0.2, 0.3]
    assert stamps(-1.0, 0.05) == [0.0, 0.1]
    assert stamps(0.35, 9.0) == [0.3, 0.4]
    assert stamps(-1.0, 9.0) == [0.0, 0.1, 0.2, 0.3, 0.4]
    nothing = buffer().around(ns(0.0), ns(1.0))
    assert nothing.stamps.shape == (0,)
    assert nothing.poses.shape == (0, 4, 4)


stamps = st.one_of(st.integers(0, 60).map(lambda k: 0.05 * k), st.floats(-10.0, 10.0), st.floats(-9e8, 9e8))


@pytest.mark.slow
@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.lists(st.tuples(stamps, st.floats(0.0, 0.7), st.floats(-3.0, 3.0)), max_size=60))
def test_buffer_stays_sorted_for_random_stamps(samples):
    odometry, now, travelled = OdometryBuffer(NodeConfig()), 0.0, 0.0
    for seconds, later, x in samples:
        now += later
        newest = odometry.newest
        intake = odometry.add(message(seconds, x), now)
        held = odometry.around(-(1 << 62), 1 << 62).stamps
        assert (np.diff(held) > 0).all()
        assert held[-1] == odometry.newest.stamp_ns
        assert held[-1] - held[0] <= 5e9
        if intake in STRAYS:
            assert odometry.newest is newest
        else:
            assert odometry.newest.stamp_ns == ns(seconds)
        if intake in (SampleKind.CONTINUES, SampleKind.GAP) and newest is not None:
            assert odometry.newest.stamp_ns > newest.stamp_ns
            assert odometry.travelled >= travelled
        travelled = odometry.travelled
        for stamp in held.tolist():
            assert odometry.at(stamp) is not None
