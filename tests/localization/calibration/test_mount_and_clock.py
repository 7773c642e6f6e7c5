"""Mount and clock as states: heading and lever arm of the sensor, and the delay between clouds and odometry."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from se3 import exp_se3

from coview_stream.config.mount import Mount
from coview_stream.errors import InputError
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, rotation_angle
from coview_stream.localization.calibration.calibration import (
    CLOCK_TOLERANCE,
    HEADING_TOLERANCE,
    LEVER_TOLERANCE,
    Calibration,
)
from coview_stream.localization.calibration.delay_search import DELAYS, DelaySearch, SeenMotion
from coview_stream.localization.calibration.estimator import SIZE, CalibrationBelief, CalibrationEstimator
from coview_stream.localization.calibration.odometry_history import Moment, OdometryHistory
from coview_stream.localization.frame import OdometryCorrection

POSITION, HEADING = 0.01, np.radians(0.1)  # sigmas of a registration
RATE = 100  # poses of the way per second


def way(speed, rate, seconds=60.0):
    """Poses (N, 4, 4) of a robot, a hundred a second, of its speed and turning rate at each moment."""
    T, poses = np.eye(4), []
    for t in np.arange(int(seconds * RATE)) / RATE:
        poses.append(T)
        T = T @ exp_se3(np.array([0.0, 0.0, rate(t), speed(t), 0.0, 0.0]) / RATE)
    return np.array(poses)


WINDING = way(lambda t: 1.5 + 0.8 * np.sin(0.9 * t), lambda t: 0.5 * np.sin(0.4 * t))
STRAIGHT = way(lambda t: 1.5, lambda t: 0.0)


class Drive(NamedTuple):
    """A drive along known poses, registered to the map once a second, with a delay and a mount."""

    poses: np.ndarray
    delay: float = 0.0
    mount: np.ndarray = np.eye(4)
    noise: float = 0.0  # radians of odometry's heading at each of its steps
    every: int = 10  # tenths of a second between registrations
    seed: int = 1
    turn: float = 0.0  # radians per metre of odometry's heading

    def learnt(self, earlier=None, stated=0.0, drawn=True):
        """Return the estimator after the drive."""
        estimator, correction = CalibrationEstimator(cloud_delay=stated, mount_drawn=drawn), OdometryCorrection()
        rng = np.random.default_rng(self.seed)
        history = estimator.history
        if earlier is not None:
            estimator.learn(earlier)
        newest = marked = None
        T_odom = before_it = self.at(2.0 - max(-self.delay, 0.0))
        for stamp in np.arange(2.0, 58.0, 0.1):
            late = estimator.calibration.delay
            before = None if newest is None else history.at(newest - late)
            now = self.at(stamp - max(-self.delay, 0.0))
            wrong = self.turn * float(np.linalg.norm(now[:2, 3] - before_it[:2, 3]))
            turned = rot_z(wrong + (rng.normal(0.0, self.noise) if self.noise else 0.0))
            T_odom, before_it = T_odom @ inverse(before_it) @ now @ pose_from(turned, np.zeros(3)), now
            history.add(stamp, T_odom)
            newest = stamp
            T = correction.correct(history.at(stamp - late), estimator.calibration, before)
            estimator.search_delay()
            if round(10 * stamp) % self.every:
                continue
            noise = exp_se3(rng.normal(0.0, [0, 0, HEADING, POSITION, POSITION, 0]))
            T_cloud = self.at(stamp - max(self.delay, 0.0)) @ self.mount @ noise
            mark = T, Moment(stamp, history.rates(stamp - late)), T_cloud
            if marked is not None:
                level = inverse(estimator.calibration.T_body_cloud)
                spread = 2.0 * np.diag([POSITION, POSITION + 1.5 * HEADING, HEADING]) ** 2
                spread[2, 2] += self.every * self.noise**2
                estimator.measure_motion(
                    marked[2] @ level, T_cloud @ level, inverse(marked[0]) @ T, spread, (marked[1], mark[1])
                )
            marked = mark
        return estimator

    def at(self, stamp):
        """Return the body's pose (4, 4) at a time."""
        return self.poses[round(stamp * RATE)]


