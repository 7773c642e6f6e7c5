"""Faults of clouds and odometry: synthetic drives with one fault each, and the probabilities that they get."""

from dataclasses import replace

import numpy as np
import pytest

from coview_stream.geometry.planar import compose, inverted
from coview_stream.localization.tracking.monitor import RejectionReason
from coview_stream.localization.witness.agreement import Seen, Step, misfits
from coview_stream.localization.witness.faults import LAGS, FaultPosterior
from coview_stream.localization.witness.stamps import step_stamps

DT, SPEED = 0.5, 2.0
NOISE = np.diag([0.02, 0.02, np.radians(0.3)]) ** 2
LEVEL, RISK = (0.3, np.radians(1.0)), 1e-3


def pose(t):
    """A robot that drives an S: planar poses (..., 3) at times; it stood still before time zero."""
    t = np.maximum(np.asarray(t, dtype=float), 0.0)
    fine = np.linspace(0.0, 60.0, 6001)
    yaw = 0.5 * np.sin(0.3 * fine)
    steps = 0.01 * SPEED * np.column_stack([np.cos(yaw), np.sin(yaw)])
    xy = np.vstack([[0.0, 0.0], np.cumsum(steps, axis=0)[:-1]])
    return np.stack([np.interp(t, fine, column) for column in (*xy.T, yaw)], axis=-1)


def moved(before, now):
    return compose(inverted(before), now)


def stamps(*newest, usual=0.1):
    """Return the stamps of a step with the newest distances, after a hundred usual ones."""
    all_of_them = np.cumsum([0.0, *[usual] * 100, *newest])
    return step_stamps(all_of_them, all_of_them[-1 - len(newest)], all_of_them[-1])


class Odometry:
    """Planar path of odometry, step by step; it stood still before."""

    def __init__(self, t):
        self.times, self.poses = [t - 10.0, t], [np.zeros(3), np.zeros(3)]

    def move(self, o):
        """Move on; return the path by lags before and after."""
        before = self.by_lags(self.times[-1])
        self.poses.append(compose(self.poses[-1], o))
        self.times.append(self.times[-1] + DT)
        return before, self.by_lags(self.times[-1])

    def by_lags(self, t):
        return np.stack([np.interp(t - LAGS, self.times, column) for column in np.transpose(self.poses)], axis=1)


def drive(change, way=pose, begin=10.0, until=20.0, stops=True, **given):
    """Drive until a time or, unless it goes on, an accusation: the posterior, the newest accusation, the seconds.

    From ``begin`` on, ``change(o, t)`` gives odometry's and the clouds' motion of a step.
    """
    faults, rng, odometry = FaultPosterior(), np.random.default_rng(3), Odometry(5.0)
    for t in np.arange(5.0, until, DT):
        o = seen = moved(way(t), way(t + DT))
        if t >= begin:
            o, seen = change(o, t)
        seen, on_map = (Seen(seen + rng.normal(size=3) * np.sqrt(np.diag(NOISE)), NOISE) for _ in range(2))
        faults.add(Step(DT, Seen(o, NOISE), seen, on_map, *odometry.move(o), **given))
        accused = faults.accusation(*LEVEL, RISK)
        if accused is not None and stops:
            return faults, accused, t + DT - begin
    return faults, accused, until - begin


def late(lag):
    """Clouds that are older than their stamps by ``lag`` seconds from the first step on."""
    return lambda o, t: (o, moved(pose(t - (lag if t >= 10.4 else 0.0)), pose(t + DT - lag)))


def displaced(x, y, degrees):
    """Clouds of a sensor that has been moved and turned on its mount by the first step."""
    C = np.array([x, y, np.radians(degrees)])
    return lambda o, t: (o, compose(o, C) if t < 10.4 else compose(compose(inverted(C), o), C))


def test_nothing_is_wrong_where_all_agree():
    faults, accused, _ = drive(lambda o, t: (o, o), until=50.0)
    assert accused is None
    assert faults.good > 0.99


def test_repeated_scan_is_named_after_a_step():
    _, accused, seconds = drive(lambda o, t: (o, np.zeros(3)))
    assert accused.cause is RejectionReason.REPEATED
    assert "the lidar repeats itself" in accused.sentence
    assert seconds <= DT


