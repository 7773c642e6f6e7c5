"""Scores of the soak: false poses, recoveries, slopes of memory, order of faults."""

import math
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from bench.soak.robots import Robot
from bench.soak.soak import chosen
from bench.soak.stage import ENDS_PROCESSES, FAULTS, Sampled, slope
from bench.stream.processes import stamp_of
from coview_stream.clouds import write_tum
from coview_stream.messages import encode_pose
from coview_stream.messages.types import PoseMessage, Sample

START = 1000.0  # monotonic


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    """Return a robot that drives along x at 5 m/s, frame after frame."""
    truth = np.tile(np.eye(4), (400, 1, 1))
    truth[:, 0, 3] = 0.5 * np.arange(400)
    write_tum(tmp_path / "truth.tum", 1000.0 + 0.1 * np.arange(400), truth)
    return Robot("r1", tmp_path, elsewhere=False, start=START)


def say(robot: Robot, moment: float, x: float = 0.0, degrees: float = 0.0, age: float = 0.0) -> None:
    """Have a pose arrive 0.1 s after its moment, off by metres and degrees."""
    off, a = np.eye(4), math.radians(degrees)
    off[:2, :2], off[0, 3] = [[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]], x
    T = robot.drive.truth(stamp_of(moment)) @ off
    message = PoseMessage(stamp_of(moment), "r1", "TRACKING", T, np.eye(6), 1.0, "0" * 64, age)
    sent = encode_pose(message, "json")
    robot.take(START + moment + 0.1, Sample("coview/r1/out/pose", sent.payload, sent.encoding))


@pytest.mark.parametrize(("x", "degrees", "false"), [(2.9, 4.9, 0), (3.1, 0.0, 1), (0.0, 5.1, 1)])
def test_a_pose_is_false_beyond_three_metres_or_five_degrees(
    robot: Robot, x: float, degrees: float, false: int
) -> None:
    say(robot, 10.0, x, degrees)
    assert len(robot.false) + robot.unreadable == false


def test_every_pose_elsewhere_is_false_and_rubbish_is_unreadable(robot: Robot) -> None:
    robot.elsewhere = True
    say(robot, 10.0)
    robot.take(START, Sample("coview/r1/out/pose", b"\xff", "application/json"))
    robot.take(START, Sample("coview/r1/out/status", b"[]"))
    assert (len(robot.false), robot.poses, robot.unreadable) == (1, 1, 2)


def test_only_a_frame_taken_afterwards_is_a_recovery(robot: Robot) -> None:
    robot.expect(START + 10.0)
    say(robot, 11.0, age=1.5)  # dead reckoning since a frame before
    assert robot.recovered is None
    say(robot, 11.2, age=0.2)
    assert robot.recovered == pytest.approx(START + 11.3)


def test_every_fault_comes_once_before_any_comes_again_and_processes_grow_old_every_other_round() -> None:
    gentle = set(FAULTS) - set(ENDS_PROCESSES)
    assert len(ENDS_PROCESSES) == 4
    drawn = list(islice(chosen([], 5), 2 * len(FAULTS) + len(gentle)))
    first, second, third = drawn[: len(FAULTS)], drawn[len(FAULTS) : -len(FAULTS)], drawn[-len(FAULTS) :]
    assert set(first) == set(third) == set(FAULTS)
    assert set(second) == gentle


def samples(begin: float, seconds: float, start: float, per_hour: float, warm_up: float = 0.0) -> list[Sampled]:
    at = np.arange(0.0, seconds, 10.0)
    memory = start + per_hour * at / 3600 + warm_up * (1 - np.exp(-at / 30))
    noise = np.random.default_rng(int(begin)).normal(0, 0.05, len(at))
    return [Sampled(begin + t, m, 20) for t, m in zip(at, memory + noise, strict=True)]


def test_a_leak_shows_across_restarts_and_warming_up_is_none() -> None:
    rows = [samples(0.0, 1200.0, 100.0, 12.0), samples(1300.0, 1500.0, 80.0, 12.0)]
    assert slope(rows, "megabytes", warm=180.0) == pytest.approx(12.0, abs=1.0)
    assert slope(rows, "descriptors", warm=180.0) == 0.0
    rows = [samples(900.0 * k, 800.0, 100.0 + k, 0.0, warm_up=40.0) for k in range(4)]
    assert abs(slope(rows, "megabytes", warm=240.0) or 0.0) < 0.7
    assert slope([samples(0.0, 60.0, 1.0, 0.0)], "megabytes", warm=0.0) is None
