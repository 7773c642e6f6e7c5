"""Session's epochs, its states after pauses and doubts, and their history."""

import json
import random
import re
from dataclasses import replace
from itertools import pairwise

import pytest
from fake_robot import (
    EVENTS,
    KEYS,
    START_NS,
    Robot,
    cloud,
    counted,
    doubted,
    ns,
    reason,
    search_request,
    search_result,
    state,
    tracking,
    unknown,
)

from coview_stream.config.mount import Mount
from coview_stream.config.node import NodeConfig
from coview_stream.localization.result import KeyframeEvidence
from coview_stream.localization.state import TRANSITIONS, Event, State
from coview_stream.localization.tracking.monitor import RejectionReason
from coview_stream.messages.types import Sample
from coview_stream.stream.node.robot_state import StateHistory
from coview_stream.stream.node.status import status
from coview_stream.stream.transport.transport import Connection


def test_clouds_with_another_mount_than_before_begin_anew(robot):
    seen = [
        replace(cloud(0.1 * k), mount=mount) for k, mount in enumerate((None, None, Mount(yaw=0.3), Mount(yaw=0.3)))
    ]
    robot.localized(-0.1)
    states = []
    for k, sample in enumerate(seen):
        robot.moved(0.1 * k)
        robot.session.on_cloud(sample, robot.now)
        states.append(reason(robot) if state(robot) is State.LOST else state(robot))
        robot.answered()
    assert states[2] == "the lidar's pose on the body is another than before"
    assert {states[k] for k in (0, 1, 3)} == {State.TRACKING}
    assert robot.counters.losses == 1


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
    busy = robot.job_for(0.15)
    if how == "begin_anew":
        robot.session.restart_search("asked to")
    elif how == "reset":
        robot.session.reset()
    else:
        robot.moved(0.25, x=500.0)
    robot.session.handle_result(busy, tracking(busy), robot.now)
    assert robot.session.pose() is None
    robot.session.handle_result(searching, search_result(accepted="a place"), robot.now)
    assert robot.counters.searches == (how != "reset")
    far = 500.0 if how == "jump" else 0.6
    robot.moved(0.3, x=far)
    robot.moved(0.35, x=far)
    job = robot.job_for(0.33)
    assert job.search_result is None
    assert job.epoch > busy.epoch
    # the old frame's end does not end the new one
    robot.session.handle_result(job, unknown(job, ask=search_request(1.0)), robot.now)
    assert robot.session.take_job("search").epoch == job.epoch


def test_failure_of_old_epoch_does_not_end_running_frame(robot):
    robot.drive(0.0, 0.2)
    old = robot.job_for(0.15)
    robot.session.restart_search("asked to")
    busy = robot.job_for(0.18)
    assert busy is not None
    robot.session.handle_failure(old, "boom", rejected=False)
    assert robot.job_for(0.19) is None
    robot.session.handle_result(busy, tracking(busy), robot.now)
    assert robot.session.pose() is not None


def test_search_result_goes_with_frames_until_one_is_not_rejected(robot):
    robot.frame(0.0, unknown, ask=search_request(0.0))
    result = search_result()
    robot.session.handle_result(robot.session.take_job("search"), result, robot.now)
    robot.drive(0.05, 0.2)
    robot.session.handle_failure(robot.job_for(0.1), "too few points", rejected=True)
    assert robot.frame(0.3, unknown).search_result is result
    assert robot.frame(0.4, unknown).search_result is None


def test_engine_failure_starts_new_epoch(robot):
    epoch = robot.localized(0.0).frame(0.1).epoch
    robot.drive(0.15, 0.3)
    robot.session.handle_failure(robot.job_for(0.25), "boom", rejected=False)
    assert robot.session.pose() is None
    assert state(robot) is State.LOST
    assert robot.frame(0.4, unknown).epoch != epoch