def test_robot_that_stands_does_not_repeat_itself():
    faults, accused, _ = drive(lambda o, t: (0.0 * o, 0.0 * o), until=60.0)
    assert accused is None
    o = np.array([0.2, 0.0, 0.0])
    faults.add(Step(DT, Seen(o, NOISE), Seen(o, NOISE), None, *Odometry(60.0).move(o)))
    assert faults.accusation(*LEVEL, RISK) is None  # nor when it drives on


@pytest.mark.parametrize("lag", [0.4, 1.0, 2.0])
def test_clouds_that_are_late_are_named_with_their_lag(lag):
    faults, accused, seconds = drive(late(lag))
    assert accused.cause is RejectionReason.CLOCK
    assert "older than their stamps" in accused.sentence
    assert seconds <= 4.0
    shares = faults.steady + faults.growing
    assert LAGS[shares[1:].argmax() + 1] == pytest.approx(lag, abs=0.1)


def test_lag_that_grows_is_named_before_it_is_long():
    _, accused, seconds = drive(lambda o, t: (o, moved(pose(0.9 * t + 1.0), pose(0.9 * (t + DT) + 1.0))))
    assert accused.cause is RejectionReason.CLOCK
    assert 0.1 * seconds * SPEED < 1.0  # metres that poses are off


def straight(t):
    """A robot that drives straight on: its planar pose at a time."""
    return np.array([SPEED * t, 0.0, 0.0])


def lagging(lag, way=pose):
    """Clouds that are older than their stamps by ``lag(t)`` seconds."""
    return lambda o, t: (o, moved(way(t - lag(t)), way(t + DT - lag(t + DT))))


def test_clock_that_drifts_slowly_is_named():
    _, accused, seconds = drive(lagging(lambda t: 0.02 * max(t - 10.0, 0.0)), until=40.0)
    assert accused.cause is RejectionReason.CLOCK
    assert 0.02 * seconds * SPEED < 0.8  # metres that poses are off


@pytest.mark.parametrize(("rate", "seconds"), [(0.1, 10.0), (0.2, 5.0), (0.3, 6.0)])
@pytest.mark.parametrize("after", ["it is set", "it stays late"])
@pytest.mark.parametrize("way", [pose, straight])
def test_clock_that_drifted_is_believed_again_only_once_it_is_set(rate, seconds, after, way):
    def lag(t):
        drifted = rate * min(max(t - 10.0, 0.0), seconds)
        return 0.0 if after == "it is set" and t >= 10.0 + seconds else drifted

    for until in 10.0 + seconds + np.arange(-DT, 4.0, DT):
        faults, accused, _ = drive(lagging(lag, way), way, until=until, stops=False)
        if after == "it stays late" or until < 10.0 + seconds:
            assert accused.cause is RejectionReason.CLOCK
        elif until >= 11.5 + seconds:
            assert accused is None
            assert faults.good > 0.9


@pytest.mark.parametrize(("distance", "wrong"), [(0.13, "clouds"), (0.1, "odometry")])
def test_on_a_straight_way_the_stamps_tell_a_clock_that_parts_from_odometry_out_of_scale(distance, wrong):
    """The clouds move by 0.7 of odometry's motion: they fall behind by 0.3 s per second, or odometry is too long."""
    faults, accused, _ = drive(lambda o, t: (o, o * [0.7, 1.0, 1.0]), straight, stamps=stamps(*[distance] * 5))
    if wrong == "clouds":
        assert accused.cause is RejectionReason.CLOCK
        assert "more and more" in accused.sentence
        assert faults.rescaled(RISK) is None
    else:
        assert accused is None
        assert faults.rescaled(RISK)[0] == pytest.approx(0.7, abs=0.05)


@pytest.mark.parametrize(
    ("x", "y", "degrees", "words"),
    [
        (0.0, 0.0, -10.0, "turned by 10 degrees"),
        (0.0, 0.0, 5.0, "turned by 5 degrees"),
        (0.0, 0.0, 90.0, "turned by 90 degrees"),
        (0.5, 4.0, 0.0, "clouds jumped by 4.0 m"),
    ],
)
def test_sensor_that_turned_or_jumped_on_its_mount_is_named_with_its_motion(x, y, degrees, words):
    _, accused, seconds = drive(displaced(x, y, degrees))
    assert accused.cause is RejectionReason.MOUNT
    assert words in accused.sentence
    assert seconds <= 3.0


