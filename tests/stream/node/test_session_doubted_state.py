"""A doubt of a place that has been found is not a search: what befalls the robot meanwhile has its consequences."""

from __future__ import annotations

import pytest
from fake_robot import Robot, counted, doubted, ns, reason, state, tracking, unknown

from coview_stream.config.node import NodeConfig
from coview_stream.localization.state import State
from coview_stream.stream.node.status import status
from coview_stream.stream.transport.transport import Connection


@pytest.fixture
def covered():
    """A robot whose sensor has been covered after it was found."""
    robot = Robot().localized(0.0)
    robot.frame(0.1, doubted)
    assert robot.session.state() == (State.DOUBTED, "only 0 points to register")
    return robot


def changes(robot):
    told = status(robot.session, Connection((), ()), 0, 0.0, 1.0)["transitions"]
    return [(c["from"], c["to"], c["reason"]) for c in told]


def test_doubted_state_is_reported_as_ambiguous(covered):
    assert state(covered) is State.DOUBTED
    assert changes(covered)[-1] == ("TRACKING", "AMBIGUOUS", "only 0 points to register")


def test_odometry_pause_while_doubted_keeps_the_place(covered):
    epoch = covered.frame(0.2, doubted).epoch
    covered.moved(0.9, x=0.4)
    assert covered.counters.odometry_gaps == 1
    assert state(covered) is State.DOUBTED
    assert covered.counters.losses == 0
    covered.moved(1.0, x=0.5)
    covered.saw(0.95)
    job = covered.session.take_job("track")
    assert (job.epoch, job.require_verification) == (epoch, True)
    covered.session.handle_result(job, tracking(job), covered.now)
    assert covered.session.pose() is not None


def test_odometry_timeout_while_doubted_keeps_the_place(covered):
    epoch = covered.frame(0.2, doubted).epoch
    covered.session.tick(covered.now + 0.6)
    assert covered.session.state() == (State.LOST, "no odometry for 0.5 s")
    covered.moved(0.9, x=0.4)
    covered.moved(1.0, x=0.5)
    covered.saw(0.95)
    job = covered.session.take_job("track")
    assert (job.epoch, job.require_verification) == (epoch, True)
    covered.session.handle_result(job, tracking(job), covered.now)
    assert state(covered) is State.TRACKING
    assert covered.counters.losses == 1


def test_odometry_pause_while_searching_restarts_search():
    robot = Robot()
    epoch = robot.frame(0.0, unknown, state=State.AMBIGUOUS).epoch
    robot.moved(0.7, x=0.4)
    assert robot.frame(0.8, unknown).epoch != epoch
    assert robot.counters.losses == 0


def test_odometry_jump_while_doubted_is_a_loss(covered):
    covered.moved(0.15, x=900.0)
    assert covered.session.state() == (State.LOST, "odometry jumped")
    assert covered.counters.losses == 1
    covered.moved(0.2, x=900.0)
    covered.moved(0.8, x=900.1)  # nothing is known there that could be verified
    assert reason(covered) == "odometry jumped"
    assert not covered.session.robot_state.engine_has_place
    assert covered.counters.losses == 1


def test_odometry_timeout_while_doubted_is_a_loss(covered):
    covered.session.tick(covered.now + 0.4)
    assert state(covered) is State.DOUBTED
    covered.session.tick(covered.now + 3600.0)
    assert covered.session.state() == (State.LOST, "no odometry for 0.5 s")
    assert covered.counters.losses == 1
    assert changes(covered)[-1] == ("AMBIGUOUS", "LOST", "no odometry for 0.5 s")


@pytest.mark.parametrize("answer", [tracking, doubted])
def test_unverified_place_without_frames_is_lost_and_recovered_by_first_frame(answer):
    robot = Robot(NodeConfig(dead_reckoning_timeout=2.0)).localized(0.0)
    robot.frame(0.1, answer)
    robot.moved(0.8, x=0.3)  # after a pause
    for k in range(17, 80):
        robot.moved(0.05 * k, x=0.3)
        robot.session.tick(robot.now)
    assert robot.session.state() == (State.LOST, "no usable frame for 2 s")
    assert robot.counters.losses == 1
    robot.saw(3.9, now=robot.now)
    job = robot.session.take_job("track")
    assert job.stamp_ns == ns(3.9)
    for k in range(80, 84):  # while the frame is under way
        robot.moved(0.05 * k, x=0.3)
        robot.session.tick(robot.now)
    robot.session.handle_result(job, tracking(job), robot.now)
    assert state(robot) is State.TRACKING