def test_odometry_gap_during_first_fix_restarts_search(robot):
    robot.frame(0.0, unknown, state=State.AMBIGUOUS)
    robot.drive(0.05, 0.3)
    busy = robot.job_for(0.2)  # carries the verdict that will be accepted
    robot.moved(2.0, x=0.6, now=robot.now + 0.02)
    assert robot.counters.odometry_gaps == 1
    robot.session.handle_result(busy, tracking(busy), robot.now + 0.01)
    assert robot.session.pose() is None
    robot.moved(2.1, x=0.6, now=robot.now + 0.1)
    assert robot.job_for(2.05).epoch > busy.epoch  # the search begins anew


def told(robot):
    document = status(robot.session, Connection((), ()), 0, 0.0, 1.0)
    return json.loads(json.dumps(document))["transitions"]


def changes(robot):
    return [(c["from"], c["to"], c["reason"]) for c in told(robot)]


@pytest.mark.parametrize("noticed", [False, True])
def test_odometry_pause_while_doubted_keeps_the_place(robot, noticed):
    epoch = robot.localized(0.0).frame(0.2, doubted).epoch
    assert robot.session.state() == (State.DOUBTED, "only 0 points to register")
    assert robot.session.pose() is None
    if noticed:
        robot.session.tick(robot.now + 0.4)
        assert state(robot) is State.DOUBTED
        robot.session.tick(robot.now + 0.6)
        assert changes(robot)[-1] == ("AMBIGUOUS", "LOST", "no odometry for 0.5 s")
    robot.moved(0.9, x=0.4)
    assert robot.counters.odometry_gaps == 1
    assert state(robot) is (State.LOST if noticed else State.DOUBTED)
    robot.moved(1.0, x=0.5)
    robot.saw(0.95)
    job = robot.answered()
    assert (job.epoch, job.require_verification) == (epoch, True)
    assert robot.session.pose() is not None
    assert robot.counters.losses == noticed


@pytest.mark.parametrize("answer", [tracking, doubted])
def test_unverified_place_without_frames_is_lost_and_recovered_by_first_frame(answer):
    robot = Robot(NodeConfig(dead_reckoning_timeout=2.0)).localized(0.0)
    robot.frame(0.1, answer)
    robot.moved(0.8, x=0.3)  # after a pause
    for k in range(17, 80):
        robot.moved(0.05 * k, x=0.3)
        robot.session.tick(robot.now)
    assert robot.session.state() == (State.LOST, "no clouds for 4 s; before: no usable frame for 2 s")
    assert robot.counters.losses == 1
    job = robot.job_for(3.9, now=robot.now)
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
        job = robot.job_for(stamp - 0.01, now=silent + stamp)
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
    job = robot.job_for(2.05)
    assert job.require_verification


@pytest.mark.parametrize(
    ("seconds", "away", "state"),
    [(0.7, False, State.DOUBTED), (2.4, False, State.LOST), (6.0, True, State.DOUBTED), (12.0, True, State.LOST)],
)
def test_pause_of_odometry_keeps_the_place_for_longer_where_the_network_was_away(seconds, away, state):
    robot = Robot().localized(0.0)
    robot.drive(0.05, 0.3)
    if away:
        robot.session.inputs.disconnected_at = robot.now + 0.1
    robot.moved(0.3 + seconds, x=0.6, now=robot.now + seconds)
    assert robot.counters.odometry_gaps == 1
    assert robot.session.pose() is None
    why = {State.DOUBTED: "verifying the place after a pause of odometry", State.LOST: "odometry was away for too long"}
    assert robot.session.state() == (state, why[state])
    robot.moved(0.4 + seconds, x=0.6, now=robot.now + 0.1)
    robot.saw(0.35 + seconds)
    job = robot.answered(tracking, robot.now + 0.01)
    assert job.require_verification or state is State.LOST
    assert robot.session.pose() is not None


@pytest.mark.parametrize(("ended", "said"), [("clouds", "no clouds for 6 s"), ("odometry", "no odometry for 6 s")])
def test_searching_robot_whose_data_end_says_so_and_for_how_long(robot, ended, said):
    robot.frame(0.0, unknown)
    for k in range(1, 61):  # 6 s
        if ended != "odometry":
            robot.moved(0.1 * k)
        if ended != "clouds":
            robot.saw(0.1 * k)
        robot.session.tick(1000.0 + 0.1 * k)
    assert robot.session.state()[1] == f"{said}; before: no place fits"


