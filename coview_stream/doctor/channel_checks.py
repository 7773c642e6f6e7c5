"""Checks of one channel of a robot, clouds or odometry, by itself."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from coview_stream.config.node import NodeConfig
from coview_stream.doctor.capture import CapturedMessage, RobotCapture
from coview_stream.doctor.finding import Finding, Verdict
from coview_stream.geometry.transforms import inverse, tilt_of
from coview_stream.messages import CLOUD_CODECS, ODOMETRY_CODECS

_NODE = NodeConfig()
# all set by hand
_MIN_CLOUD_RATE, _MAX_CLOUD_RATE = 2.0, 30.0  # Hz; at 2 Hz and 5 m/s there are 2.5 m between frames
_MIN_ODOMETRY_RATE = 5.0  # Hz; poses are published at 10 Hz, each with the newest odometry
_MIN_PER_CLOUD = 0.9  # odometry samples for each cloud, less the difference of the two ways of counting
_MIN_POINTS = 1000
_MIN_DISTANCE, _MAX_DISTANCE = 0.3, 300.0  # metres; the median of a lidar's ranges lies between, anywhere
_NO_TILT = 1e-9  # radians
_MAX_SLOPE, _MAX_TILT = math.radians(20), math.radians(45)  # robots climb 20 degrees, hardly 45
_MAX_CLOCK_RATIO = 1.25  # of stamps to the local clock and its inverse, over a second or more


def cloud_findings(capture: RobotCapture, elsewhere: str) -> Iterator[Finding]:
    """Judge the lidar frames; ``elsewhere`` names other keys with clouds, the remedy if there are none here."""
    robot, messages = capture.keys.robot, capture.clouds
    readable = [m for m in messages if m.stamp_ns is not None]
    if not messages:
        yield _missing("clouds", capture, capture.keys.cloud, elsewhere)
    if unreadable := [m for m in messages if m.stamp_ns is None]:
        yield _unreadable("clouds", "--cloud-encoding", list(CLOUD_CODECS), unreadable, len(messages), robot)
    if readable:
        yield _clouds(readable, capture)
        yield stamps_finding("cloud stamps", readable, robot)


def odometry_findings(capture: RobotCapture, elsewhere: str) -> Iterator[Finding]:
    """Judge the odometry; ``elsewhere`` likewise."""
    robot, messages = capture.keys.robot, capture.odometry
    maker = str((capture.status or {}).get("odometry", "robot"))
    if maker != "robot":
        yield _made_by_node(maker, len(messages), robot)
        return
    readable = [m for m in messages if m.stamp_ns is not None]
    if not messages:
        yield _missing("odometry", capture, capture.keys.odometry, elsewhere)
    if unreadable := [m for m in messages if m.stamp_ns is None]:
        yield _unreadable("odometry", "--odometry-encoding", list(ODOMETRY_CODECS), unreadable, len(messages), robot)
    if readable:
        yield _odometry(readable, capture)
        yield stamps_finding("odometry stamps", readable, robot)
        yield gravity_finding(readable, robot)


def _missing(what: str, capture: RobotCapture, key: str, elsewhere: str) -> Finding:
    remedy = "does the robot publish, on this key, and do access rules let it?"
    remedy = elsewhere or remedy
    if what == "odometry":
        remedy += f"{'.' * bool(elsewhere)} If it has none: `serve --odometry kiss-icp`"
    found = f"none in {capture.ended - capture.began:.1f} s on {key}"
    return Finding("FAIL", what, found, remedy, capture.keys.robot)


def _made_by_node(maker: str, ignored: int, robot: str) -> Finding:
    found = f"the node makes it of the clouds ({maker})"
    if ignored:
        remedy = "the robot's is as a rule better: `serve --odometry robot`"
        return Finding("warn", "odometry", f"{found} and ignores the {ignored} samples heard", remedy, robot)
    return Finding("ok", "odometry", found, robot=robot)


def _unreadable(
    what: str, option: str, codecs: list[str], unreadable: list[CapturedMessage], total: int, robot: str
) -> Finding:
    first = unreadable[0]
    found = f"{len(unreadable)} of {total} cannot be read: {first.reason}"
    if first.counter == "oversized":
        remedy = "`serve --max-payload`, or send fewer points and fields"
    elif first.readable_as:
        remedy = f"they can be read as {first.readable_as}: set their Encoding, or `serve {option} {first.readable_as}`"
    elif first.counter == "unknown_encoding":
        remedy = f"send one of {', '.join(codecs)}, and name it in the Encoding"
    else:
        remedy = "compare the sender with docs/streaming.md, 'Byte layout'"
    return Finding("FAIL" if len(unreadable) == total else "warn", what, found, remedy, robot)


def rate(messages: Sequence[CapturedMessage]) -> float | None:
    """Return messages per second by their arrival; None for fewer than two."""
    span = messages[-1].arrived - messages[0].arrived if messages else 0.0
    return (len(messages) - 1) / span if span > 0 else None


def _described(messages: Sequence[CapturedMessage]) -> str:
    hertz = rate(messages)
    size = int(statistics.median(m.size for m in messages))
    codecs = sorted({m.codec for m in messages})
    encodings = sorted({m.encoding or "none set" for m in messages})
    return (
        f"{f'{hertz:.1f} Hz' if hertz else f'{len(messages)} only'}, {_bytes(size)}, "
        f"read as {' and '.join(codecs)} (Encoding {' and '.join(encodings)})"
    )


def _bytes(size: int) -> str:
    return f"{size} bytes" if size < 10_000 else f"{size / 1e6:.2f} MB"


def _clouds(messages: list[CapturedMessage], capture: RobotCapture) -> Finding:
    hertz, points = rate(messages), int(statistics.median(m.points for m in messages))
    distance = statistics.median(m.distance if m.points else 0.0 for m in messages)
    sweeps = [m.sweep for m in messages if m.sweep is not None]
    longest = max((end - start for start, end in sweeps), default=0.0)
    found = f"{_described(messages)}, {points} points, half of them within {distance:.1f} m, "
    found += f"with times over {longest:.3f} s" if sweeps else "no time per point"
    verdict: Verdict = "warn"
    if not points:
        verdict, remedy = "FAIL", "no finite points: does the sensor see anything?"
    elif not _MIN_DISTANCE <= distance <= _MAX_DISTANCE:
        remedy = "points have to be in metres, in the sensor's frame"
    elif points < _MIN_POINTS:
        remedy = "few points: send whole sweeps, or collect several"
    elif hertz is None or hertz < _MIN_CLOUD_RATE:
        remedy = "few frames: 5 to 20 a second are usual"
    elif hertz > _MAX_CLOUD_RATE:
        remedy = "the node takes the newest and drops the rest: send whole sweeps, not packets"
    else:
        verdict, remedy = "ok", ""
    return Finding(verdict, "clouds", found, remedy, capture.keys.robot)


def _odometry(messages: list[CapturedMessage], capture: RobotCapture) -> Finding:
    hertz, robot = rate(messages), capture.keys.robot
    times = [m.arrived for m in messages] + [capture.ended]
    pause = max(later - earlier for earlier, later in pairwise(times))
    poses = [m.T_odom_body for m in messages if m.T_odom_body is not None]
    moved = sum(float(np.linalg.norm((inverse(a) @ b)[:3, 3])) for a, b in pairwise(poses))
    found = f"{_described(messages)}, moved {moved:.1f} m"
    if pause > _NODE.odometry_timeout:
        found += f", a pause of {pause:.1f} s"
        remedy = f"without odometry for {_NODE.odometry_timeout:g} s the robot is LOST: send 20 to 100 a second"
        return Finding("FAIL", "odometry", found, remedy, robot)
    if hertz is None or hertz < _MIN_ODOMETRY_RATE:
        return Finding("warn", "odometry", found, "poses repeat stamps: send 20 to 100 a second", robot)
    frames = rate([m for m in capture.clouds if m.stamp_ns is not None])
    if frames is not None and hertz < _MIN_PER_CLOUD * frames:
        remedy = f"more rarely than clouds ({frames:.1f} Hz): send one with each at least, better 20 to 100 a second"
        return Finding("warn", "odometry", found, remedy, robot)
    return Finding("ok", "odometry", found, robot=robot)


def stamps_finding(what: str, messages: Sequence[CapturedMessage], robot: str) -> Finding:
    """Judge whether stamps increase, and about as fast as the local clock."""
    stamps = [m.stamp_ns for m in messages if m.stamp_ns is not None]
    steps = [later - earlier for earlier, later in pairwise(stamps)]
    back, same = sum(step < 0 for step in steps), sum(step == 0 for step in steps)
    if steps and same == len(steps):
        remedy = "the sender has to stamp each message with its sensor time, nanoseconds"
        return Finding("FAIL", what, f"all {len(stamps)} are {stamps[0]}", remedy, robot)
    if back or same:
        verdict: Verdict = "FAIL" if back + same > len(steps) / 2 else "warn"
        found = f"of {len(steps)} steps {back} go backwards, {same} stand still"
        return Finding(verdict, what, found, "two senders on one key, or a sender that repeats itself?", robot)
    span, elapsed = (stamps[-1] - stamps[0]) * 1e-9, messages[-1].arrived - messages[0].arrived
    if elapsed >= 1.0 and not 1 / _MAX_CLOCK_RATIO < span / elapsed < _MAX_CLOCK_RATIO:
        found = f"run {span / elapsed:.3g} times as fast as the clock here"
        wrong = not 0.05 < span / elapsed < 20
        remedy = (
            "write nanoseconds" if wrong else "fine for a recording at another speed, else look at the sender's clock"
        )
        return Finding("FAIL" if wrong else "warn", what, found, remedy, robot)
    return Finding("ok", what, f"increasing, newest {stamps[-1] * 1e-9:.3f} s", robot=robot)


def gravity_finding(messages: Sequence[CapturedMessage], robot: str) -> Finding:
    """Judge whether the z axes of odometry and body can point up."""
    tilts = [tilt_of(m.T_odom_body) for m in messages if m.T_odom_body is not None]
    median, largest = statistics.median(tilts), max(tilts)
    found = f"tilt {math.degrees(median):.1f} degrees, at most {math.degrees(largest):.1f}"
    if median > _MAX_TILT:
        remedy = "z must point up in odometry and body: a camera's optical frame, or a sensor mounted on its side?"
        return Finding("FAIL", "gravity", found, remedy, robot)
    if median > _MAX_SLOPE:
        return Finding("warn", "gravity", found, "on a steep slope? else align odometry to gravity", robot)
    if largest < _NO_TILT:
        found += ": it has no roll and pitch, which is fine on level ground"
    return Finding("ok", "gravity", found, robot=robot)
