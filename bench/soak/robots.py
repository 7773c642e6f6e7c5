"""Simulated robots that drive without end and send faulty messages on demand; the record of the nodes' answers."""

from __future__ import annotations

import json
import math
import time
from collections import Counter, deque
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from bench.harness import worlds
from bench.harness.files import fingerprint, remembered
from bench.integrity.kinds import built, draw, size_of, surveyed
from bench.integrity.run import through
from bench.stream.processes import EPOCH_NS, Drive, RobotPlan, open_session, stamp_of
from bench.stream.scores import Posed, errors
from coview_stream.clouds import read_tum, write_cloud, write_tum
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.messages import decode_pose, encode_cloud, encode_odometry
from coview_stream.messages.types import CloudMessage, OdometryMessage, Sample
from coview_stream.sim import SimulationConfig

LENGTH, SENSOR = 60.0, "vlp16"  # metres and lidar of a drive through a deceptive site

_SITE_CODE = (*(f"coview_stream/{part}" for part in ("sim", "basemap", "clouds", "descriptors")), "bench/integrity")

KINDS = ("town", "boxes", "yard")
"""Sites of the robots, in turns; all containers of ``yard`` were moved since the survey."""


class Site(NamedTuple):
    """A world on disk (``run/``, ``truth.tum``) and its map; on a deceptive site no pose is right."""

    name: str
    world: Path
    map: Path
    deceptive: bool


def prepare(below: Path, kind: str, seed: int, quick: bool) -> Site:
    """Return a site; simulate it and build its map unless that is done."""
    if kind == "town":
        full = SimulationConfig(seed=seed, size=220.0, length=80.0)
        config = replace(full, size=140.0, length=30.0, density=10.0) if quick else full
        world = worlds.prepare(below, config)
        return Site(kind, world, worlds.map_of(below, config), deceptive=False)
    world = below / f"soak-{kind}-{seed}"
    spec = {"site": [kind, seed, LENGTH, SENSOR], "code": fingerprint(*_SITE_CODE, "bench/soak/robots.py")}
    remembered(world / "made.json", spec, lambda: _make(world, kind, seed))
    return Site(kind, world, world / "site.coview", deceptive=True)


def _make(world: Path, kind: str, seed: int) -> None:
    size = size_of(kind)
    (world / "run" / "frames").mkdir(parents=True, exist_ok=True)
    built(surveyed(draw(kind, seed, size, 0.0), seed)).save(world / "site.coview")
    drive = through(draw(kind, seed, size, 1.0 if kind == "yard" else 0.0), SENSOR, seed, LENGTH)
    for k in range(len(drive)):
        write_cloud(world / "run" / "frames" / f"{k:06d}.pcd", drive.frame(k))
    write_tum(world / "run" / "odometry.tum", drive.stamps, drive.odometry)
    write_tum(world / "truth.tum", drive.stamps, drive.poses)


CLOUD_PERIOD, ODOMETRY_PERIOD = 0.1, 0.02
REOPEN = "reopen"  # order to open the session again, as after a restart

FALSE_METRES, FALSE_DEGREES = 3.0, 5.0  # a pose further from the truth than either is false
_LATE = 0.5  # seconds after which a delayed message is dropped
_FED = 2.0  # seconds without a message after which a robot counts as disconnected
_FAR = 60.0  # seconds between stamp and arrival above which a pose belongs to no sent frame


@dataclass(frozen=True)
class Manner:
    """How a robot sends."""

    clouds: bool = True
    odometry: bool = True
    frozen: bool = False  # odometry repeats one pose while the robot drives
    stopped: bool = False  # all stamps are equal
    unit_ns: int = 1  # nanoseconds per unit of the stamps; a million for stamps in milliseconds
    offset: float = 0.0  # seconds that the sensor clock is ahead
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)  # x, y, yaw of the odometry frame, metres and radians
    cloud_period: float = CLOUD_PERIOD


def stamp(content: float, manner: Manner) -> int:
    """Return the sensor's stamp at a moment of the drive."""
    return (EPOCH_NS + round((content + manner.offset) * 1e6) * 1000) // manner.unit_ns


def content_of(stamp_ns: int, manners: list[Manner], near: float) -> float:
    """Return the moment of the drive that a stamp means: of all manners, the nearest to ``near``."""
    moments = [(stamp_ns * manner.unit_ns - EPOCH_NS) / 1e9 - manner.offset for manner in manners]
    return min(moments, key=lambda content: abs(content - near))


