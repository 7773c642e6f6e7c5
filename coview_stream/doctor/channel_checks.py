"""One channel of a robot, clouds or odometry, judged by itself."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from coview_stream.config.node import NodeConfig
from coview_stream.doctor.capture import Heard, Seen
from coview_stream.doctor.finding import Finding, Verdict
from coview_stream.geometry.transforms import inverse, tilt_of
from coview_stream.messages import CLOUD_CODECS, ODOMETRY_CODECS

_NODE = NodeConfig()
_SLOWEST, _FASTEST = 2.0, 30.0  # clouds per second; at 2 Hz and 5 m/s there are 2.5 m between frames
_SLOWEST_ODOMETRY = 5.0  # per second; between poses, at 10 Hz, each is the newest odometry's
_PER_CLOUD = 0.9  # odometry samples for each cloud, less what two ways of counting differ by
_FEWEST_POINTS = 1000
_NEAR, _FAR = 0.3, 300.0  # metres: the median of a lidar's ranges lies between, in any surroundings
_FLAT = 1e-9  # radians
_STEEP, _TOPPLED = math.radians(20), math.radians(45)  # robots climb 20 degrees, hardly 45
_PACE = 1.25  # stamps may run this much faster or slower than the local clock, over a second or more


def cloud_findings(heard: Heard, elsewhere: str) -> Iterator[Finding]:
    """Judge the lidar frames; ``elsewhere`` says where others come, for the case that none do here."""
    robot, seen = heard.keys.robot, heard.clouds
    good = [s for s in seen if s.stamp_ns is not None]
    if not seen:
        yield _nothing("clouds", heard, heard.keys.cloud, elsewhere)
    if bad := [s for s in seen if s.stamp_ns is None]:
        yield _unreadable("clouds", "--cloud-encoding", list(CLOUD_CODECS), bad, len(seen), robot)
    if good:
        yield _clouds(good, heard)
        yield stamps_finding("cloud stamps", good, robot)


def odometry_findings(heard: Heard, elsewhere: str) -> Iterator[Finding]:
    """Judge the odometry; ``elsewhere`` likewise."""
    robot, seen = heard.keys.robot, heard.odometry
    maker = str((heard.status or {}).get("odometry", "robot"))
    if maker != "robot":
        yield _made_by_the_node(maker, len(seen), robot)
        return
    good = [s for s in seen if s.stamp_ns is not None]
    if not seen:
        yield _nothing("odometry", heard, heard.keys.odometry, elsewhere)
    if bad := [s for s in seen if s.stamp_ns is None]:
        yield _unreadable("odometry", "--odometry-encoding", list(ODOMETRY_CODECS), bad, len(seen), robot)
    if good:
        yield _odometry(good, heard)
        yield stamps_finding("odometry stamps", good, robot)
        yield gravity_finding(good, robot)


def _nothing(what: str, heard: Heard, key: str, elsewhere: str) -> Finding:
    remedy = "does the robot publish, on this key, and do access rules let it?"
    if what == "odometry":
        remedy += " If it has none: `serve --odometry kiss-icp`"
    found = f"none in {heard.ended - heard.began:.1f} s on {key}"
    return Finding("FAIL", what, found, elsewhere or remedy, heard.keys.robot)


def _made_by_the_node(maker: str, ignored: int, robot: str) -> Finding:
    found = f"the node makes it of the clouds ({maker})"
    if ignored:
        remedy = "the robot's is as a rule better: `serve --odometry robot`"
        return Finding("warn", "odometry", f"{found} and ignores the {ignored} samples heard", remedy, robot)
    return Finding("ok", "odometry", found, robot=robot)


def _unreadable(
    what: str, option: str, codecs: list[str], bad: list[Seen], total: int, robot: str
) -> Finding:
    first = bad[0]
    found = f"{len(bad)} of {total} cannot be read: {first.reason}"
    if first.trouble == "oversized":
        remedy = "`serve --max-payload`, or send fewer points and fields"
    elif first.readable_as:
        remedy = f"they can be read as {first.readable_as}: set their Encoding, or `serve {option} {first.readable_as}`"
    elif first.trouble == "unknown_encoding":
        remedy = f"send one of {', '.join(codecs)}, and name it in the Encoding"
    else:
        remedy = "compare the sender with docs/streaming.md, 'Byte layout'"
    return Finding("FAIL" if len(bad) == total else "warn", what, found, remedy, robot)


def rate(seen: Sequence[Seen]) -> float | None:
    """Messages per second by their arrival; None for fewer than two."""
    span = seen[-1].arrived - seen[0].arrived if seen else 0.0
    return (len(seen) - 1) / span if span > 0 else None


def _described(seen: Sequence[Seen]) -> str:
    often = rate(seen)
    size = int(statistics.median(s.size for s in seen))
    names = sorted({s.codec for s in seen})
    said = sorted({s.encoding or "none set" for s in seen})
    return (
        f"{f'{often:.1f} Hz' if often else f'{len(seen)} only'}, {_bytes(size)}, "
        f"read as {' and '.join(names)} (Encoding {' and '.join(said)})"
    )


def _bytes(size: int) -> str:
    return f"{size} bytes" if size < 10_000 else f"{size / 1e6:.2f} MB"


def _clouds(seen: list[Seen], heard: Heard) -> Finding:
    often, points = rate(seen), int(statistics.median(s.points for s in seen))
    distance = statistics.median(s.distance if s.points else 0.0 for s in seen)
    timed = [s.sweep for s in seen if s.sweep is not None]
    longest = max((high - low for low, high in timed), default=0.0)
    found = f"{_described(seen)}, {points} points, half of them within {distance:.1f} m, "
    found += f"with times over {longest:.3f} s" if timed else "no time per point"
    verdict: Verdict = "warn"
    if not points:
        verdict, remedy = "FAIL", "no finite points: does the sensor see anything?"
    elif not _NEAR <= distance <= _FAR:
        remedy = "points have to be in metres, in the sensor's frame"
    elif points < _FEWEST_POINTS:
        remedy = "few points: send whole sweeps, or collect several"
    elif often is None or often < _SLOWEST:
        remedy = "few frames: 5 to 20 a second are usual"
    elif often > _FASTEST:
        remedy = "the node takes the newest and drops the rest: send whole sweeps, not packets"
    else:
        verdict, remedy = "ok", ""
    return Finding(verdict, "clouds", found, remedy, heard.keys.robot)


def _odometry(seen: list[Seen], heard: Heard) -> Finding:
    often, robot = rate(seen), heard.keys.robot
    times = [s.arrived for s in seen] + [heard.ended]
    pause = max(later - earlier for earlier, later in pairwise(times))
    poses = [s.T_odom_body for s in seen if s.T_odom_body is not None]
    moved = sum(float(np.linalg.norm((inverse(a) @ b)[:3, 3])) for a, b in pairwise(poses))
    found = f"{_described(seen)}, moved {moved:.1f} m"
    if pause > _NODE.odometry_timeout:
        found += f", a pause of {pause:.1f} s"
        remedy = (
            f"without odometry for {_NODE.odometry_timeout:g} s the robot is LOST: send 20 to 100 a second"
        )
        return Finding("FAIL", "odometry", found, remedy, robot)
    if often is None or often < _SLOWEST_ODOMETRY:
        return Finding("warn", "odometry", found, "poses repeat stamps: send 20 to 100 a second", robot)
    frames = rate([s for s in heard.clouds if s.stamp_ns is not None])
    if frames is not None and often < _PER_CLOUD * frames:
        remedy = f"more rarely than clouds ({frames:.1f} Hz): send one with each at least, better 20 to 100 a second"
        return Finding("warn", "odometry", found, remedy, robot)
    return Finding("ok", "odometry", found, robot=robot)


def stamps_finding(what: str, seen: Sequence[Seen], robot: str) -> Finding:
    """Whether stamps increase, and about as fast as time does."""
    stamps = [s.stamp_ns for s in seen if s.stamp_ns is not None]
    steps = [later - earlier for earlier, later in pairwise(stamps)]
    back, same = sum(step < 0 for step in steps), sum(step == 0 for step in steps)
    if steps and same == len(steps):
        remedy = "the sender has to stamp each message with its sensor time, nanoseconds"
        return Finding("FAIL", what, f"all {len(stamps)} are {stamps[0]}", remedy, robot)
    if back or same:
        verdict: Verdict = "FAIL" if back + same > len(steps) / 2 else "warn"
        found = f"of {len(steps)} steps {back} go backwards, {same} stand still"
        return Finding(
            verdict, what, found, "two senders on one key, or a sender that repeats itself?", robot
        )
    span, elapsed = (stamps[-1] - stamps[0]) * 1e-9, seen[-1].arrived - seen[0].arrived
    if elapsed >= 1.0 and not 1 / _PACE < span / elapsed < _PACE:
        found = f"run {span / elapsed:.3g} times as fast as the clock here"
        wrong = not 0.05 < span / elapsed < 20
        remedy = (
            "write nanoseconds"
            if wrong
            else "fine for a recording at another speed, else look at the sender's clock"
        )
        return Finding("FAIL" if wrong else "warn", what, found, remedy, robot)
    return Finding("ok", what, f"increasing, newest {stamps[-1] * 1e-9:.3f} s", robot=robot)


def gravity_finding(seen: Sequence[Seen], robot: str) -> Finding:
    """Whether the odometry's z axis, and the body's, can be up."""
    tilts = [tilt_of(s.T_odom_body) for s in seen if s.T_odom_body is not None]
    usual, most = statistics.median(tilts), max(tilts)
    found = f"tilt {math.degrees(usual):.1f} degrees, at most {math.degrees(most):.1f}"
    if usual > _TOPPLED:
        remedy = (
            "z must point up in odometry and body: a camera's optical frame, or a sensor mounted on its side?"
        )
        return Finding("FAIL", "gravity", found, remedy, robot)
    if usual > _STEEP:
        return Finding("warn", "gravity", found, "on a steep slope? else align odometry to gravity", robot)
    if most < _FLAT:
        found += ": it knows no roll and pitch, which is fine on level ground"
    return Finding("ok", "gravity", found, robot=robot)
