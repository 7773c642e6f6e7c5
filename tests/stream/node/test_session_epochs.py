"""Beginning anew: what is asked for, and what comes too late."""

from __future__ import annotations

import pytest
from fake_robot import KEYS, Robot, counted, search_request, search_result, state, tracking, unknown

from coview_stream.localization.state import State
from coview_stream.messages.types import Sample


@pytest.fixture
def robot():
    return Robot()


def test_restart_search_drops_the_place(robot):
    robot.localized(0.0)
    before = robot.frame(0.1)
    robot.session.restart_search("asked to search again")
    assert robot.session.state() == (State.LOST, "asked to search again")
    assert robot.session.pose() is None
    assert robot.counters.received == 2  # nothing is forgotten but the place
    after = robot.frame(0.2, unknown)
    assert after.epoch != before.epoch
    assert robot.session.pose() is None


def test_restart_search_before_a_fix_is_not_a_loss(robot):
    robot.frame(0.0, unknown)
    robot.session.restart_search("asked to search again")
    assert state(robot) is State.SEARCHING
    assert robot.counters.losses == 0


def test_reset_clears_the_session(robot):
    epoch = robot.localized(0.0).frame(0.1).epoch
    robot.session.on_cloud(Sample(KEYS.cloud, b"x", "video/raw"), 0.0)
    robot.session.reset()
    assert counted(robot) == {}
    assert not robot.session.errors.texts
    assert robot.session.pose() is None
    assert robot.session.robot_state.evidence is None
    assert robot.session.robot_state.last_frame_ns is None
    assert robot.session.queue.latency.to_json()["p50"] is None
    assert robot.session.state() == (State.SEARCHING, f"waiting for clouds on {KEYS.cloud}")
    assert robot.frame(0.2, unknown).epoch != epoch


@pytest.mark.parametrize("how", ["begin_anew", "reset", "jump"])
def test_results_of_old_epoch_are_ignored(robot, how):
    robot.frame(0.0, unknown, ask=search_request(0.0))
    searching = robot.session.take_job("search")
    robot.drive(0.05, 0.2)
    robot.saw(0.15)
    busy = robot.session.take_job("track")
    if how == "begin_anew":
        robot.session.restart_search("asked to")
    elif how == "reset":
        robot.session.reset()
    else:
        robot.moved(0.25, x=500.0)
    robot.session.handle_result(busy, tracking(busy), robot.now)
    assert robot.session.pose() is None
    robot.session.handle_result(searching, search_result(accepted="a place"), robot.now)
    far = 500.0 if how == "jump" else 0.6
    robot.moved(0.3, x=far)
    robot.moved(0.35, x=far)
    robot.saw(0.33)
    job = robot.session.take_job("track")
    assert job.search_result is None
    assert job.epoch > busy.epoch
    # the old frame's end does not end the new one
    robot.session.handle_result(job, unknown(job, ask=search_request(1.0)), robot.now)
    assert robot.session.take_job("search").epoch == job.epoch


def test_failure_of_old_epoch_does_not_end_running_frame(robot):
    robot.drive(0.0, 0.2)
    robot.saw(0.15)
    old = robot.session.take_job("track")
    robot.session.restart_search("asked to")
    robot.saw(0.18)
    busy = robot.session.take_job("track")
    assert busy is not None
    robot.session.handle_failure(old, "boom", rejected=False)
    robot.saw(0.19)
    assert robot.session.take_job("track") is None
    robot.session.handle_result(busy, tracking(busy), robot.now)
    assert robot.session.pose() is not None


def test_search_result_goes_with_the_next_frame_once(robot):
    robot.frame(0.0, unknown, ask=search_request(0.0))
    said = search_result()
    robot.session.handle_result(robot.session.take_job("search"), said, robot.now)
    assert robot.frame(0.1, unknown).search_result is said
    assert robot.frame(0.2, unknown).search_result is None


def test_search_result_is_kept_when_frame_is_rejected(robot):
    robot.frame(0.0, unknown, ask=search_request(0.0))
    said = search_result()
    robot.session.handle_result(robot.session.take_job("search"), said, robot.now)
    robot.drive(0.05, 0.2)
    robot.saw(0.1)
    robot.session.handle_failure(robot.session.take_job("track"), "too few points", rejected=True)
    robot.saw(0.15)
    assert robot.session.take_job("track").search_result is said


def test_failed_search_skips_only_its_keyframe(robot):
    robot.frame(0.0, unknown, ask=search_request(0.0))
    robot.session.handle_failure(robot.session.take_job("search"), "boom")
    assert robot.frame(0.1, unknown, ask=search_request(0.1)).search_result is None
    assert robot.session.take_job("search") is not None


def test_engine_failure_starts_new_epoch(robot):
    epoch = robot.localized(0.0).frame(0.1).epoch
    robot.drive(0.15, 0.3)
    robot.saw(0.25)
    robot.session.handle_failure(robot.session.take_job("track"), "boom", rejected=False)
    assert robot.session.pose() is None
    assert state(robot) is State.LOST
    assert robot.frame(0.4, unknown).epoch != epoch


def test_frame_result_of_before_reset_is_ignored():
    robot = Robot()
    robot.drive(-0.1, 0.1)
    robot.saw(0.0)
    job = robot.session.take_job("track")
    robot.session.reset()
    robot.session.handle_result(job, tracking(job), robot.now)
    assert robot.counters.received == robot.counters.processed == 0


def test_search_result_of_before_reset_is_ignored():
    robot = Robot()
    robot.frame(0.0, unknown, ask=search_request(0.0))
    job = robot.session.take_job("search")
    robot.session.reset()
    robot.session.handle_result(job, search_result(), robot.now)
    assert robot.counters.searches == 0


def test_odometry_gap_during_first_fix_restarts_search():
    robot = Robot()
    robot.frame(0.0, unknown, state=State.AMBIGUOUS)
    robot.drive(0.05, 0.3)
    robot.saw(0.2)
    busy = robot.session.take_job("track")  # carries the verdict that will be accepted
    robot.moved(2.0, x=0.6, now=robot.now + 0.02)
    assert robot.counters.odometry_gaps == 1
    robot.session.handle_result(busy, tracking(busy), robot.now + 0.01)
    assert robot.session.pose() is None
    robot.moved(2.1, x=0.6, now=robot.now + 0.1)
    robot.saw(2.05)
    assert robot.session.take_job("track").epoch > busy.epoch  # the search begins anew


def test_long_odometry_outage_loses_the_place():
    robot = Robot().localized(0.0)
    robot.drive(0.05, 0.3)
    assert robot.session.pose() is not None
    robot.moved(2.7, x=0.6, now=robot.now + 2.4)
    assert robot.session.pose() is None
    assert robot.session.state() == (State.LOST, "odometry was away for too long")
