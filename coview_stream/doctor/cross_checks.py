"""Checks of a robot's clouds against its odometry, and of the node against both."""

from __future__ import annotations

import heapq
import statistics
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from coview_stream.config.node import NodeConfig
from coview_stream.doctor.capture import CapturedMessage, RobotCapture
from coview_stream.doctor.finding import Finding
from coview_stream.doctor.frame_checks import SeenFrame
from coview_stream.messages.types import CloudMessage, OdometryMessage
from coview_stream.odometry.buffer import OdometryBuffer, SampleKind
from coview_stream.stream.node.counters import Counters
from coview_stream.stream.node.frame_sync import FrameSync
from coview_stream.version import __version__

_MAX_LAG = 1.0  # seconds of a cloud after the odometry of its stamp, set by hand; drivers take 0.05 to 0.3
_YEAR = 3.2e7  # seconds
_MIN_PAIRED = 0.9  # share of the clouds that find odometry, set by hand
_MAX_STATUS_AGE = 5.0  # seconds, set by hand; a node publishes one every second
_LEAP_SECONDS = {37: "TAI (of PTP) against UTC", 18: "GPS time against UTC", 19: "TAI against GPS time"}
_LEAP_TOLERANCE = 0.4  # seconds off a whole number of leap seconds, set by hand
_MAX_FRAMES = 60  # compared with odometry, set by hand
_NEAREST_NS = 100_000_000  # a cloud's stamp from the odometry that is taken for it, set by hand
_LONG_SEARCH = 60.0  # seconds, set by hand: most robots are found within ten
_DROP_COUNTERS = ("out_of_order", "duplicate", "no_odometry", "late")


def cross_findings(capture: RobotCapture) -> Iterator[Finding]:
    """Judge whether both are on one clock, and how many clouds find their odometry."""
    clouds = [m for m in capture.clouds if m.stamp_ns is not None]
    odometry = [m for m in capture.odometry if m.stamp_ns is not None]
    if not clouds or not odometry:
        return
    clock = clock_finding(clouds, odometry, capture.keys.robot)
    yield clock
    if clock.verdict != "FAIL":
        yield pairing_finding(clouds, odometry, capture.ended, capture.keys.robot)


def clock_finding(clouds: list[CapturedMessage], odometry: list[CapturedMessage], robot: str) -> Finding:
    """Compare the distances of both channels' stamps from their times of arrival."""
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
    """Return the median of stamp less arrival, seconds."""
    first = messages[0].stamp_ns or 0
    return first * 1e-9 + statistics.median(((m.stamp_ns or 0) - first) * 1e-9 - m.arrived for m in messages)


def _seconds(value: float) -> str:
    return f"{value:.3g} s" if value >= 100 else f"{value:.2f} s"


def pairing_finding(
    clouds: list[CapturedMessage], odometry: list[CapturedMessage], ended: float, robot: str
) -> Finding:
    """Pass the messages to the node's own pairing, in order of arrival, and judge what becomes of the clouds."""
    config, counters = NodeConfig(odometry_history=60.0), Counters()
    buffer = OdometryBuffer(config)
    pairing = FrameSync(config, buffer, counters)
    # clouds whose odometry came before the capture began or after it ended are not judged
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
            pairing.add(_without_points(message), message.arrived)
        paired += sum(1 for _ in pairing.take_paired(message.arrived))
    paired += sum(1 for _ in pairing.take_paired(ended + config.pairing_wait))
    found = f"{paired} of {len(clouds)} clouds find odometry around their stamps"
    dropped = [f"{getattr(counters, name)} {name}" for name in _DROP_COUNTERS if getattr(counters, name)]
    if dropped:
        found += f" ({', '.join(dropped)})"
    if jumps := kinds[SampleKind.JUMP]:
        found += f"; odometry jumps {jumps} times"
        remedy = "two senders of odometry, or one that starts anew: after each jump the robot is LOST"
        return Finding("FAIL", "pairing", found, remedy, robot)
    if paired < len(clouds) / 2:
        remedy = "send odometry before the cloud that it belongs to, 20 to 100 a second, on the same clock"
        return Finding("FAIL", "pairing", found, remedy, robot)
    return Finding("ok" if paired >= _MIN_PAIRED * len(clouds) else "warn", "pairing", found, robot=robot)