def test_loss_has_newest_reason_and_is_counted_once():
    robot = Robot().localized(0.0)
    silent = robot.now + 0.6
    robot.session.tick(silent)
    for answer, stamp in ((doubted, 0.1), (unknown, 0.2)):
        robot.moved(stamp, now=silent + stamp)
        robot.saw(stamp - 0.01, now=silent + stamp)
        job = robot.session.take_job("track")
        more = {"state": State.LOST, "reason": "in doubt for 60 s"} if answer is unknown else {}
        robot.session.handle_result(job, answer(job, **more), silent + stamp)
        if answer is doubted:
            assert robot.session.state() == (State.LOST, "no odometry for 0.5 s")
    assert robot.session.state() == (State.LOST, "in doubt for 60 s")
    assert counted(robot)["losses"] == 1
    assert changes(robot)[1:] == [("TRACKING", "LOST", "no odometry for 0.5 s"), ("LOST", "LOST", "in doubt for 60 s")]
    robot.session.tick(silent + 0.3)
    assert len(changes(robot)) == 3


def test_frame_from_before_gap_does_not_count_as_verification():
    robot = Robot().localized(0.0)
    robot.drive(0.05, 0.3)
    robot.saw(0.2)
    robot.session.tick(robot.now + 0.6)  # silence: LOST, the next frame is suspect
    busy = robot.session.take_job("track")
    assert busy.require_verification
    robot.moved(2.0, x=0.6, now=robot.now + 1.7)  # the robot was carried away meanwhile
    assert robot.counters.odometry_gaps == 1
    robot.session.handle_result(busy, tracking(busy), robot.now + 0.01)  # verified, but where it was before
    robot.moved(2.1, x=0.6, now=robot.now + 0.1)
    robot.saw(2.05)
    job = robot.session.take_job("track")
    assert job.require_verification


@pytest.mark.parametrize(("seconds", "state"), [(6.0, State.DOUBTED), (12.0, State.LOST)])
def test_network_outage_keeps_the_place_for_max_outage(seconds, state):
    robot = Robot().localized(0.0)
    robot.drive(0.05, 0.3)
    robot.session.inputs.disconnected_at = robot.now + 1.0
    robot.moved(0.3 + seconds, x=0.6, now=robot.now + seconds)
    assert robot.session.pose() is None
    assert robot.session.state()[0] is state
    robot.moved(0.4 + seconds, x=0.6, now=robot.now + 0.1)
    robot.saw(0.35 + seconds)
    job = robot.session.take_job("track")
    assert job.require_verification or state is State.LOST
    robot.session.handle_result(job, tracking(job), robot.now + 0.01)
    assert robot.session.pose() is not None


@pytest.mark.parametrize(("ended", "said"), [("clouds", "no clouds for 6 s"), ("odometry", "no odometry for 6 s")])
def test_searching_robot_whose_data_end_says_so_and_for_how_long(ended, said):
    robot = Robot()
    robot.frame(0.0, unknown)
    before = robot.session.state()[1]
    for k in range(1, 61):  # 6 s
        if ended != "odometry":
            robot.moved(0.1 * k)
        if ended != "clouds":
            robot.saw(0.1 * k)
        robot.session.tick(1000.0 + 0.1 * k)
    assert robot.session.state()[1] == f"{said}; before: {before}"


def test_searching_robot_whose_data_come_has_its_own_reason():
    robot = Robot()
    robot.frame(0.0, unknown)
    for k in range(1, 61):
        robot.moved(0.1 * k)
        robot.saw(0.1 * k)
        robot.session.tick(1000.0 + 0.1 * k)
    assert robot.session.state()[1] == "no place fits"


def test_robot_that_never_sent_anything_waits_for_it():
    robot = Robot()
    robot.session.tick(2000.0)
    assert robot.session.state()[1].startswith("waiting for clouds")
