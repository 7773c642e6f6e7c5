"""Changes of state: each is told with its reason and evidence, however quickly they follow one another."""

from __future__ import annotations

import json

from fake_robot import Robot, doubted, ns, unknown

from coview_stream.localization.result import KeyframeEvidence
from coview_stream.localization.state import State
from coview_stream.localization.tracking.monitor import RejectionReason
from coview_stream.stream.node.robot_state import StateHistory
from coview_stream.stream.node.status import status
from coview_stream.stream.transport.transport import Connection


def told(robot):
    document = status(robot.session, Connection((), ()), 0, 0.0, 1.0)
    return json.loads(json.dumps(document))["transitions"]


def test_fix_and_loss_are_in_the_state_history():
    robot = Robot()
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


def test_timeout_is_in_the_state_history():
    robot = Robot()
    robot.localized(0.0)
    robot.session.tick(robot.now + 60.0)
    assert told(robot)[-1]["to"] == "LOST"
    assert "no odometry" in told(robot)[-1]["reason"]


def test_odometry_jump_is_in_the_state_history():
    robot = Robot()
    robot.localized(0.0)
    robot.moved(0.1, x=50.0)
    assert told(robot)[-1]["to"] == "LOST"
    assert told(robot)[-1]["reason"] == "odometry jumped"


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


def test_reset_clears_the_state_history():
    robot = Robot()
    robot.localized(0.0)
    robot.session.reset()
    assert told(robot) == []
