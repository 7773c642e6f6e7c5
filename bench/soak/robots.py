"""Simulated robots that drive without end and send faulty messages on demand; the record of the nodes' answers."""

from __future__ import annotations

import json
import math
import time
from collections import Counter
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

from bench.stream.processes import EPOCH_NS, Drive, Kind, RobotPlan, open_session, put, stamp_of
from bench.stream.scores import Posed, errors
from coview_stream.clouds import read_tum
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.messages import decode_pose, encode_cloud, encode_odometry
from coview_stream.messages.types import CloudMessage, OdometryMessage, Sample

CLOUD_PERIOD, ODOMETRY_PERIOD = 0.1, 0.02
REOPEN = "reopen"  # order to open the session again, as after a restart

FALSE_METRES, FALSE_DEGREES = 3.0, 5.0  # a pose further from the truth than either is false
_LATE = 0.5  # seconds after which a delayed message is dropped


@dataclass(frozen=True)
class Manner:
    """How a robot sends."""

    clouds: bool = True
    odometry: bool = True
    frozen: bool = False  # odometry repeats one pose while the robot drives
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)  # x, y, yaw of the odometry frame, metres and radians
    cloud_period: float = CLOUD_PERIOD


def drive_on(conn: Connection, endpoint: str, world: Path, name: str) -> None:
    """Send until None is received; the other orders are a :class:`Manner` and :data:`REOPEN`."""
    drive = Drive(world, RobotPlan(name, math.inf))
    for k in range(2 * len(read_tum(world / "truth.tum")[0])):
        drive.cloud(k * CLOUD_PERIOD)
    manner, since = Manner(), 0.0
    session = open_session("client", connect=[endpoint])
    conn.send("ready")
    start = float(conn.recv())
    due: dict[Kind, float] = {"odom": 0.0, "cloud": 0.0}
    while True:
        kind: Kind = "odom" if due["odom"] <= due["cloud"] else "cloud"
        if conn.poll(max(0.0, start + due[kind] - time.monotonic())):
            order = conn.recv()
            if order is None:
                break
            if order == REOPEN:
                session.close()
                session = open_session("client", connect=[endpoint])
            else:
                manner, since = order, round(time.monotonic() - start, 1)
                due["cloud"] = max(due["cloud"], since)
            continue
        content, late = due[kind], time.monotonic() - start - due[kind]
        period = ODOMETRY_PERIOD if kind == "odom" else manner.cloud_period
        due[kind] = round(content + period * max(1, int(late / period) if late > _LATE else 1), 6)
        if late > _LATE or not (manner.odometry if kind == "odom" else manner.clouds):
            continue
        if kind == "cloud":
            message = encode_cloud(CloudMessage(stamp_of(content), drive.cloud(content)), "xyz")
        else:
            x, y, yaw = manner.shift
            pose = pose_from(rot_z(yaw), [x, y, 0.0]) @ drive.T_odom_body(since if manner.frozen else content)
            message = encode_odometry(OdometryMessage(stamp_of(content), pose), "json")
        put(session, name, kind, message)
    session.close()


@dataclass
class Robot:
    """Record of a robot's answers; moments are seconds since its drive began."""

    name: str
    world: Path
    elsewhere: bool  # the world is not on the map: every pose is false
    start: float = math.inf  # monotonic time at which its drive begins
    poses: int = 0
    false: list[tuple[float, float, float]] = field(default_factory=list)  # moment, metres, degrees
    unreadable: int = 0
    fed: float = -math.inf  # monotonic time at which its newest odometry reached the router
    corrected: float = -math.inf  # moment of the newest frame behind a pose
    latencies: list[float] = field(default_factory=list)  # seconds
    state: str = ""
    states: Counter[str] = field(default_factory=Counter)
    awaited: float = math.inf  # moment
    recovered: float | None = None  # arrival of the first pose from a frame of that moment or later

    def __post_init__(self) -> None:
        self.drive = Drive(self.world, RobotPlan(self.name, math.inf))

    def expect(self, since: float) -> None:
        """Wait for a pose from a frame of this monotonic time or later."""
        self.awaited, self.recovered = since - self.start, None

    def take(self, at: float, sample: Sample) -> None:
        """Record a message of the robot or for it."""
        kind = sample.key.rsplit("/", 1)[1]
        try:
            if kind == "odom":
                self.fed = at
            elif kind == "status":
                state = str(json.loads(sample.payload)["state"])
                self.states[state] += state != self.state
                self.state = state
            elif kind == "pose":
                pose = decode_pose(sample)
                self._judge(Posed(at, pose.stamp_ns, pose.T_map_body, pose.age))
        except Exception:  # a node may publish anything
            self.unreadable += 1

    def _judge(self, pose: Posed) -> None:
        """Compare a pose with the truth at its stamp."""
        moment = (pose.stamp_ns - EPOCH_NS) / 1e9
        metres, degrees = (float(error[0]) for error in errors([pose], self.drive.truth))
        self.poses += 1
        if self.elsewhere or not (metres <= FALSE_METRES and degrees <= FALSE_DEGREES):
            self.false.append((round(moment, 2), round(metres, 2), round(degrees, 2)))
        corrected = moment - pose.age
        if corrected > self.corrected + 0.002:
            self.corrected = corrected
            self.latencies.append(pose.arrival - self.start - corrected)
        if self.recovered is None and corrected >= self.awaited:
            self.recovered = pose.arrival
