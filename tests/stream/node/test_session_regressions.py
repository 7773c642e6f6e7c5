"""Hazards that were found once: each let a wrong pose out, lost a right one, or miscounted."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from fake_node import Site
from fake_robot import DRIFT, Robot, ns, numbered, pose, search_request, search_result, tracking, unknown
from hypothesis import given, settings
from hypothesis import strategies as st
from small_world import pose_error
from sockets import until
from test_session_random_events import live, quiet, usual

from coview_stream.geometry.transforms import pose_from
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.state import State
from coview_stream.odometry.buffer import Segment
from coview_stream.odometry.deskew import deskew
from coview_stream.stream.node.counters import PoseRate


def test_frame_result_of_before_reset_is_ignored():
    robot = Robot()
    robot.drive(-0.1, 0.1)
    robot.saw(0.0)
    job = robot.session.take_frame()
    robot.session.reset()
    robot.session.handle_result(job, tracking(job), robot.now)
    assert robot.counters.received == robot.counters.processed == 0


def test_search_result_of_before_reset_is_ignored():
    robot = Robot()
    robot.frame(0.0, unknown, ask=search_request(0.0))
    job = robot.session.take_search_request()
    robot.session.reset()
    robot.session.handle_result(job, search_result(), robot.now)
    assert robot.counters.searches == 0


reset = st.tuples(st.just("reset"), st.none())


@pytest.mark.slow
@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.lists(st.one_of(usual, usual, st.lists(st.one_of(*quiet, reset), max_size=4)), max_size=12))
def test_random_events_with_resets_keep_invariants(chapters):
    live([event for chapter in chapters for event in chapter])


def test_frame_from_before_gap_does_not_count_as_verification():
    robot = Robot().localized(0.0)
    robot.drive(0.05, 0.3)
    robot.saw(0.2)
    robot.session.tick(robot.now + 0.6)  # silence: LOST, the next frame is suspect
    busy = robot.session.take_frame()
    assert busy.require_verification
    robot.moved(2.0, x=0.6, now=robot.now + 1.7)  # the robot was carried away meanwhile
    assert robot.counters.odometry_gaps == 1
    robot.session.handle_result(busy, tracking(busy), robot.now + 0.01)  # verified, but where it was before
    robot.moved(2.1, x=0.6, now=robot.now + 0.1)
    robot.saw(2.05)
    job = robot.session.take_frame()
    assert job.require_verification


def test_odometry_gap_during_first_fix_restarts_search():
    robot = Robot()
    robot.frame(0.0, unknown, state=State.AMBIGUOUS)
    robot.drive(0.05, 0.3)
    robot.saw(0.2)
    busy = robot.session.take_frame()  # carries the verdict that will be accepted
    robot.moved(2.0, x=0.6, now=robot.now + 0.02)
    assert robot.counters.odometry_gaps == 1
    robot.session.handle_result(busy, tracking(busy), robot.now + 0.01)
    assert robot.session.pose() is None
    robot.moved(2.1, x=0.6, now=robot.now + 0.1)
    robot.saw(2.05)
    assert robot.session.take_frame().epoch > busy.epoch  # the search begins anew


def test_long_odometry_outage_loses_the_place():
    robot = Robot().localized(0.0)
    robot.drive(0.05, 0.3)
    assert robot.session.pose() is not None
    robot.moved(2.7, x=0.6, now=robot.now + 2.4)
    assert robot.session.pose() is None
    assert robot.session.state() == (State.LOST, "odometry was away for too long")


@pytest.mark.parametrize(("seconds", "state"), [(6.0, State.DOUBTED), (12.0, State.LOST)])
def test_network_outage_keeps_the_place_for_max_outage(seconds, state):
    robot = Robot().localized(0.0)
    robot.drive(0.05, 0.3)
    robot.session.on_disconnected(robot.now + 1.0)
    robot.moved(0.3 + seconds, x=0.6, now=robot.now + seconds)
    assert robot.session.pose() is None
    assert robot.session.state()[0] is state
    robot.moved(0.4 + seconds, x=0.6, now=robot.now + 0.1)
    robot.saw(0.35 + seconds)
    job = robot.session.take_frame()
    assert job.require_verification or state is State.LOST
    robot.session.handle_result(job, tracking(job), robot.now + 0.01)
    assert robot.session.pose() is not None


def test_one_stamp_never_gets_two_poses():
    robot = Robot().localized(0.0)
    first = robot.session.pose()
    robot.saw(0.0)
    robot.drive(0.05, 0.1)
    robot.saw(0.1)
    job = robot.session.take_frame()
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
    job = robot.session.take_frame()
    robot.session.handle_result(job, tracking(job, drift=drift, covariance=known), 1003.0)
    grown = robot.session.pose().covariance - known
    np.testing.assert_allclose(grown, drift.reported(4.0, 0.0), rtol=0.05)


@pytest.mark.parametrize("second", [None, search_result(1.0)])
def test_accepted_search_result_is_not_replaced(second):
    robot = Robot()
    robot.frame(0.0, unknown, ask=search_request(0.0))
    first = robot.session.take_search_request()
    robot.frame(0.1, unknown, ask=search_request(0.1))
    accepted = search_result(0.0, accepted="a place")
    robot.session.handle_result(first, accepted, robot.now)
    job = robot.session.take_search_request()
    if second is None:
        robot.session.handle_failure(job, "boom")
    else:
        robot.session.handle_result(job, second, robot.now)
    assert robot.frame(0.2, unknown).search_result is accepted


def test_frame_without_odometry_is_not_counted_missing():
    robot = Robot()
    robot.moved(0.0, x=0.0)
    robot.saw(0.0, attachment=numbered(1, 0.0))
    robot.session.take_frame()
    robot.saw(0.3, attachment=numbered(2, 0.3))
    robot.session.tick(robot.now + 1.0)  # the second found none
    robot.moved(0.45, x=0.0)
    robot.saw(0.45, attachment=numbered(3, 0.45))
    assert (robot.counters.no_odometry, robot.counters.missing) == (1, 0)


def _segment(*times):
    return Segment(np.array([ns(t) for t in times], np.int64), np.array([pose(10.0 * t) for t in times]))


@pytest.mark.parametrize("times", [[0.05, 0.05], [0.3, 0.4]])
def test_deskew_with_all_points_off_the_stamp(times):
    points = np.array([[5.0, 1.0, 0.5], [6.0, 1.0, 0.5]], np.float32)
    moved = deskew(points, np.array(times), _segment(0.0, 0.1), ns(0.0), pose(0.0))
    expected = points + np.array([10.0 * min(times[0], 0.1), 0.0, 0.0])
    np.testing.assert_allclose(moved, expected, atol=0.02)


def test_pose_rate_of_simultaneous_poses():
    rate = PoseRate()
    rate.add(1.0)
    rate.add(1.0)
    assert rate.rate(1.0) >= 0.0


@pytest.mark.slow
def test_robot_moved_during_odometry_pause_gets_no_wrong_pose(world_map, world_drive):
    """Odometry paused, the robot was moved by hand 10 m back, and odometry goes on where it was."""
    localizer = Localizer(world_map)
    for k in range(6):
        fix = localizer.step(world_drive.clouds[k], world_drive.T_odom_body[k], 0.5 * k)
    assert fix.state is State.TRACKING
    localizer.require_verification()
    fixes = [localizer.step(world_drive.clouds[0], world_drive.T_odom_body[5], 2.6)]
    ahead = world_drive.T_odom_body[5]
    for k in range(1, 4):
        ahead = ahead @ pose_from(np.eye(3), [2.1, 0.0, 0.0])
        fixes.append(localizer.step(world_drive.clouds[k], ahead, 2.6 + 0.5 * k))
    wrong = [
        round(pose_error(fix.T_map_body, world_drive.T_map_body[k])[0], 1)
        for k, fix in enumerate(fixes)
        if fix.T_map_body is not None
    ]
    assert not wrong, f"poses wrong by {wrong} m"


def test_unencodable_pose_of_one_robot_does_not_affect_others():
    site = Site("r1", "r2")
    site.node.declare()
    site.engine.answer = lambda job: tracking(job, sigma=float("nan") if job.robot == "r1" else 0.1)
    for name in ("r1", "r2"):
        site.frame(name, 0.0)
    site.node.publish_poses(time.monotonic())
    assert len(site.net.samples("coview/r2/out/pose")) == 1


def test_unexpected_engine_error_does_not_stop_the_node():
    site = Site("r1")
    run = site.track.run
    errors = [RuntimeError("unforeseen")]
    site.track.run = lambda job: run(job) if not errors else (_ for _ in ()).throw(errors.pop())
    site.node.start()
    try:
        clock = iter(range(100_000))

        def localized():
            site.sees("r1", 0.02 * next(clock))
            return site.net.samples("coview/r1/out/pose")

        until(localized, 3.0)
    finally:
        site.node.close()
