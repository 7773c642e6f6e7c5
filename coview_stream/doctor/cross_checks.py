"""A robot's clouds and odometry beside each other, and the node beside both."""

from __future__ import annotations

import heapq
import statistics
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from coview_stream.config.node import NodeConfig
from coview_stream.doctor.capture import Heard, Seen
from coview_stream.doctor.finding import Finding
from coview_stream.messages.types import CloudMessage, OdometryMessage
from coview_stream.odometry.buffer import OdometryBuffer, SampleKind
from coview_stream.stream.node.counters import Counters
from coview_stream.stream.node.frame_sync import FrameSync
from coview_stream.version import __version__

_LAG = 1.0  # seconds that a cloud may come after the odometry of its stamp; drivers take 0.05 to 0.3
_YEAR = 3.2e7  # seconds
_LEAPS = {37: "TAI (of PTP) against UTC", 18: "GPS time against UTC", 19: "TAI against GPS time"}
_EVENTS = ("out_of_order", "duplicate", "no_odometry", "late")


def together_findings(heard: Heard) -> Iterator[Finding]:
    """Whether both are on one clock, and how many clouds would find their odometry."""
    clouds = [s for s in heard.clouds if s.stamp_ns is not None]
    odometry = [s for s in heard.odometry if s.stamp_ns is not None]
    if not clouds or not odometry:
        return
    clock = clock_finding(clouds, odometry, heard.keys.robot)
    yield clock
    if clock.verdict != "FAIL":
        yield pairing_finding(clouds, odometry, heard.ended, heard.keys.robot)


def clock_finding(clouds: list[Seen], odometry: list[Seen], robot: str) -> Finding:
    """Compare how far stamps are from the time of arrival."""
    ahead = _offset(odometry) - _offset(clouds)
    size = abs(ahead)
    found = f"odometry stamps are {_seconds(size)} {'ahead of' if ahead > 0 else 'behind'} the clouds'"
    horizon, wait = NodeConfig().odometry_history, NodeConfig().pairing_wait
    if -wait <= ahead <= _LAG:
        return Finding("ok", "one clock", found, robot=robot)
    if 0 < ahead < horizon:
        remedy = "poses come all the same; a slow lidar driver, or two clocks: put both on one"
        return Finding("warn", "one clock", found, remedy, robot)
    remedy = "put both on one clock"
    if size > _YEAR:
        remedy += "; one counts from 1970, the other from when it was switched on"
    elif (leap := _LEAPS.get(round(size))) and abs(size - round(size)) < 0.4:
        remedy += f"; this looks like {leap}"
    return Finding("FAIL", "one clock", found, remedy, robot)


def _offset(seen: list[Seen]) -> float:
    """Stamp less arrival, seconds, of the typical message."""
    first = seen[0].stamp_ns or 0
    return first * 1e-9 + statistics.median(((s.stamp_ns or 0) - first) * 1e-9 - s.arrived for s in seen)


def _seconds(value: float) -> str:
    return f"{value:.3g} s" if value >= 100 else f"{value:.2f} s"


def pairing_finding(clouds: list[Seen], odometry: list[Seen], ended: float, robot: str) -> Finding:
    """Play the messages to the node's own pairing, in order of arrival, and see what becomes of the clouds."""
    config, counters = NodeConfig(odometry_history=60.0), Counters()
    buffer = OdometryBuffer(config)
    pairing = FrameSync(config, buffer, counters)
    # what was under way when listening began or ended says nothing
    first = min(s.stamp_ns or 0 for s in odometry)
    clouds = [s for s in clouds if (s.stamp_ns or 0) >= first and s.arrived <= ended - config.pairing_wait]
    if not clouds:
        return Finding("warn", "pairing", "too few clouds to say", "listen longer: --seconds 10", robot)
    intake: dict[SampleKind, int] = dict.fromkeys(SampleKind, 0)
    paired = 0
    for seen in heapq.merge(odometry, clouds, key=lambda s: s.arrived):
        if seen.T_odom_body is not None:
            intake[buffer.add(OdometryMessage(seen.stamp_ns or 0, seen.T_odom_body), seen.arrived)] += 1
        else:
            pairing.add(_outline(seen), seen.arrived)
        paired += sum(1 for _ in pairing.paired(seen.arrived))
    paired += sum(1 for _ in pairing.paired(ended + config.pairing_wait))
    found = f"{paired} of {len(clouds)} clouds find odometry around their stamps"
    lost = [f"{getattr(counters, name)} {name}" for name in _EVENTS if getattr(counters, name)]
    if lost:
        found += f" ({', '.join(lost)})"
    if jumps := intake[SampleKind.JUMP]:
        found += f"; odometry jumps {jumps} times"
        remedy = "two senders of odometry, or one that starts anew: after each jump the robot is LOST"
        return Finding("FAIL", "pairing", found, remedy, robot)
    if paired < len(clouds) / 2:
        remedy = "send odometry before the cloud that it belongs to, 20 to 100 a second, on the same clock"
        return Finding("FAIL", "pairing", found, remedy, robot)
    return Finding("ok" if paired >= 0.9 * len(clouds) else "warn", "pairing", found, robot=robot)


def _outline(seen: Seen) -> CloudMessage:
    """Return a cloud without points: pairing looks at stamps only."""
    times = None if seen.sweep is None else np.array(seen.sweep)
    return CloudMessage(seen.stamp_ns or 0, np.zeros((0, 3), np.float32), times)


def node_finding(heard: Heard, sha256: str | None, now_ns: int | None = None) -> Finding:
    """Whether a node serves the robot, and what it says; ``sha256`` of the map it should have, None for any."""
    robot, status = heard.keys.robot, heard.status
    if status is None and not heard.alive:
        return Finding(
            "warn", "node", "none is running", f"`coview-stream serve SITE.coview --robot {robot}`", robot
        )
    if status is None:
        remedy = "is its out/status allowed through, and is --base the same?"
        return Finding("warn", "node", "alive, but says nothing", remedy, robot)
    found = f"{_text(status, 'state')}: {_text(status, 'reason') or 'no reason given'}"
    found += f", version {_text(status, 'version')}, map {_text(status, 'map_sha256')[:12]}"
    if not heard.alive:
        return Finding(
            "warn", "node", f"{found}; no liveliness token", "do access rules let it hold one?", robot
        )
    if sha256 and status.get("map_sha256") != sha256:
        return Finding(
            "FAIL", "node", f"{found}, not {sha256[:12]}", "it serves another map: restart it", robot
        )
    if status.get("version") != __version__:
        return Finding(
            "warn", "node", f"{found}, here {__version__}", "run the same version on both sides", robot
        )
    behind = ((time.time_ns() if now_ns is None else now_ns) - _number(status, "stamp_ns")) * 1e-9
    if behind > 5.0:
        return Finding(
            "warn", "node", f"{found}; {_seconds(behind)} old", "its clock, or this one, is wrong", robot
        )
    errors = status.get("errors")
    if isinstance(errors, list) and errors:
        return Finding("warn", "node", f"{found}; complains: {str(errors[-1])[:200]}", robot=robot)
    return Finding("ok", "node", found, robot=robot)


def _text(status: dict[str, Any], name: str) -> str:
    value = status.get(name)
    return "" if value is None else str(value)


def _number(status: dict[str, Any], name: str) -> float:
    value = status.get(name)
    return float(value) if isinstance(value, (int, float)) else 0.0
