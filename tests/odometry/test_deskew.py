"""Deskew against a sweep over known walls, measured at once and while driving."""

import numpy as np
import pytest
from fake_robot import ns, pose

from coview_stream.geometry.transforms import exp_so3, inverse, transform
from coview_stream.odometry.buffer import Segment
from coview_stream.odometry.deskew import SweepCorrection, deskew

SPEED = 8.0  # m/s
TURN = 0.6  # rad/s
ODOM_FAR = pose(5230.0, -7710.0, 1.9)


def straight(t):
    return ODOM_FAR @ pose(SPEED * t, 0.0, 0.0)


def turning(t):
    yaw = TURN * t
    return ODOM_FAR @ pose(SPEED / TURN * np.sin(yaw), SPEED / TURN * (1 - np.cos(yaw)), yaw)


def segment(motion, times):
    poses = np.array([motion(t) for t in times]).reshape(-1, 4, 4)
    return Segment(np.array([ns(t) for t in times], np.int64), poses)


def wall(count=800):
    """Points (N, 3) in the odometry frame: a wall ahead and one at the left, as a sweep passes over them."""
    rng = np.random.default_rng(4)
    ahead = np.column_stack([np.full(count, 30.0), rng.uniform(-20, 20, count), rng.uniform(0, 5, count)])
    left = np.column_stack([rng.uniform(-20, 20, count), np.full(count, 15.0), rng.uniform(0, 5, count)])
    return transform(ODOM_FAR, np.concatenate([ahead, left]))


def measured(world, motion, times):
    """Every point in the body frame of its own time, float32 as a lidar has it."""
    rows = [transform(inverse(motion(t)), p[None])[0] for p, t in zip(world, times, strict=True)]
    return np.array(rows, np.float32)


def apart(a, b):
    return float(np.linalg.norm(a.astype(np.float64) - b, axis=1).max())


@pytest.mark.slow
@pytest.mark.parametrize("motion", [straight, turning])
@pytest.mark.parametrize(("begin", "end"), [(0.0, 0.1), (-0.1, 0.0), (-0.05, 0.05)])
def test_deskewed_sweep_equals_instant_scan(motion, begin, end):
    world = wall()
    times = np.random.default_rng(1).uniform(begin, end, len(world))
    swept = measured(world, motion, times)
    at_once = measured(world, motion, np.zeros(len(world)))
    assert apart(swept, at_once) > 0.35
    samples = np.arange(-0.14, 0.141, 0.02)
    moved = deskew(swept, times, segment(motion, samples), ns(0.0), motion(0.0))
    assert moved.dtype == np.float32
    assert apart(moved, at_once) < 0.03  # half a step of the sweep's 64 is 6 mm of road, and 0.5 mrad at 36 m


def test_times_beyond_odometry_use_its_nearest_pose():
    points = np.tile(np.array([[5.0, 1.0, 0.5]], np.float32), (3, 1))
    times = np.array([-1.0, 0.0, 1.0])
    moved = deskew(points, times, segment(straight, [-0.1, 0.0, 0.2]), ns(0.0), straight(0.0))
    expected = [[5.0 - 0.1 * SPEED, 1.0, 0.5], [5.0, 1.0, 0.5], [5.0 + 0.2 * SPEED, 1.0, 0.5]]
    # to one of the sweep's 64 steps
    np.testing.assert_allclose(moved, expected, atol=0.5 * 0.3 * SPEED / 63 + 1e-3)


def test_time_that_is_not_finite_means_the_stamp_and_nan_point_affects_no_other():
    points = np.tile(np.array([[5.0, 1.0, 0.5]], np.float32), (6, 1))
    points[5] = np.nan
    points.setflags(write=False)
    times = np.array([-0.1, np.nan, np.inf, -np.inf, 0.1, 0.05])
    moved = deskew(points, times, segment(straight, [-0.1, 0.0, 0.1]), ns(0.0), straight(0.0))
    np.testing.assert_allclose(moved[:5, 0], [4.2, 5.0, 5.0, 5.0, 5.8], atol=0.02)
    assert np.isnan(moved[5]).all()
    assert (points[:3] == (5.0, 1.0, 0.5)).all()


@pytest.mark.parametrize(("samples", "end"), [([], 0.1), ([0.0], 0.1), ([0.0, 0.1], 0.0)])
def test_fewer_than_two_samples_or_points_at_the_stamp_move_nothing(samples, end):
    points = measured(wall(20), straight, np.zeros(40))
    around = segment(straight, samples)
    same = deskew(points, np.linspace(0, end, 40), around, ns(0.0), straight(0.0))
    np.testing.assert_array_equal(same, points)
    assert deskew(points[:0], np.zeros(0), around, ns(0.0), straight(0.0)).shape == (0, 3)


@pytest.mark.parametrize("times", [[0.05, 0.05], [0.3, 0.4]])
def test_deskew_with_all_points_off_the_stamp(times):
    points = np.array([[5.0, 1.0, 0.5], [6.0, 1.0, 0.5]], np.float32)
    moved = deskew(points, np.array(times), segment(lambda t: pose(10.0 * t), (0.0, 0.1)), ns(0.0), pose(0.0))
    expected = points + np.array([10.0 * min(times[0], 0.1), 0.0, 0.0])
    np.testing.assert_allclose(moved, expected, atol=0.02)


@pytest.mark.slow
def test_leaning_sweep_with_wrong_odometry_is_straight_only_with_the_calibration():
    """A sensor that looks down by four degrees, odometry that measures 7 % too long."""
    world, lean = wall(), exp_so3(np.radians([1.0, 4.0, 0.0]))
    times = np.random.default_rng(1).uniform(-0.1, 0.0, len(world))
    swept = (measured(world, straight, times) @ lean.T).astype(np.float32)
    at_once = measured(world, straight, np.zeros(len(world))) @ lean.T

    def too_long(t):
        return ODOM_FAR @ pose(1.07 * SPEED * t, 0.0, 0.0)

    sweep = segment(too_long, np.arange(-0.14, 0.141, 0.02))
    known = deskew(swept, times, sweep, ns(0.0), too_long(0.0), SweepCorrection(lean.T, 1.0 / 1.07 - 1.0))
    assert apart(known, at_once) < 0.01
    assert apart(deskew(swept, times, sweep, ns(0.0), too_long(0.0)), at_once) > 0.05
    assert apart(deskew(swept, times, sweep, ns(0.0), too_long(0.0), SweepCorrection(lean.T)), at_once) > 0.05