def test_fix_and_loss_are_in_the_state_history(robot):
    assert told(robot) == []
    robot.localized(0.0)
    robot.frame(0.1, doubted, reason="rays pass through the map")
    robot.frame(0.2, unknown, state=State.LOST, reason="2 registrations rejected")
    changes = told(robot)
    assert [(c["from"], c["to"]) for c in changes] == [
        ("SEARCHING", "TRACKING"),
        ("TRACKING", "AMBIGUOUS"),
        ("AMBIGUOUS", "LOST"),
    ]
    assert [c["number"] for c in changes] == [1, 2, 3]
    assert [c["stamp_ns"] for c in changes] == [ns(0.0), ns(0.1), ns(0.2)]
    assert changes[0]["evidence"]["score"] == 0.8
    assert changes[1]["reason"] == "rays pass through the map"
    assert changes[2]["reason"] == "2 registrations rejected"


def test_state_history_keeps_newest_five_with_running_numbers():
    changes = StateHistory()
    evidence = KeyframeEvidence(1.0, State.TRACKING, "verified", cause=RejectionReason.VERIFIED, innovation=3.25)
    for k in range(9):
        state = (State.TRACKING, State.AMBIGUOUS)[k % 2]
        changes.add(state, f"reason {k}", k, evidence)
        changes.add(state, "again", k, evidence)
    kept = changes.to_json()
    assert [c["number"] for c in kept] == [5, 6, 7, 8, 9]
    assert [c["reason"] for c in kept] == [f"reason {k}" for k in range(4, 9)]
    assert kept[-1]["evidence"]["cause"] == "verified"
    assert kept[-1]["evidence"]["innovation"] == 3.25


SILENCE, RESTARTED = "silence", "odometry restarted"
NODE_TRANSITIONS = TRANSITIONS | {
    (State.AMBIGUOUS, RESTARTED): State.SEARCHING,
    (State.TRACKING, RESTARTED): State.LOST,
    (State.DOUBTED, RESTARTED): State.LOST,
    (State.TRACKING, SILENCE): State.LOST,
    (State.DOUBTED, SILENCE): State.LOST,
    (State.LOST, Event.MATCH_VERIFIED): State.TRACKING,  # after silence
}
"""Transitions of the engine, and those that only a node makes."""
RESTORING = (Event.PLACE_ACCEPTED, Event.MATCH_VERIFIED)
ANSWERS = {
    None: (State.SEARCHING, State.AMBIGUOUS, State.TRACKING, State.DOUBTED),
    State.SEARCHING: (State.SEARCHING, State.AMBIGUOUS, State.TRACKING, State.DOUBTED),
    State.AMBIGUOUS: (State.SEARCHING, State.AMBIGUOUS, State.TRACKING, State.DOUBTED),
    State.TRACKING: (State.TRACKING, State.DOUBTED, State.LOST),
    State.DOUBTED: (State.TRACKING, State.DOUBTED, State.LOST),
    State.LOST: (State.LOST, State.TRACKING),
}
"""States of the engine that may follow on one another within an odometry epoch."""


