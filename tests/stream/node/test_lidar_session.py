"""The session of a robot that sends clouds only; the test plays the odometry engine."""

import fake_robot
import numpy as np
import pytest
from fake_robot import POINTS, cloud, counted, ends, message, ns, state

from coview_stream.config.node import NodeConfig
from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.localization.state import State
from coview_stream.stream.node.engine_queue import OdometryResult

TIMES = np.linspace(0.0, 0.1, len(POINTS))


class Robot(fake_robot.Robot):
    """A session and the two engines that work for it, at 10 Hz."""

    def __init__(self, config=None):
        super().__init__(config, lidar=LidarOdometryConfig())
        self.first = True

    def placed(self, restarted=None, **place):
        """Play the odometry engine for one frame; it drives 2 m/s."""
        job = self.session.take_job("odometry")
        if job is None:
            return None
        restarted, self.first = (self.first if restarted is None else restarted), False
        pose = message((job.stamp_ns - ns(0)) * 1e-9, **place).T_odom_body
        deskewed = None if job.times is None else job.points + np.float32(1.0)
        self.session.handle_result(job, OdometryResult(pose, deskewed, restarted, 0.01), self.now + 0.04)
        return job

    def frame(self, seconds, **more):
        self.saw(seconds, codec="foxglove")
        self.placed(**more)
        return self.answered()

    def drive(self, begin, end):
        for k in range(round(10 * begin), round(10 * end) + 1):
            self.frame(0.1 * k)
        return self


@pytest.fixture
def robot():
    return Robot()


def test_frame_is_paired_with_its_own_lidar_odometry(robot):
    job = robot.frame(0.5)
    assert (job.stamp_ns, job.T_odom_body[0, 3]) == (ns(0.5), 1.0)
    assert job.times is None
    pose = robot.session.pose()
    assert pose.stamp_ns == ns(0.5)
    assert counted(robot) == {"received": 1, "processed": 1, "odometry_received": 1, "fixes": 1, "poses": 1}


def test_sweep_is_forwarded_deskewed(robot):
    robot.saw(0.0, codec="foxglove", times=TIMES)
    assert robot.placed().times is not None
    job = robot.answered()
    assert (job.times, job.segment) == (None, None)
    assert np.allclose(job.points, POINTS + 1.0)
    plain = Robot(NodeConfig(deskew=False))
    plain.saw(0.0, codec="foxglove", times=TIMES)
    assert plain.placed().times is None
    assert np.allclose(plain.answered().points, POINTS)


def test_lidar_frame_queue_drops_oldest_when_odometry_is_slow(robot):
    robot.frame(0.0)
    for k in range(1, 8):
        robot.saw(0.1 * k)
    stamps = []
    while (job := robot.placed()) is not None:
        stamps.append(job.stamp_ns)
        robot.answered()
    assert stamps == [ns(0.6), ns(0.7)]
    assert robot.counters.dropped == 5
    assert ends(robot.counters) == robot.counters.received
    assert state(robot) is State.TRACKING


def test_one_odometry_job_at_a_time(robot):
    robot.saw(0.0)
    robot.saw(0.1)
    assert robot.session.take_job("odometry") is not None
    assert robot.session.take_job("odometry") is None


def test_missing_clouds_and_rejected_clouds_have_different_reasons():
    robot = Robot().drive(0.0, 1.0)
    robot.session.tick(robot.now + 0.6)
    assert robot.session.state() == (State.LOST, "no clouds for 0.5 s")
    robot.frame(1.7)
    assert state(robot) is State.TRACKING  # verified by a frame after the pause
    for k in range(6):
        robot.saw(1.8 + 0.1 * k)
        job = robot.session.take_job("odometry")
        robot.session.handle_failure(job, "frame has 3 of 9 points between 1 and 100 m", rejected=True)
    robot.session.tick(robot.now)
    state_now, reason = robot.session.state()
    assert state_now is State.LOST
    assert reason.startswith("lidar odometry has placed no frame for 0.5 s")
    assert robot.counters.rejected == 6
    assert robot.session.errors.texts[-1].endswith("3 of 9 points between 1 and 100 m")


