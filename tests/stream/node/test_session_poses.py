"""Poses that may be believed, and silence that ends them."""

from dataclasses import replace

import numpy as np
import pytest
from fake_robot import DRIFT, SHA, T_MAP_ODOM, Robot, doubted, ns, pose, reason, state, tracking, unknown

from coview_stream.config.node import NodeConfig
from coview_stream.geometry.protection import ProtectionLevel, protection_level
from coview_stream.localization.state import State


def age(robot):
    return robot.session.robot_state.age(robot.session.inputs.odometry)


def level(robot):
    return robot.session.robot_state.protection_level(robot.session.inputs.odometry)


def test_pose_is_corrected_newest_odometry(robot):
    robot.localized(0.0)
    robot.drive(0.05, 0.4)
    sent = robot.session.pose()
    assert sent.stamp_ns == ns(0.4)
    np.testing.assert_allclose(sent.T_map_body, T_MAP_ODOM @ pose(0.8), atol=1e-9)
    assert (sent.robot, sent.state, sent.map_sha256, sent.confidence) == ("r1", "TRACKING", SHA, 0.8)
    assert sent.age == pytest.approx(0.4)
    assert age(robot) == pytest.approx(0.4)


def test_pose_covariance_grows_with_distance_and_turn():
    drift = replace(DRIFT, position=0.2, height=0.2, turn=0.3)
    known = np.diag([0.01, 0.01, 0.01, 0.0, 0.0, 0.0])
    robot = Robot()
    robot.localized(0.0, drift=drift, covariance=known)
    begin = robot.session.pose().covariance
    robot.moved(1.0)
    robot.moved(2.0)
    robot.frame(2.1, drift=drift, covariance=known)
    np.testing.assert_allclose(np.diag(robot.session.pose().covariance), np.diag(begin), atol=2e-3)
    robot.drive(2.2, 4.1)
    later = robot.session.pose().covariance
    np.testing.assert_allclose(later, known + drift.reported(4.0, 0.0), rtol=0.03)
    for k in range(20):
        robot.moved(4.15 + 0.05 * k, x=8.2, yaw=0.05 * k)
    turned = robot.session.pose().covariance
    assert turned[5, 5] == pytest.approx(later[5, 5] + (0.3 * 0.95) ** 2, rel=0.05)
    assert turned[0, 0] == pytest.approx(later[0, 0], rel=0.05)


def test_protection_level_grows_with_distance_and_keeps_its_doubt():
    known = np.diag([0.01, 0.01, 0.01, 1e-4, 1e-4, 1e-4])
    robot = Robot()
    robot.localized(0.0, covariance=known, protection=ProtectionLevel(9.0, 9.0, 9.0, 9.0, doubt=1.5))
    begin = robot.session.pose()
    assert begin.protection == protection_level(begin.covariance, 1.5)
    robot.drive(0.05, 2.0)
    later = robot.session.pose()
    assert later.protection == protection_level(later.covariance, 1.5)
    assert later.protection.metres > begin.protection.metres
    assert level(robot) == later.protection
    robot.frame(2.1, doubted)
    assert level(robot) is None


def test_heading_error_propagates_to_position(robot):
    heading = np.zeros((6, 6))
    heading[5, 5] = np.radians(1.0) ** 2
    robot.localized(0.0, covariance=heading)
    robot.drive(0.05, 2.0)
    later = robot.session.pose()
    gathered = DRIFT.reported(4.0, 0.0)
    along = later.T_map_body[:3, 0]
    across = later.T_map_body[:3, 1]
    lever = later.covariance[:3, :3] - gathered[:3, :3]
    assert np.sqrt(across @ lever @ across) == pytest.approx(4.0 * np.radians(1.0), rel=0.02)
    assert abs(along @ lever @ along) < 1e-4
    # who is off to the left (a positive yaw) lies to the left: both errors are one
    assert across @ later.covariance[:3, 5] == pytest.approx(4.0 * np.radians(1.0) ** 2, rel=0.02)
    np.testing.assert_allclose(later.covariance, later.covariance.T)


def test_odometry_timeout_ends_the_pose_until_a_frame_is_verified(robot):
    robot.localized(0.0)
    robot.session.tick(robot.now + 0.49)
    assert robot.session.pose() is not None
    silent = robot.now + 0.51
    robot.session.tick(silent)
    assert age(robot) is None
    assert robot.session.state() == (State.LOST, "no odometry for 0.5 s")
    robot.moved(0.2, now=silent + 0.01)
    assert robot.session.pose() is None
    assert state(robot) is State.LOST
    robot.saw(0.19, now=silent + 0.02)
    job = robot.answered(doubted, silent + 0.05)
    assert job.require_verification
    assert robot.session.pose() is None
    robot.moved(0.3, now=silent + 0.1)
    robot.saw(0.29, now=silent + 0.1)
    robot.answered(tracking, silent + 0.15)
    assert state(robot) is State.TRACKING
    assert robot.session.pose() is not None
    robot.moved(0.4, now=silent + 0.2)
    assert not robot.job_for(0.39, now=silent + 0.2).require_verification