@pytest.mark.parametrize("delay", [0.0, 0.12, -0.12, 0.4, -0.3])
def test_delay_is_measured_where_the_robot_turns_and_accelerates(delay):
    found = Drive(WINDING, delay).learnt().calibration
    assert found.delay == pytest.approx(delay, abs=max(0.01, 4.0 * found.sigma_delay))
    assert found.sigma_delay < 0.01
    assert abs(np.degrees(found.heading)) < 0.1
    assert np.hypot(found.lever_x, found.lever_y) < 0.02


def test_a_delay_and_a_turn_of_odometry_are_told_apart():
    found = Drive(WINDING, 0.3, turn=np.radians(0.3)).learnt().calibration
    assert found.delay == pytest.approx(0.3, abs=0.01)
    assert np.degrees(found.turn) == pytest.approx(-0.3, abs=0.05)


@pytest.mark.parametrize("seed", [100, 102, 103, 104])
def test_noise_of_odometry_is_no_delay(seed):
    """A backward difference of the newest step has the noise of that step, which looks like half a step's delay.

    At constant speed every motion favours another delay by chance, too.
    """
    found = Drive(STRAIGHT, noise=np.radians(0.2), every=3, seed=seed).learnt().calibration
    assert abs(found.delay) < 0.001
    assert found.sigma_delay < 0.005


def test_interpolation_of_odometry_averages_its_noise():
    history = OdometryHistory.of(np.arange(0.0, 3.0, 0.2), np.tile(np.eye(4), (15, 1, 1)))
    begins = np.array([0.4, 0.5, 0.45])
    np.testing.assert_allclose(history.noise_share(begins, begins + 0.6), [1.0, 5 / 6, 1 - 3 / 24])


def test_heading_and_lever_arm_are_measured():
    mount = pose_from(rot_z(np.radians(-20.0)), [0.6, -0.3, 0.0])
    found = Drive(WINDING, mount=mount).learnt().calibration
    np.testing.assert_allclose(found.T_body_cloud[:2, 3], mount[:2, 3], atol=0.04)
    assert np.degrees(rotation_angle(found.R_body_cloud.T @ mount[:3, :3])) < 0.2
    assert abs(found.delay) < 0.01
    assert any("--mount=0,0,-20.1,0.6" in clause for clause in found.describe())


def test_straight_ahead_at_constant_speed_tells_the_heading_alone():
    prior = CalibrationEstimator().calibration
    mount = pose_from(rot_z(np.radians(5.0)), [0.6, 0.0, 0.0])
    found = Drive(STRAIGHT, 0.2, mount).learnt().calibration
    assert np.degrees(found.heading) == pytest.approx(5.0, abs=0.2)
    assert found.sigma_heading < 0.4 * prior.sigma_heading
    assert found.sigma_lever > 0.7 * prior.sigma_lever
    assert found.sigma_delay > 0.7 * prior.sigma_delay
    assert abs(found.delay) < 0.02


def test_step_is_followed_once_it_is_supposed():
    """Ten metres after a sensor has turned by ten degrees; the state is sure of the earlier heading."""
    estimator = Drive(WINDING).learnt()
    sure = estimator.calibration.sigma_heading
    estimator.widen_mount()
    estimator.widen_clock()
    wide = estimator.calibration
    assert wide.sigma_heading > np.radians(5.0) > 20.0 * sure
    assert wide.sigma_lever > 0.3
    assert wide.sigma_delay > 0.2
    assert wide.heading == pytest.approx(0.0, abs=np.radians(0.1))  # as likely as any other
    turned = rot_z(np.radians(10.0))
    for _ in range(10):
        level = inverse(estimator.calibration.T_body_cloud)
        T = pose_from(turned, np.zeros(3))
        seen = inverse(T) @ pose_from(np.eye(3), [1.0, 0.0, 0.0]) @ T
        spread = np.diag([POSITION, POSITION, HEADING]) ** 2
        estimator.measure_motion(level, seen @ level, pose_from(np.eye(3), [1.0, 0.0, 0.0]), spread)
    assert np.degrees(estimator.calibration.heading) == pytest.approx(10.0, abs=0.3)


def test_earlier_mount_and_clock_are_kept_until_refuted():
    earlier = Calibration(
        delay=0.1, heading=np.radians(3.0), lever_x=0.5, sigma_delay=1e-3, sigma_heading=1e-3, sigma_lever=1e-2
    )
    estimator = CalibrationEstimator()
    estimator.learn(earlier.doubted())
    found = estimator.calibration
    assert (found.delay, found.heading, found.lever_x) == pytest.approx((0.1, np.radians(3.0), 0.5), rel=0.01)
    assert abs(Drive(WINDING).learnt(earlier.doubted()).calibration.delay) < 0.01