def captured_frames(capture: RobotCapture) -> list[SeenFrame]:
    """Return the clouds that were kept, each with the odometry nearest to its stamp."""
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
            frames.append(SeenFrame((message.stamp_ns or 0) * 1e-9, message.cloud, odometry[nearest][1]))
    return frames


def _without_points(captured: CapturedMessage) -> CloudMessage:
    """Return a cloud of the same stamp without points: pairing reads stamps only."""
    times = None if captured.sweep is None else np.array(captured.sweep)
    return CloudMessage(captured.stamp_ns or 0, np.zeros((0, 3), np.float32), times)


def node_finding(capture: RobotCapture, sha256: str | None, now_ns: int | None = None) -> Finding:
    """Judge whether a node serves the robot, and its status; ``sha256`` of the map it should have, None for any."""
    robot, status = capture.keys.robot, capture.status
    if status is None and not capture.alive:
        return Finding("warn", "node", "none is running", f"`coview-stream serve SITE.coview --robot {robot}`", robot)
    if status is None:
        remedy = "is its out/status allowed through, and is --base the same?"
        return Finding("warn", "node", "alive, but says nothing", remedy, robot)
    found = f"{_text(status, 'state')}: {_text(status, 'reason') or 'no reason given'}"
    servers = sorted(capture.servers)
    found += f", node {servers[0]}" if len(servers) == 1 else ""
    found += f", version {_text(status, 'version')}, map {_text(status, 'map_sha256')[:12]}"
    if not capture.alive:
        return Finding("warn", "node", f"{found}; no liveliness token", "do access rules let it hold one?", robot)
    if len(servers) > 1:
        found = f"{', '.join(servers)} publish its status: one has just taken over, or they do not hear each other"
        return Finding("warn", "node", found, "do access rules let nodes read out/status?", robot)
    if sha256 and status.get("map_sha256") != sha256:
        return Finding("FAIL", "node", f"{found}, not {sha256[:12]}", "it serves another map: restart it", robot)
    if status.get("version") != __version__:
        return Finding("warn", "node", f"{found}, here {__version__}", "run the same version on both sides", robot)
    behind = ((time.time_ns() if now_ns is None else now_ns) - _number(status, "stamp_ns")) * 1e-9
    if behind > _MAX_STATUS_AGE:
        return Finding("warn", "node", f"{found}; {_seconds(behind)} old", "its clock, or this one, is wrong", robot)
    errors = status.get("errors")
    if isinstance(errors, list) and errors:
        return Finding("warn", "node", f"{found}; reports: {str(errors[-1])[:200]}", robot=robot)
    if status.get("state") != "TRACKING" and _number(status, "uptime_s") > _LONG_SEARCH:
        return Finding("warn", "node", found, _not_found(_text(status, "reason")), robot)
    return Finding("ok", "node", found, robot=robot)


def _not_found(reason: str) -> str:
    """Say what to do about a robot that has no place."""
    if "waiting for" in reason or reason.startswith("no clouds"):
        return "its data does not come: see clouds and odometry above"
    if "two places" in reason or "several places" in reason or "leads" in reason:
        return "drive on, past what tells these places apart; `info --ambiguity` shows where that takes long"
    return "drive ten metres; if all else here is ok: is it on this map? docs/troubleshooting.md"


def _text(status: dict[str, Any], name: str) -> str:
    value = status.get(name)
    return "" if value is None else str(value)


def _number(status: dict[str, Any], name: str) -> float:
    value = status.get(name)
    return float(value) if isinstance(value, (int, float)) else 0.0