def test_frame_from_before_odometry_timeout_does_not_restore_the_pose(robot):
    robot.localized(0.0)
    robot.drive(0.05, 0.3)
    job = robot.job_for(0.25)
    robot.session.tick(robot.now + 0.6)
    robot.session.handle_result(job, tracking(job), robot.now + 0.7)
    assert robot.session.pose() is None
    assert state(robot) is State.LOST


def test_dead_reckoning_ends_after_its_timeout_and_frames_of_no_use_do_not_extend_it():
    robot = Robot(NodeConfig(dead_reckoning_timeout=2.0)).localized(0.0)
    for k in range(1, 45):
        robot.moved(0.05 * k)
        robot.session.handle_failure(robot.job_for(0.05 * k - 0.01), "too few points", rejected=True)
        robot.session.tick(robot.now)
        assert k >= 39 or robot.session.pose() is not None
    assert robot.session.pose() is None
    assert reason(robot).endswith("no usable frame for 2 s")
    assert robot.job_for(2.195).require_verification


def test_odometry_jump_restarts_search(robot):
    first = robot.localized(0.0).frame(0.1)
    robot.moved(0.15, x=900.0)
    assert robot.session.pose() is None
    assert robot.session.state() == (State.LOST, "odometry jumped")
    robot.moved(0.2, x=900.1)
    job = robot.job_for(0.18)
    np.testing.assert_allclose(job.hint, T_MAP_ODOM @ pose(0.2), atol=1e-9)  # the newest that was verified
    assert job.epoch != first.epoch
    assert not job.require_verification  # the engine begins anew as well
    assert job.search_result is None


def test_restarted_sender_clock_may_publish_older_stamps():
    robot = Robot().localized(100.0)
    for k in range(30):
        robot.moved(0.05 * k, now=1100.1 + 0.05 * k)
        robot.session.tick(robot.now)
    assert robot.session.state() == (State.LOST, "the sender's clock started anew")
    robot.saw(1.42, now=1102.0)
    robot.answered(tracking, 1102.0)
    assert robot.session.pose().stamp_ns == ns(1.45)


def test_reason_of_a_lost_robot_is_the_newest_and_the_loss_stays_in_the_history():
    robot = Robot().localized(0.0)
    loss = "odometry jumped"
    robot.moved(1.0, x=900.0, now=1101.9)
    robot.moved(1.1, x=900.0, now=1102.0)
    robot.saw(1.05, now=1102.0)
    robot.answered(lambda job: unknown(job, reason="no place stands out"), 1102.0)
    assert robot.session.state() == (State.LOST, f"no place stands out; before: {loss}")
    robot.session.tick(1142.0)
    silent, _, before = reason(robot).partition("; before: ")
    assert silent.startswith("no clouds for 40 s and no odometry for 4")
    assert before == loss
    assert [change["reason"] for change in robot.session.history.to_json()][-1] == loss


def test_one_stamp_never_gets_two_poses():
    robot = Robot().localized(0.0)
    first = robot.session.pose()
    robot.saw(0.0)
    robot.drive(0.05, 0.1)
    job = robot.job_for(0.1)
    before = robot.session.pose()
    robot.session.handle_result(job, tracking(job, T_map_odom=pose(5.0)), robot.now)
    assert robot.session.pose() is before
    robot.drive(0.15, 0.2)
    after = robot.session.pose()
    assert after.stamp_ns > before.stamp_ns >= first.stamp_ns
    assert abs(after.T_map_body[0, 3] - before.T_map_body[0, 3]) > 1.0


def test_late_cloud_covariance_includes_odometry_since():
    drift = replace(DRIFT, position=0.2, height=0.2)
    known = np.diag([0.01, 0.01, 0.01, 0.0, 0.0, 0.0])
    robot = Robot()
    robot.drive(0.0, 3.0)  # 2 m/s
    robot.saw(1.0, now=1003.0)  # two seconds in the network
    robot.answered(tracking, 1003.0, drift=drift, covariance=known)
    grown = robot.session.pose().covariance - known
    np.testing.assert_allclose(grown, drift.reported(4.0, 0.0), rtol=0.05)