def test_stated_delay_is_the_prior_and_is_not_remarked():
    stated = CalibrationEstimator(cloud_delay=0.12).calibration
    assert stated.delay == pytest.approx(0.12)
    assert stated.sigma_delay == CalibrationEstimator().calibration.sigma_delay
    assert stated.describe() == []
    assert replace(stated, delay=0.2, sigma_delay=0.005).describe() == [
        "clouds are 0.200 +- 0.005 s later than odometry: corrected; "
        "set --cloud-delay=0.20: the first poses are off by it"
    ]
    own = CalibrationEstimator(sensor_leans=False).calibration
    assert own.delay == own.stated_delay == 0.0


def test_stated_delay_replaces_one_that_was_learnt_before_it_was_stated():
    earlier = Drive(WINDING, 0.1).learnt().calibration
    for stated, known in ((0.0, 0.1), (0.5, 0.5)):
        estimator = CalibrationEstimator(cloud_delay=stated)
        estimator.learn(earlier.doubted())
        assert estimator.calibration.delay == pytest.approx(known, abs=0.01)


def test_delay_that_cannot_be_stated_is_not_to_be_set():
    (clause,) = Calibration(delay=1.3, sigma_delay=0.01).describe()
    assert clause.endswith("corrected")


def test_stated_delay_that_is_wrong_is_found_out():
    estimator = Drive(WINDING, 0.2).learnt(stated=-0.1)
    assert estimator.calibration.delay == pytest.approx(0.2, abs=0.005)


@pytest.mark.parametrize("values", [{"roll": np.nan}, {"lever_x": 1e9}, {"sigma_delay": -0.1}, {"delay": np.inf}])
def test_values_of_no_robot_are_refused_by_name(values):
    assert Calibration().doubted().require_plausible() == Calibration().doubted()
    with pytest.raises(InputError, match=f"calibration: {next(iter(values))} is .* none of a robot; give "):
        Calibration(**values).require_plausible()


def test_odometry_is_read_between_and_beyond_its_samples():
    history, turn = OdometryHistory(), pose_from(rot_z(0.05), rot_z(0.025) @ [0.2, 0.0, 0.0])
    poses = [np.eye(4), turn, turn @ turn]
    for k, T in enumerate(poses):
        history.add(0.1 * k, T)
    np.testing.assert_allclose(history.at(0.1), poses[1])
    np.testing.assert_allclose(history.at(0.15), turn @ pose_from(rot_z(0.025), rot_z(0.0125) @ [0.1, 0, 0]), atol=2e-3)
    np.testing.assert_allclose(history.at(0.3), turn @ turn @ turn, atol=1e-3)
    np.testing.assert_allclose(history.rates(0.1), [2.0, 0.0, 0.5], atol=1e-2)
    assert np.isnan(OdometryHistory().rates(0.0)).all()


def test_errors_of_mount_and_clock_are_in_the_poses_covariance():
    sure = Calibration(sigma_heading=HEADING_TOLERANCE, sigma_lever=LEVER_TOLERANCE, sigma_delay=CLOCK_TOLERANCE)
    ahead = np.array([2.0, 0.0, 0.1])
    assert not sure.pose_covariance(np.eye(3), ahead).any()
    north = rot_z(np.pi / 2)
    late = replace(sure, delay=0.5, sigma_delay=0.02)
    moved = np.array([0, 0, 0.01, 0, 4.0, 0]) * (0.02**2 - CLOCK_TOLERANCE**2)
    np.testing.assert_allclose(np.diag(late.pose_covariance(north, ahead)), moved, atol=1e-15)
    standing = late.pose_covariance(north, np.zeros(3))
    assert not standing.any()
    turned = replace(sure, sigma_heading=0.01, sigma_lever=0.1).pose_covariance(north, ahead)
    lever = 0.1**2 - LEVER_TOLERANCE**2
    np.testing.assert_allclose(np.diag(turned), [0, 0, 1e-4 - HEADING_TOLERANCE**2, lever, lever, 0])