@pytest.mark.parametrize(
    ("change", "turn", "delay"),
    [(displaced(0.0, 0.0, 10.0), np.radians(10.0), 0.0), (late(1.0), 0.0, 1.0)],
    ids=["mount", "delay"],
)
def test_a_fault_that_the_calibration_has_followed_is_none(change, turn, delay):
    faults, accused, _ = drive(change)
    assert accused is not None
    faults.corrected(np.array([0.0, 0.0, turn]), delay)
    assert faults.accusation(*LEVEL, RISK) is None


@pytest.mark.parametrize(
    "slip", [(0.5, 0.0, 0.0), (0.0, 0.8, 0.1), (3.0, 1.0, np.radians(15.0)), (900.0, 500.0, 0.0)], ids=str
)
def test_wheels_that_slip_or_odometry_that_jumps_are_no_fault_of_the_lidar(slip):
    faults, accused, _ = drive(lambda o, t: (o + np.array(slip) * (t < 10.4), o))
    assert accused is None
    assert faults.good > 0.9


@pytest.mark.parametrize("factor", [1.5, 0.7])
def test_odometry_that_goes_out_of_scale_is_no_fault_of_the_lidar(factor):
    faults, accused, _ = drive(lambda o, t: (o * [factor, factor, 1.0], o))
    assert accused is None
    scale, sigma = faults.rescaled(RISK)
    assert abs(scale * factor - 1.0) < 4.0 * sigma
    assert faults.good > 0.99


def test_odometry_that_stands_still_is_no_fault_of_the_lidar():
    _, accused, seconds = drive(lambda o, t: (0.0 * o, o), until=15.0, stamps=stamps(*[0.1] * 5))
    assert accused.cause is RejectionReason.STOPPED
    assert "odometry stands still while the lidar moves" in accused.sentence
    assert seconds <= 2.0 * DT


def test_odometry_that_goes_on_after_it_stood_is_believed_again():
    """For three seconds clouds that are late by as much would move on as well."""
    faults, odometry, o = FaultPosterior(), Odometry(5.0), np.array([SPEED * DT, 0.0, 0.0])
    for k in range(20):
        shown, seen = (o if k < 5 or k >= 15 else 0.0 * o), Seen(o, NOISE)
        faults.add(Step(DT, Seen(shown, NOISE), seen, seen, *odometry.move(shown), stamps=stamps(*[0.1] * 5)))
        assert k not in (12, 13, 14) or faults.stopped > 0.99
        assert 5 <= k < 15 or (faults.good > 0.99 and faults.accusation(*LEVEL, RISK) is None)


def test_lag_without_a_hole_in_the_stamps_is_a_slip():
    assert drive(lambda o, t: (o if t >= 10.4 else 1.5 * o, o), stamps=stamps(*[0.1] * 5))[1] is None


@pytest.mark.parametrize("pause", [600.0, 1e5, 1e9])
def test_pause_between_two_frames_accuses_nobody(pause):
    faults, odometry = FaultPosterior(), Odometry(5.0)
    step = np.array([SPEED * DT, 0.0, 0.0])
    for k in range(10):
        seconds = DT if k != 5 else pause
        before, now = odometry.move(step)
        seen = Seen(step, NOISE)
        faults.add(Step(seconds, seen, seen, seen, before, now, stamps=stamps(seconds, usual=DT)))
        assert faults.accusation(*LEVEL, RISK) is None
    assert faults.good > 0.99


def test_clouds_without_a_direction_accuse_nobody():
    """In a tunnel the clouds know nothing of the way along it."""
    wide = np.diag([10.0, 0.02, np.radians(0.3)]) ** 2
    faults, o, odometry = FaultPosterior(), np.array([SPEED * DT, 0.0, 0.0]), Odometry(5.0)
    for _ in range(70):
        faults.add(Step(DT, Seen(o, NOISE), Seen(0.0 * o, wide), None, *odometry.move(o)))
        assert faults.accusation(*LEVEL, RISK) is None


