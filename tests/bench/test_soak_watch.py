"""What a soak counts: false poses, recoveries, and robots that are stuck."""

from __future__ import annotations

import math
import time
from argparse import Namespace
from collections import deque
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bench.soak import figures, soak
from bench.soak.faults import Fault, SkippedError
from bench.soak.robots import Manner, stamp
from bench.soak.sites import Site
from bench.soak.watch import Robot, Watch
from coview_stream.clouds import write_tum
from coview_stream.geometry.arrays import Floats
from coview_stream.messages import encode_pose
from coview_stream.messages.types import PoseMessage

START = 1000.0  # monotonic


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    """Return a robot that drives along x at 5 m/s, frame after frame."""
    truth = np.tile(np.eye(4), (400, 1, 1))
    truth[:, 0, 3] = 0.5 * np.arange(400)
    write_tum(tmp_path / "truth.tum", 1000.0 + 0.1 * np.arange(400), truth)
    return Robot("r1", Site("town", tmp_path, tmp_path / "site.coview", deceptive=False), start=START)


@pytest.fixture
def watch(robot: Robot) -> Watch:
    """Return a watch without a session."""
    watch = Watch.__new__(Watch)
    watch.robots, watch._came, watch.flipping = {robot.name: robot}, deque(), False
    return watch


def say(
    watch: Watch, content: float, off: Floats | None = None, age: float = 0.0, manner: Manner | None = None
) -> None:
    """Have a pose arrive 0.1 s after its moment, ``off`` (4, 4) from the truth in the body's frame."""
    robot = watch.robots["r1"]
    T = robot.drive.truth(stamp(content, Manner())) @ (np.eye(4) if off is None else off)
    message = PoseMessage(stamp(content, manner or Manner()), "r1", "TRACKING", T, np.eye(6), 1.0, "0" * 64, age)
    sent = encode_pose(message, "json")
    watch._came.append((START + content + 0.1, "coview/r1/out/pose", sent.payload, sent.encoding))
    watch.update()


def moved(x: float = 0.0, degrees: float = 0.0) -> Floats:
    T, a = np.eye(4), math.radians(degrees)
    T[:2, :2], T[0, 3] = [[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]], x
    return T


@pytest.mark.parametrize(("x", "degrees", "false"), [(2.9, 4.9, 0), (3.1, 0.0, 1), (0.0, 5.1, 1)])
def test_a_pose_is_false_beyond_three_metres_or_five_degrees(
    watch: Watch, robot: Robot, x: float, degrees: float, false: int
) -> None:
    say(watch, 10.0, moved(x, degrees))
    assert len(robot.false) + robot.unreadable == false


def test_a_pose_is_judged_by_its_stamp_whatever_the_sensor_clock(watch: Watch, robot: Robot) -> None:
    late = Manner(offset=3600.0)
    say(watch, 10.0, manner=late)
    assert len(robot.false) == 1  # of a clock that the robot never had
    robot.set_manner(late)
    say(watch, 10.2, manner=late)
    say(watch, 10.4)
    assert (len(robot.false), robot.poses) == (1, 3)


def test_what_cannot_be_read_is_counted(watch: Watch, robot: Robot) -> None:
    watch._came.append((START, "coview/r1/out/pose", b"\xff", "application/json"))
    watch._came.append((START, "coview/r1/out/status", b"[]", "application/json"))
    watch.update()
    assert robot.unreadable == 2


def test_what_the_network_garbles_is_counted_apart(watch: Watch, robot: Robot) -> None:
    watch.flipping = True
    say(watch, 10.0, moved(100.0))
    watch._came.append((START, "coview/r1/out/pose", b"\xff", "application/json"))
    watch.update()
    assert (robot.false, robot.unreadable, robot.garbled) == ([], 0, 2)


def test_only_a_frame_taken_afterwards_is_a_recovery(watch: Watch, robot: Robot) -> None:
    robot.expect(START + 10.0)
    say(watch, 11.0, age=1.5)  # dead reckoning since a frame before
    assert robot.recovered is None
    say(watch, 11.2, age=0.2)
    assert robot.recovered == pytest.approx(START + 11.3)


def played(robot: Robot, monkeypatch: pytest.MonkeyPatch, make: Any) -> soak.Event:
    """Make one fault on a stage on which no time passes."""
    monkeypatch.setattr(soak, "FAULTS", {"quake": Fault("quake", make)})
    stage: Any = SimpleNamespace(robots=[robot], nodes=[], wait=lambda *_: False, rescue=lambda: None)
    under_way = soak.Soak(stage, Namespace(every=60.0, minutes=1.0, json=None))
    under_way.play("quake")
    return under_way.events[0]


def test_a_robot_that_is_sent_to_and_not_found_is_stuck(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    robot.fed_at = dict.fromkeys(("odom", "cloud"), time.monotonic())
    event = played(robot, monkeypatch, lambda _: time.monotonic())
    assert (event.stuck, event.unfed, event.recoveries) == (["r1"], [], {"r1": None})
    assert next(row for row in figures.survived([event]) if "stuck" in row.name).holds is False


def test_a_robot_whose_messages_do_not_arrive_is_not(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    event = played(robot, monkeypatch, lambda _: time.monotonic())
    assert (event.stuck, event.unfed) == ([], ["r1"])


def test_nobody_has_to_be_found_in_a_deceptive_site(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    robot.site = robot.site._replace(deceptive=True)
    event = played(robot, monkeypatch, lambda _: time.monotonic())
    assert (event.recoveries, event.stuck) == ({}, [])


def test_a_fault_that_cannot_be_made_is_skipped(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    def cannot(_: Any) -> float:
        raise SkippedError("no disk")

    event = played(robot, monkeypatch, cannot)
    assert event.skipped == "no disk"
    assert any("no disk" in row.said for row in figures.survived([event]))
