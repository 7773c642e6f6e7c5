"""Checks of a robot's clouds, its odometry, both together, and the node that serves it."""

from __future__ import annotations

import heapq
import math
import statistics
from collections.abc import Collection, Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from coview_stream.config.mount import Mount
from coview_stream.config.node import NodeConfig
from coview_stream.doctor.capture import CapturedMessage, RobotCapture
from coview_stream.doctor.finding import Finding, Verdict
from coview_stream.doctor.frame_checks import SeenFrame
from coview_stream.geometry.transforms import inverse, tilt_of
from coview_stream.messages import CLOUD_CODECS, ODOMETRY_CODECS
from coview_stream.messages.types import CloudMessage, OdometryMessage
from coview_stream.odometry.buffer import OdometryBuffer, SampleKind
from coview_stream.stream.node.counters import Counters
from coview_stream.stream.node.inputs import FrameSync
from coview_stream.version import __version__

_NODE = NodeConfig()
# limits for usual robots
_MIN_CLOUD_RATE, _MAX_CLOUD_RATE = 2.0, 30.0  # Hz; at 2 Hz and 5 m/s frames are 2.5 m apart
_MIN_ODOMETRY_RATE = 5.0  # Hz; poses are published at 10 Hz, each with the newest odometry
_MIN_PER_CLOUD = 0.9  # least odometry rate per cloud rate: one sample per cloud, with a margin
_MIN_POINTS = 1000  # finite points of a usual frame
_OTHERS = 5  # robots that are named
_MIN_DISTANCE, _MAX_DISTANCE = 0.3, 300.0  # metres; the median range of a lidar lies between, anywhere
_NO_TILT = 1e-9  # radians
_MAX_SLOPE, _MAX_TILT = math.radians(20), math.radians(45)  # robots climb 20 degrees, hardly 45
_MAX_CLOCK_RATIO = 1.25  # ratio of stamps to the local clock, or its inverse, over a second or more


def cloud_findings(capture: RobotCapture, elsewhere: str) -> Iterator[Finding]:
    """Judge the lidar frames; ``elsewhere`` names other keys with clouds, as the remedy if there are none here."""
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
    """Judge the odometry; ``elsewhere`` names other keys with odometry."""
    robot, messages = capture.keys.robot, capture.odometry
    maker = str((capture.status or {}).get("odometry", "robot"))
    if maker != "robot":
        found = f"the node makes it of the clouds ({maker})"
        if not messages:
            yield Finding("ok", "odometry", found, robot=robot)
            return
        remedy = "the robot's is as a rule better: `serve --odometry robot`"
        yield Finding("warn", "odometry", f"{found} and ignores the {len(messages)} samples heard", remedy, robot)
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


def _missing(channel: str, capture: RobotCapture, key: str, elsewhere: str) -> Finding:
    remedy = elsewhere or "does the robot publish, on this key, and do access rules let it?"
    if channel == "odometry":
        remedy += f"{'.' * bool(elsewhere)} If it has none: `serve --odometry kiss-icp`"
    result = f"none in {capture.ended - capture.began:.1f} s on {key}"
    return Finding("FAIL", channel, result, remedy, capture.keys.robot)