def drive_on(conn: Connection, endpoint: str, world: Path, name: str) -> None:
    """Send until None is received; the other orders are a :class:`Manner` and :data:`REOPEN`."""
    import zenoh

    drive = Drive(world, RobotPlan(name, float("inf")))
    for k in range(2 * len(read_tum(world / "truth.tum")[0])):
        drive.cloud(k * CLOUD_PERIOD)
    manner, since = Manner(), 0.0
    how: dict[str, dict[str, Any]] = {
        "cloud": {"congestion_control": zenoh.CongestionControl.DROP},
        "odom": {"congestion_control": zenoh.CongestionControl.BLOCK, "priority": zenoh.Priority.INTERACTIVE_HIGH},
    }
    session = open_session("client", connect=[endpoint])
    conn.send("ready")
    start = float(conn.recv())
    due = {"odom": 0.0, "cloud": 0.0}
    while True:
        kind = "odom" if due["odom"] <= due["cloud"] else "cloud"
        if conn.poll(max(0.0, start + due[kind] - time.monotonic())):
            order = conn.recv()
            if order is None:
                break
            if order == REOPEN:
                session.close()
                session = open_session("client", connect=[endpoint])
                continue
            manner, since = order, round(time.monotonic() - start, 1)
            due["cloud"] = max(due["cloud"], since)
            continue
        content, late = due[kind], time.monotonic() - start - due[kind]
        period = ODOMETRY_PERIOD if kind == "odom" else manner.cloud_period
        due[kind] = round(content + period * max(1, int(late / period) if late > _LATE else 1), 6)
        if late > _LATE or not (manner.odometry if kind == "odom" else manner.clouds):
            continue
        at = stamp(since if manner.stopped else content, manner)
        if kind == "cloud":
            message = encode_cloud(CloudMessage(at, drive.cloud(content)), "xyz")
        else:
            x, y, yaw = manner.shift
            pose = pose_from(rot_z(yaw), [x, y, 0.0]) @ drive.T_odom_body(since if manner.frozen else content)
            message = encode_odometry(OdometryMessage(at, pose), "json")
        session.put(
            f"coview/{name}/in/{kind}", message.payload, encoding=message.encoding, attachment=message.attachment,
            **how[kind],
        )  # fmt: skip
    session.close()


@dataclass
class Robot:
    """Record of a robot: the messages from it and for it."""

    name: str
    site: Site
    start: float = math.inf  # monotonic time at which its drive begins
    manners: list[Manner] = field(default_factory=lambda: [Manner()])
    poses: int = 0
    false: list[tuple[float, float, float]] = field(default_factory=list)  # seconds, metres, degrees
    unreadable: int = 0
    worst: tuple[float, float] = (0.0, 0.0)
    fed_at: dict[str, float] = field(default_factory=lambda: {"odom": -math.inf, "cloud": -math.inf})
    corrected: float = -math.inf  # moment of the newest frame behind a pose
    latencies: list[float] = field(default_factory=list)  # seconds
    state: str = ""
    states: Counter[str] = field(default_factory=Counter)
    awaited: float = math.inf  # moment of the drive
    recovered: float | None = None  # arrival of the first pose from a frame of that moment or later

    def __post_init__(self) -> None:
        self.drive = Drive(self.site.world, RobotPlan(self.name, math.inf))

    def expect(self, moment: float) -> None:
        """Wait for a pose from a frame of this monotonic time or later."""
        self.awaited, self.recovered = moment - self.start, None

    def fed(self, now: float) -> bool:
        """Tell whether odometry and clouds of the robot arrive at the router."""
        return now - min(self.fed_at.values()) < _FED

    def take_status(self, payload: bytes) -> None:
        """Record a status."""
        try:
            state = str(json.loads(payload)["state"])
        except (ValueError, KeyError, TypeError):
            self.unreadable += 1
            return
        self.states[state] += state != self.state
        self.state = state

    def take_pose(self, at: float, sample: Sample) -> None:
        """Compare a pose with the truth at its stamp."""
        try:
            pose = decode_pose(sample)
        except Exception:  # a node may publish anything
            self.unreadable += 1
            return
        due = at - self.start
        content = content_of(pose.stamp_ns, self.manners, due)
        self.poses += 1
        if abs(content - due) > _FAR:
            self.false.append((round(due, 2), math.inf, math.inf))
            return
        posed = Posed(at, stamp_of(content), pose.T_map_body)
        metres, degrees = (float(error[0]) for error in errors([posed], self.drive.truth))
        self.worst = max(self.worst[0], metres), max(self.worst[1], degrees)
        if not (metres <= FALSE_METRES and degrees <= FALSE_DEGREES):
            self.false.append((round(due, 2), round(metres, 2), round(degrees, 2)))
        corrected = content - pose.age
        if math.isfinite(corrected) and (corrected > self.corrected + 0.002 or corrected < self.corrected - _FAR):
            self.corrected = corrected
            self.latencies.append(due - corrected)
        if self.recovered is None and corrected >= self.awaited:
            self.recovered = at


class Watch:
    """Subscriber to all outputs at the router; :meth:`update` judges the messages since the last call."""

    def __init__(self, endpoint: str, robots: list[Robot]) -> None:
        import zenoh

        self.robots = {robot.name: robot for robot in robots}
        self.session = open_session("client", connect=[endpoint])
        self._arrived: deque[tuple[float, str, bytes, str]] = deque()
        direct = zenoh.handlers.Callback(self._take, indirect=False)
        keys = ("coview/*/out/pose", "coview/*/out/status", "coview/*/in/odom", "coview/*/in/cloud")
        self._subscribers = [self.session.declare_subscriber(key, direct) for key in keys]

    def _take(self, sample: Any) -> None:
        at, key = time.monotonic(), str(sample.key_expr)
        payload = b"" if "/in/" in key else sample.payload.to_bytes()
        self._arrived.append((at, key, payload, str(sample.encoding)))

    def update(self) -> None:
        """Judge the messages since the last call."""
        while self._arrived:
            at, key, payload, encoding = self._arrived.popleft()
            _, name, way, kind = key.split("/")
            if name not in self.robots:
                continue
            robot = self.robots[name]
            if way == "in":
                robot.fed_at[kind] = at
            elif kind == "status":
                robot.take_status(payload)
            else:
                robot.take_pose(at, Sample(key, payload, encoding))