def test_before_the_first_pose_the_reason_names_clouds_not_odometry(robot):
    assert robot.session.state()[1] == "waiting for clouds on coview/r1/in/cloud"
    robot.saw(0.0)
    assert robot.session.state()[1] == "no frame has been processed yet"
    robot.session.handle_failure(robot.session.take_job("odometry"), "no ground to take gravity from", rejected=True)
    assert robot.session.state()[1] == "frames of no use: 1; see errors"


def test_lidar_odometry_restart_restarts_search():
    robot = Robot().drive(0.0, 1.0)
    robot.saw(1.1)
    robot.placed(restarted=True, x=0.0)
    assert robot.session.state() == (State.LOST, "lidar odometry began anew")
    assert robot.session.pose() is None
    assert robot.answered().epoch > 1
    assert state(robot) is State.TRACKING
    assert robot.counters.odometry_jumps == 0  # it is no surprise


@pytest.mark.parametrize("kind", ["failed", "restarted"])
def test_failed_or_restarted_odometry_engine_starts_new_epoch(kind):
    robot = Robot().drive(0.0, 1.0)
    robot.saw(1.1)
    job = robot.session.take_job("odometry")
    if kind == "restarted":
        robot.session.engine_restarted("odometry")
    robot.session.handle_failure(job, "Traceback\nBoom", rejected=False)
    said = {"failed": "lidar odometry failed on a frame", "restarted": "lidar odometry was started again: it died"}
    assert robot.session.state() == (State.LOST, said[kind])
    assert robot.counters.engine_errors == 1
    assert robot.session.inputs.odometry.newest is None
    robot.saw(1.2)
    again = robot.session.take_job("odometry")
    assert again.epoch == job.epoch + 1
    assert ends(robot.counters) == robot.counters.received - 1


def test_odometry_result_of_old_epoch_is_dropped():
    robot = Robot().drive(0.0, 1.0)
    robot.saw(1.1)
    job = robot.session.take_job("odometry")
    robot.session.engine_restarted("odometry")
    robot.session.handle_result(job, OdometryResult(np.eye(4), None, True, 0.0), robot.now)
    assert robot.session.inputs.odometry.newest is None
    assert robot.counters.dropped == 1
    assert robot.frame(1.2, restarted=True) is not None


def test_reset_drops_odometry_and_running_job():
    robot = Robot().drive(0.0, 1.0)
    robot.saw(1.1)
    job = robot.session.take_job("odometry")
    robot.session.reset()
    robot.session.handle_result(job, OdometryResult(np.eye(4), None, False, 0.0), robot.now)
    assert counted(robot) == {}
    robot.saw(0.3)  # with any stamp
    assert robot.session.take_job("odometry").epoch > job.epoch


def test_restart_search_keeps_lidar_odometry():
    robot = Robot().drive(0.0, 1.0)
    robot.session.restart_search("asked to search again")
    robot.saw(1.1)
    assert robot.session.take_job("odometry").epoch == 1
    assert robot.session.inputs.odometry.newest.stamp_ns == ns(1.0)


def test_stray_stamps_are_counted_and_restarted_clock_is_followed():
    robot = Robot().drive(5.0, 6.0)
    robot.saw(6.0)
    robot.now += 0.1
    robot.session.on_cloud(cloud(2.0), robot.now)
    assert (robot.counters.duplicate, robot.counters.out_of_order) == (1, 1)
    before = robot.session.take_job("odometry")
    assert before is None
    for k in range(1, 16):
        robot.session.on_cloud(cloud(0.1 * k), 1006.0 + 0.1 * k)
    assert robot.counters.clock_restarts == 1
    assert robot.session.state() == (State.LOST, "the sender's clock started anew")
    job = robot.session.take_job("odometry")
    assert job.epoch == 2
    assert job.stamp_ns < ns(2.0)