def _unreadable(
    channel: str, option: str, codecs: list[str], unreadable: list[CapturedMessage], total: int, robot: str
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
        remedy = "compare the sender with 'Byte layout' in `coview-stream help wire`"
    return Finding("FAIL" if len(unreadable) == total else "warn", channel, found, remedy, robot)


def rate(messages: Sequence[CapturedMessage]) -> float | None:
    """Return the arrival rate, messages per second; None for fewer than two."""
    span = messages[-1].arrived - messages[0].arrived if messages else 0.0
    return (len(messages) - 1) / span if span > 0 else None


def _described(messages: Sequence[CapturedMessage]) -> str:
    hertz = rate(messages)
    size = int(statistics.median(m.size for m in messages))
    text = f"{size} bytes" if size < 10_000 else f"{size / 1e6:.2f} MB"
    codecs = sorted({m.codec for m in messages})
    encodings = sorted({m.encoding or "none set" for m in messages})
    return (
        f"{f'{hertz:.1f} Hz' if hertz else f'{len(messages)} only'}, {text}, "
        f"read as {' and '.join(codecs)} (Encoding {' and '.join(encodings)})"
    )


def _clouds(messages: list[CapturedMessage], capture: RobotCapture) -> Finding:
    hertz, points = rate(messages), int(statistics.median(m.points for m in messages))
    distance = statistics.median(m.distance if m.points else 0.0 for m in messages)
    sweeps = [m.sweep for m in messages if m.sweep is not None]
    longest = max((end - start for start, end in sweeps), default=0.0)
    found = f"{_described(messages)}, {points} points, half of them within {distance:.1f} m, "
    found += f"with times over {longest:.3f} s" if sweeps else "no time per point"
    verdict: Verdict = "warn"
    if doubles := sum(m.doubles for m in messages):
        found += f"; {doubles} of {len(messages)} make sense as float64 alone"
        verdict, remedy = "FAIL", "send float32: rows of 12 or 16 bytes, little-endian"
    elif not points:
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


def stamps_finding(channel: str, messages: Sequence[CapturedMessage], robot: str) -> Finding:
    """Judge whether stamps increase, and about as fast as the local clock."""
    stamps = [m.stamp_ns for m in messages if m.stamp_ns is not None]
    steps = [later - earlier for earlier, later in pairwise(stamps)]
    back, same = sum(step < 0 for step in steps), sum(step == 0 for step in steps)
    if steps and same == len(steps):
        remedy = "the sender has to stamp each message with its sensor time, nanoseconds"
        return Finding("FAIL", channel, f"all {len(stamps)} are {stamps[0]}", remedy, robot)
    span, elapsed = (stamps[-1] - stamps[0]) * 1e-9, messages[-1].arrived - messages[0].arrived
    wrong = elapsed >= 1.0 and not back and not 0.05 < span / elapsed < 20
    if (back or same) and not wrong:
        verdict: Verdict = "FAIL" if back + same > len(steps) / 2 else "warn"
        found = f"of {len(steps)} steps {back} go backwards, {same} stand still"
        remedy = "two senders on one key, or a sender that repeats itself?"
        if not any(stamp % 10**9 for stamp in stamps):
            found, remedy = f"{found}: all are whole seconds", "write nanoseconds"
        return Finding(verdict, channel, found, remedy, robot)
    if elapsed >= 1.0 and not 1 / _MAX_CLOCK_RATIO < span / elapsed < _MAX_CLOCK_RATIO:
        found = f"run {span / elapsed:.3g} times as fast as the clock here"
        remedy = (
            "write nanoseconds" if wrong else "fine for a recording at another speed, else look at the sender's clock"
        )
        return Finding("FAIL" if wrong else "warn", channel, found, remedy, robot)
    return Finding("ok", channel, f"increasing, newest {stamps[-1] * 1e-9:.3f} s", robot=robot)


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


_MAX_LAG = 1.0  # seconds by which a cloud may arrive after the odometry of its stamp; drivers take 0.05 to 0.3
_YEAR = 3.2e7  # seconds
_MIN_PAIRED = 0.9  # share of clouds that find odometry
_MAX_STATUS_AGE = 5.0  # seconds; a node publishes one per second
_LEAP_SECONDS = {37: "TAI (of PTP) against UTC", 18: "GPS time against UTC", 19: "TAI against GPS time"}
_LEAP_TOLERANCE = 0.4  # seconds from a whole number of leap seconds
_MAX_FRAMES = 60  # frames compared with odometry
_NEAREST_NS = 100_000_000  # largest difference between the stamps of a cloud and its odometry
_LONG_SEARCH = 60.0  # seconds: most robots are found within ten
_DROP_COUNTERS = ("out_of_order", "duplicate", "no_odometry", "late")


def cross_findings(capture: RobotCapture) -> Iterator[Finding]:
    """Judge whether clouds and odometry share a clock, and how many clouds find their odometry."""
    clouds = [m for m in capture.clouds if m.stamp_ns is not None]
    odometry = [m for m in capture.odometry if m.stamp_ns is not None]
    if not clouds or not odometry:
        return
    clock = clock_finding(clouds, odometry, capture.keys.robot)
    yield clock
    if clock.verdict != "FAIL":
        yield pairing_finding(clouds, odometry, capture.ended, capture.keys.robot)


def clock_finding(clouds: list[CapturedMessage], odometry: list[CapturedMessage], robot: str) -> Finding:
    """Compare the delays of both channels, from stamp to arrival."""
    ahead = _offset(odometry) - _offset(clouds)
    size = abs(ahead)
    found = f"odometry stamps are {_seconds(size)} {'ahead of' if ahead > 0 else 'behind'} the clouds'"
    horizon, wait = NodeConfig().odometry_history, NodeConfig().pairing_wait
    if -wait <= ahead <= _MAX_LAG:
        return Finding("ok", "one clock", found, robot=robot)
    if 0 < ahead < horizon:
        remedy = "poses come all the same; a slow lidar driver, or two clocks: put both on one"
        return Finding("warn", "one clock", found, remedy, robot)
    remedy = "put both on one clock"
    if size > _YEAR:
        remedy += "; one counts from 1970, the other from when it was switched on"
    elif (leap := _LEAP_SECONDS.get(round(size))) and abs(size - round(size)) < _LEAP_TOLERANCE:
        remedy += f"; this looks like {leap}"
    return Finding("FAIL", "one clock", found, remedy, robot)


def _offset(messages: list[CapturedMessage]) -> float:
    """Return the median of stamp minus arrival, seconds."""
    first = messages[0].stamp_ns or 0
    return first * 1e-9 + statistics.median(((m.stamp_ns or 0) - first) * 1e-9 - m.arrived for m in messages)


def _seconds(value: float) -> str:
    return f"{value:.3g} s" if value >= 100 else f"{value:.2f} s"


def pairing_finding(
    clouds: list[CapturedMessage], odometry: list[CapturedMessage], ended: float, robot: str
) -> Finding:
    """Pass the messages to the node's pairing in order of arrival, and count the clouds that find odometry."""
    config, counters = NodeConfig(odometry_history=60.0), Counters()
    buffer = OdometryBuffer(config)
    pairing = FrameSync(config, buffer, counters)
    # clouds whose odometry came before or after the capture are not judged
    first = min(m.stamp_ns or 0 for m in odometry)
    clouds = [m for m in clouds if (m.stamp_ns or 0) >= first and m.arrived <= ended - config.pairing_wait]
    if not clouds:
        return Finding("warn", "pairing", "too few clouds to say", "listen longer: --seconds 10", robot)
    kinds: dict[SampleKind, int] = dict.fromkeys(SampleKind, 0)
    paired = 0
    for message in heapq.merge(odometry, clouds, key=lambda m: m.arrived):
        if message.T_odom_body is not None:
            kinds[buffer.add(OdometryMessage(message.stamp_ns or 0, message.T_odom_body), message.arrived)] += 1
        else:
            # pairing reads stamps only
            times = None if message.sweep is None else np.array(message.sweep)
            pairing.add(CloudMessage(message.stamp_ns or 0, np.zeros((0, 3), np.float32), times), message.arrived)
        paired += sum(1 for _ in pairing.take_paired(message.arrived))
    paired += sum(1 for _ in pairing.take_paired(ended + config.pairing_wait))
    found = f"{paired} of {len(clouds)} clouds find odometry around their stamps"
    dropped = [f"{getattr(counters, name)} {name}" for name in _DROP_COUNTERS if getattr(counters, name)]
    if dropped:
        found += f" ({', '.join(dropped)})"
    if jumps := kinds[SampleKind.JUMP]:
        found += f"; odometry jumps {jumps} times"
        remedy = "two senders of odometry, one that restarts, or no metres: after each jump the robot is LOST"
        return Finding("FAIL", "pairing", found, remedy, robot)
    if paired < len(clouds) / 2:
        remedy = "send odometry before the cloud that it belongs to, 20 to 100 a second, on the same clock"
        return Finding("FAIL", "pairing", found, remedy, robot)
    return Finding("ok" if paired >= _MIN_PAIRED * len(clouds) else "warn", "pairing", found, robot=robot)


def captured_frames(capture: RobotCapture, mount: Mount | None = None) -> list[SeenFrame]:
    """Return the sampled clouds, by ``mount`` in the body frame, each with the odometry nearest to its stamp."""
    mount = mount or Mount()
    odometry = [(m.stamp_ns or 0, m.T_odom_body) for m in capture.odometry if m.T_odom_body is not None]
    odometry.sort(key=lambda item: item[0])
    clouds = [m for m in capture.clouds if m.cloud is not None and m.stamp_ns is not None]
    if not odometry or not clouds:
        return []
    stamps = np.array([stamp for stamp, _ in odometry])
    frames = []
    for message in clouds[:: -(-len(clouds) // _MAX_FRAMES)]:
        nearest = int(np.argmin(np.abs(stamps - (message.stamp_ns or 0))))
        if abs(int(stamps[nearest]) - (message.stamp_ns or 0)) < _NEAREST_NS and message.cloud is not None:
            points = mount.to_body(message.cloud)
            frames.append(SeenFrame((message.stamp_ns or 0) * 1e-9, points, odometry[nearest][1]))
    return frames


def node_finding(capture: RobotCapture, sha256: str | None, others: Collection[str] = ()) -> Finding:
    """Judge a robot's node and status; ``sha256``: of the map expected, None: any; ``others``: robots with a node."""
    robot, status = capture.keys.robot, capture.status
    if status is None and not capture.alive:
        remedy = f"`coview-stream serve SITE.coview --robot {robot}`"
        if others and not (capture.clouds or capture.odometry):
            found = f"none serves it; nodes serve {', '.join(sorted(others)[:_OTHERS])}"
            return Finding("warn", "node", found, f"is the name right? else {remedy}", robot)
        return Finding("warn", "node", "none is running", remedy, robot)
    if status is None:
        remedy = "is its out/status allowed through, and is --base the same?"
        return Finding("warn", "node", "alive, but says nothing", remedy, robot)
    found = f"{_text(status, 'state')}: {_text(status, 'reason') or 'no reason given'}"
    servers = sorted(capture.servers)
    found += f"; node {servers[0]}" if len(servers) == 1 else ""
    found += f"; version {_text(status, 'version')}, map {_text(status, 'map_sha256')[:12]}"
    if not capture.alive:
        return Finding("warn", "node", f"{found}; no liveliness token", "do access rules let it hold one?", robot)
    if len(servers) > 1:
        found = f"{', '.join(servers)} publish its status: one has just taken over, or they do not hear each other"
        return Finding("warn", "node", found, "do access rules let nodes read out/status?", robot)
    if sha256 and status.get("map_sha256") != sha256:
        return Finding("FAIL", "node", f"{found}, not {sha256[:12]}", "it serves another map: restart it", robot)
    if status.get("version") != __version__:
        return Finding("warn", "node", f"{found}, here {__version__}", "run the same version on both sides", robot)
    behind = (capture.ended_ns - _number(status, "stamp_ns")) * 1e-9  # judging other robots takes seconds
    if behind > _MAX_STATUS_AGE:
        return Finding("warn", "node", f"{found}; {_seconds(behind)} old", "its clock, or this one, is wrong", robot)
    errors = status.get("errors")
    if isinstance(errors, list) and errors:
        return Finding("warn", "node", f"{found}; reports: {str(errors[-1])[:200]}", robot=robot)
    state = status.get("state")
    if state == "LOST" or (state != "TRACKING" and _number(status, "uptime_s") > _LONG_SEARCH):
        reason = _text(status, "reason")
        if "waiting for" in reason or reason.startswith("no clouds"):
            remedy = "its data does not come: see clouds and odometry above"
        elif "places fit" in reason or "leads" in reason:
            remedy = "drive to where these places differ; `info --ambiguity` shows where that takes long"
        else:
            remedy = "drive ten metres; if all else here is ok: is it on this map? `coview-stream help reasons`"
        return Finding("warn", "node", found, remedy, robot)
    return Finding("ok", "node", found, robot=robot)


def _text(status: dict[str, Any], name: str) -> str:
    value = status.get(name)
    return "" if value is None else str(value)


def _number(status: dict[str, Any], name: str) -> float:
    value = status.get(name)
    return float(value) if isinstance(value, (int, float)) else 0.0
