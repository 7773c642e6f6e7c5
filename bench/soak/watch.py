"""Everything that the nodes say, judged as it comes against the simulated truth; memory that does not grow with it."""

from __future__ import annotations

import json
import math
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bench.soak.robots import Manner, content_of
from bench.soak.sites import Site
from bench.soak.stranger import SIGNED
from bench.stream.drive import Drive, RobotPlan, stamp_of
from bench.stream.processes import open_session
from bench.stream.scores import Posed, errors
from coview_stream.messages import decode_pose
from coview_stream.messages.types import Sample

FALSE_METRES, FALSE_DEGREES = 3.0, 5.0
"""A pose further from the truth than either is false."""

_FED = 2.0  # seconds since the last of its messages, within which they arrive
_FAR = 60.0  # seconds between a pose's stamp and its arrival, from which on it belongs to nothing that was sent


@dataclass
class Robot:
    """A robot as it is seen: what arrived from and for it so far."""

    name: str
    site: Site
    start: float = math.inf  # monotonic time at which its drive begins
    manners: list[Manner] = field(default_factory=lambda: [Manner()])  # in which stamps may be
    poses: int = 0
    false: list[tuple[float, float, float]] = field(default_factory=list)  # seconds, metres, degrees
    unreadable: int = 0
    worst: tuple[float, float] = (0.0, 0.0)
    odometries: int = 0
    fed_at: dict[str, float] = field(default_factory=lambda: {"odom": -math.inf, "cloud": -math.inf})
    garbled: int = 0  # poses and statuses that are false or unreadable, while the link from the nodes flips bits
    corrected: float = -math.inf  # moment of the drive of the newest frame that a pose came from
    latencies: list[tuple[float, float]] = field(default_factory=list)  # (arrival, seconds)
    state: str = ""
    states: Counter[str] = field(default_factory=Counter)
    status: dict[str, Any] = field(default_factory=dict)
    received: list[tuple[float, int]] = field(default_factory=list)  # by each node: its start, frames so far
    awaited: float = math.inf  # moment of the drive
    recovered: float | None = None  # arrival of the first pose from a frame of that moment or later

    def __post_init__(self) -> None:
        self.drive = Drive(self.site.world, RobotPlan(self.name, math.inf))

    @property
    def frames(self) -> int:
        """How many frames nodes received of it, by their statuses."""
        return sum(count for _, count in self.received)

    def count(self, start: float, received: int) -> None:
        """Note how many frames the node has received that was started then; a second before or after is the same."""
        for k, (known, before) in enumerate(self.received):
            if abs(known - start) < 1.5:
                self.received[k] = known, max(before, received)
                return
        self.received.append((start, received))

    def set_manner(self, manner: Manner) -> None:
        """Note how it sends from now on: its stamps may be in that manner."""
        if manner not in self.manners:
            self.manners.append(manner)

    def expect(self, moment: float) -> None:
        """Wait for a pose from a frame that was taken at a monotonic time or later."""
        self.awaited, self.recovered = moment - self.start, None

    def fed(self, now: float) -> bool:
        """Whether its odometry and clouds arrive at the router."""
        return now - min(self.fed_at.values()) < _FED


class Watch:
    """Subscriber of all outputs, straight at the router; :meth:`update` judges what came since."""

    def __init__(self, endpoint: str, robots: list[Robot]) -> None:
        import zenoh

        self.robots = {robot.name: robot for robot in robots}
        self.session = open_session("client", connect=[endpoint])
        self.flipping = False  # whether bits may be flipped on the way from the nodes
        self._came: deque[tuple[float, str, bytes, str]] = deque()
        direct = zenoh.handlers.Callback(self._take, indirect=False)
        keys = ("coview/*/out/pose", "coview/*/out/status", "coview/*/in/odom", "coview/*/in/cloud")
        self._held = [self.session.declare_subscriber(key, direct) for key in keys]

    def _take(self, sample: Any) -> None:
        at = time.monotonic()
        if sample.attachment is not None and sample.attachment.to_bytes() == SIGNED:
            return
        key = str(sample.key_expr)
        payload = b"" if "/in/" in key else sample.payload.to_bytes()
        self._came.append((at, key, payload, str(sample.encoding)))

    def close(self) -> None:
        """End the subscription."""
        self.session.close()

    def update(self) -> None:
        """Judge what came since the last time."""
        while self._came:
            at, key, payload, encoding = self._came.popleft()
            _, name, *rest = key.split("/")
            robot = self.robots.get(name)
            if robot is None:
                continue
            if rest[0] == "in":
                robot.fed_at[rest[-1]] = at
                robot.odometries += rest[-1] == "odom"
                continue
            before = len(robot.false), robot.unreadable
            if rest[-1] == "status":
                self._status(robot, at, payload)
            else:
                self._pose(robot, at, Sample(key, payload, encoding))
            if self.flipping:
                robot.garbled += len(robot.false) - before[0] + robot.unreadable - before[1]
                del robot.false[before[0] :]
                robot.unreadable = before[1]

    def _status(self, robot: Robot, at: float, payload: bytes) -> None:
        try:
            told = json.loads(payload)
            counters = told.get("counters") or {}
            state = str(told["state"])
        except (ValueError, KeyError, AttributeError):
            robot.unreadable += 1
            return
        robot.count(at - float(told.get("uptime_s", 0.0)), int(counters.get("received", 0)))
        if state != robot.state:
            robot.states[state] += 1
        robot.state, robot.status = state, told

    def _pose(self, robot: Robot, at: float, sample: Sample) -> None:
        try:
            pose = decode_pose(sample)
        except Exception:  # whatever a node may publish that is none
            robot.unreadable += 1
            return
        due = at - robot.start
        content = content_of(pose.stamp_ns, robot.manners, due)
        robot.poses += 1
        if abs(content - due) > _FAR:
            robot.false.append((round(due, 2), math.inf, math.inf))
            return
        posed = Posed(at, stamp_of(content), pose.T_map_body)
        metres, degrees = (float(each[0]) for each in errors([posed], robot.drive.truth))
        robot.worst = max(robot.worst[0], metres), max(robot.worst[1], degrees)
        if not (metres <= FALSE_METRES and degrees <= FALSE_DEGREES):
            robot.false.append((round(due, 2), round(metres, 2), round(degrees, 2)))
        corrected = content - pose.age
        if math.isfinite(corrected) and (corrected > robot.corrected + 0.002 or corrected < robot.corrected - _FAR):
            robot.corrected = corrected
            robot.latencies.append((at, due - corrected))
        if robot.recovered is None and corrected >= robot.awaited:
            robot.recovered = at


def percentiles(latencies: list[tuple[float, float]], without: list[tuple[float, float]]) -> list[float] | None:
    """p50, p95 and p99 in ms of those that did not arrive within the periods; None of none."""
    arrivals = np.array([at for at, _ in latencies])
    kept = np.ones(len(arrivals), bool)
    for begin, end in without:
        kept &= ~((arrivals >= begin) & (arrivals <= end))
    seconds = np.array([each for _, each in latencies])[kept]
    return [float(each) for each in np.percentile(1e3 * seconds, (50, 95, 99))] if len(seconds) else None