def test_guessed_mount_is_in_the_poses_covariance_until_motion_shows_it():
    """The doctor's heading, 2.3 degrees off, of a lidar whose place nobody has stated."""
    off = pose_from(rot_z(np.radians(2.3)), [0.2, -0.1, 0.0])
    still, ahead = np.zeros(3), Drive(STRAIGHT, mount=off).learnt(drawn=False).calibration
    before = CalibrationEstimator(mount_drawn=False).calibration
    for prior in (before, ahead):  # straight on, nothing shows a lever arm
        spread = np.sqrt(np.diag(prior.pose_covariance(np.eye(3), still)))
        assert spread[3:].min() > 0.4
    assert before.sigma_heading > np.radians(5.0) > 10.0 * ahead.sigma_heading
    found = Drive(WINDING, mount=off).learnt(drawn=False).calibration
    assert np.degrees(found.heading) == pytest.approx(2.3, abs=0.1)
    assert (found.lever_x, found.lever_y) == pytest.approx((0.2, -0.1), abs=0.03)
    assert max(found.sigma_lever, found.sigma_heading) < 0.03
    assert found.sigma_height == before.sigma_height > 0.4  # never shown
    (clause,) = [clause for clause in found.describe(Mount(yaw=0.5, drawn=False)) if "turned" in clause]
    assert "--mount=0,0,30.9,0.2,-0.1,Z to silence this, metres by the drawing" in clause


def test_mount_is_said_beyond_the_one_given():
    turned = Calibration(heading=np.radians(3.0), sigma_heading=np.radians(0.1))
    (text,) = turned.describe(Mount(roll=np.pi))
    assert text.startswith("sensor is turned 3.0 +- 0.1 deg to the left on the body beyond its mount: corrected")
    assert "--mount=180,0,3,0,0,0 " in text
    assert "odometry is 0.300" in Calibration(delay=-0.3).describe()[0]


def test_motions_that_wait_are_forgotten_with_the_mount_that_they_saw():
    """Where odometry is late a motion waits for it; by then the sensor may have been turned."""
    for widened in (False, True):
        estimator = CalibrationEstimator()
        estimator.learn(Calibration(delay=-0.3), same_run=True)
        for k in range(40):
            estimator.history.add(0.1 * k, pose_from(np.eye(3), [0.15 * k, 0.0, 0.0]))
        step, still = pose_from(np.eye(3), [1.5, 0.0, 0.0]), np.array([1.5, 0.0, 0.0])
        spread = np.diag([POSITION, POSITION, HEADING]) ** 2
        estimator.measure_motion(np.eye(4), step, step, spread, (Moment(2.0, still), Moment(3.0, still)))
        if widened:
            estimator.widen_mount()
        before = estimator.calibration.sigma_heading
        for k in range(40, 50):
            estimator.history.add(0.1 * k, pose_from(np.eye(3), [0.15 * k, 0.0, 0.0]))
        estimator.search_delay()
        assert (estimator.calibration.sigma_heading < 0.99 * before) is not widened


def test_delay_is_searched_again_after_a_stop_that_is_longer_than_the_history():
    """The motion that spans the stop is passed over: odometry of its begin is forgotten."""
    search, history = DelaySearch(), OdometryHistory()
    for k in range(401):
        history.add(0.1 * k, pose_from(np.eye(3), [0.1 * max(0, k - 300), 0.0, 0.0]))
    step = pose_from(np.eye(3), [1.0, 0.0, 0.0])
    for begin, end in ((0.0, 31.0), (35.0, 36.0)):
        search.add(SeenMotion(step, begin, end, Calibration(), 1e-4 * np.eye(3), np.zeros((3, 6))))
    assert [seen.begin for seen, *_ in search.judge(history)] == [35.0]


def test_shaking_speaks_against_a_delay_that_errors_of_heading_look_like():
    """As at the end of a turn in which odometry slipped."""
    belief = CalibrationBelief(sensor_leans=True)
    H = np.zeros((1, SIZE))
    H[0, 6] = 1.0
    belief.update(np.array([0.1]), H, np.array([[0.02**2]]))
    assert belief.applied().delay > 0.05
    belief.shaking = -0.5 * (DELAYS / 0.02) ** 2
    assert belief.applied().delay < 0.001
    belief.shaking = -0.5 * ((DELAYS - 0.1) / 0.02) ** 2
    assert belief.applied().delay == pytest.approx(0.1, abs=0.005)