@pytest.mark.parametrize("seed", range(30))
def test_states_follow_the_table_of_transitions(seed):
    rng, robot = random.Random(seed), Robot()
    expected, engine, pending, now, seen = State.SEARCHING, None, False, 0.1, [State.SEARCHING]
    robot.moved(0.0)
    for _ in range(60):
        action = rng.choice(["frame", "frame", "frame", "silence", "gap", "jump"])
        if action == "frame":
            after = rng.choice(ANSWERS[engine])
            answer = {State.TRACKING: tracking, State.DOUBTED: doubted}.get(after)
            robot.frame(now, answer or (lambda job, after=after: unknown(job, after)))
            pending = False
            for event in EVENTS[after]:
                if event is Event.PLACE_GIVEN_UP and engine is State.LOST:
                    continue
                settled = expected not in (State.DOUBTED, State.LOST)
                if after is State.TRACKING or event not in RESTORING or settled:
                    expected = NODE_TRANSITIONS.get((expected, event), expected)
            engine = after
        elif action == "silence":
            robot.session.tick(robot.now + 1.0)
            if expected.has_place:
                expected, pending = NODE_TRANSITIONS.get((expected, SILENCE), expected), True
        elif action == "gap":
            now += 0.8
            robot.moved(now)
            if engine is not None and engine.has_place:
                expected, pending = NODE_TRANSITIONS.get((expected, Event.VERIFICATION_REQUIRED), expected), True
            else:
                expected, engine, pending = NODE_TRANSITIONS.get((expected, RESTARTED), expected), None, False
        else:
            robot.session.restart_search("odometry jumped")
            expected, engine, pending = NODE_TRANSITIONS.get((expected, RESTARTED), expected), None, False
        assert robot.session.state()[0] is expected, (action, pending)
        seen.append(expected)
        now += 0.1
    counted = {s: sum(after is s is not before for before, after in pairwise(seen)) for s in State}
    assert (robot.counters.fixes, robot.counters.losses) == (counted[State.TRACKING], counted[State.LOST])


@pytest.mark.parametrize("stamp", [0.5, -START_NS * 1e-9], ids=["constant", "zero"])
def test_clouds_whose_stamp_stands_are_named_within_five_seconds(robot, stamp):
    for k in range(1, 50):
        robot.moved(0.1 * k, now=1000.0 + 0.1 * k)
        robot.saw(stamp, now=1000.0 + 0.1 * k)
        robot.session.tick(1000.0 + 0.1 * k)
        if (job := robot.session.take_job("track")) is not None:
            robot.session.handle_result(job, unknown(job, reason="too little has been seen"), 1000.0 + 0.1 * k)
    assert state(robot) is State.SEARCHING
    assert re.search(r"clouds come with no stamp after [\d.]+ s for [2-5] s|no common stamps", reason(robot))


def test_first_search_that_takes_long_is_the_reason_until_it_ends(robot):
    robot.frame(0.0, unknown, reason="")
    assert reason(robot) == "too little has been seen"
    robot.frame(0.1, unknown, reason="", ask=search_request(0.1))
    robot.session.tick(robot.now)
    assert reason(robot) == "a search of the map waits or runs since 0 s"
    job = robot.session.take_job("search")
    for k in range(2, 362):
        robot.moved(0.1 * k)
        robot.saw(0.1 * k - 0.05)
    robot.session.tick(robot.now)
    behind = ": this machine is too slow or busy, 359 of 362 clouds were dropped"
    assert reason(robot) == f"a search of the map waits or runs since 36 s{behind}"
    robot.session.handle_result(job, search_result(), robot.now)
    robot.answered(unknown, reason="two places fit")
    assert reason(robot) == "two places fit"


def test_odometry_whose_stamp_stands_is_named_where_a_place_was_lost_for_it(robot):
    robot.frame(1.0)
    assert state(robot) is State.TRACKING
    for k in range(11, 40):
        robot.moved(1.01, now=1000.0 + 0.1 * k)
        robot.session.tick(1000.0 + 0.1 * k)
    assert (state(robot), reason(robot).split(" after ")[0]) == (State.LOST, "odometry comes with no stamp")


def test_errors_from_before_a_robot_is_found_are_over(robot):
    robot.session.on_cloud(Sample(KEYS.cloud, b"x", "video/raw"), 0.0)
    assert any("video/raw" in text for text in robot.session.errors.texts)
    robot.localized(0.0)
    assert not robot.session.errors.texts
    robot.session.on_cloud(Sample(KEYS.cloud, b"x", "video/raw"), 0.1)
    robot.frame(0.2)
    assert len(robot.session.errors.texts) == 1
    assert robot.counters.unknown_encoding == 2