def test_one_wrong_registration_that_the_map_contradicts_accuses_nobody():
    faults, odometry = FaultPosterior(), Odometry(5.0)
    for k, t in enumerate(np.arange(5.0, 25.0, DT)):
        o = moved(pose(t), pose(t + DT))
        seen = 0.4 * o if k % 10 == 9 else o
        faults.add(Step(DT, Seen(o, NOISE), Seen(seen, NOISE), Seen(o, NOISE), *odometry.move(o)))
        assert faults.accusation(*LEVEL, RISK) is None


def test_clouds_of_two_places_in_turns_are_named():
    faults, rng, odometry = FaultPosterior(), np.random.default_rng(2), Odometry(5.0)
    accused = None
    for t in np.arange(5.0, 12.0, DT):
        o = moved(pose(t), pose(t + DT))
        seen = o + rng.normal(size=3) * [2.0, 2.0, 0.3]
        path = odometry.move(o)
        faults.add(Step(DT, Seen(o, NOISE), Seen(seen, NOISE), None, *path, fails=0.9, apart=True))
        accused = accused or faults.accusation(*LEVEL, RISK)
    assert accused.cause is RejectionReason.MIXED


@pytest.mark.parametrize("apart", [0, 6])
def test_clouds_that_show_nothing_accuse_nobody(apart):
    """On a field registration stays where it starts; among bushes clouds often do not fit each other."""
    faults, odometry, nothing = FaultPosterior(), Odometry(5.0), np.diag([50.0, 50.0, 2.0])
    for k, t in enumerate(np.arange(5.0, 55.0, DT)):
        o = moved(pose(t), pose(t + DT))
        unfit = 20 <= k < 20 + apart
        step = Step(DT, Seen(o, NOISE), Seen(0.9 * o, nothing), None, *odometry.move(o), alone=misfits(100.0))
        faults.add(replace(step, apart=True, fails=0.9) if unfit else step)
        assert faults.accusation(*LEVEL, RISK) is None


def test_clouds_that_jump_back_are_no_odometry_out_of_scale():
    """Odometry whose motion is seen five times as long, and backwards, is no odometry out of scale."""
    C = np.array([-4.0, 0.0, 0.0])
    faults, accused, _ = drive(lambda o, t: (o, compose(o, C) if t < 10.4 else o))
    assert faults.rescaled(RISK) is None
    assert accused is None or accused.cause is RejectionReason.MOUNT


def test_a_fault_that_ends_leaves_nothing_behind():
    C = np.array([0.0, 0.0, np.radians(10.0)])

    def turned(o, t):
        if t < 12.9:
            return displaced(0.0, 0.0, 10.0)(o, t)
        return o, o if t >= 13.4 else compose(inverted(C), o)

    assert drive(turned, until=12.5, stops=False)[1] is not None
    faults, accused, _ = drive(turned, until=25.0, stops=False)
    assert accused is None
    assert faults.good + faults.slip > 0.99


def test_robot_that_tilts_is_off_by_a_short_lag():
    """A lag too short for the way to show: the body's tilting turns the pose."""
    level, tilting = (1.0, np.radians(3.0)), np.radians(30.0)
    even, _, _ = drive(late(0.15), until=14.0)
    shaken, _, _ = drive(late(0.15), until=14.0, tilting=tilting)
    assert even.accusation(*level, RISK) is None
    assert shaken.accusation(*level, RISK).cause is RejectionReason.CLOCK


def test_a_scale_that_the_calibration_has_learned_is_not_learned_twice():
    faults, _, _ = drive(lambda o, t: (o * [1.5, 1.5, 1.0], o))
    faults.corrected(np.zeros(3), 0.0, 0.8)
    assert faults.rescaled(RISK)[0] == pytest.approx(1.0 / 1.5 / 0.8, rel=0.02)


def test_slip_since_the_map_has_verified_a_pose_is_remembered():
    assert drive(lambda o, t: (o, o))[0].slipped < 0.05
    faults = drive(lambda o, t: (o + np.array([0.5, 0.0, 0.0]) * (t < 10.4), o))[0]
    assert faults.odometry < 0.1  # it is over
    assert faults.slipped > 100.0
    faults.trusted()
    assert faults.slipped < 0.1
