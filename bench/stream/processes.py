"""The processes around the node: a router with a metronome, senders, a rogue; and the recorder, in this process.

They use raw zenoh and the documented keys. The metronome ticks at 10 Hz through the same router; its jitter at the
recorder is the machine's own.
"""

from __future__ import annotations

import functools
import json
import multiprocessing
import random
import socket
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from bench.stream.scores import Posed, Told
from coview_stream.clouds import read_tum
from coview_stream.errors import MessageError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, interpolate
from coview_stream.messages import CLOUD_CODECS, ODOMETRY_CODECS, decode_pose, encode_cloud, encode_odometry
from coview_stream.messages.types import CloudMessage, Encoded, OdometryMessage, Sample
from coview_stream.recordings.open_run import open_run
from coview_stream.recordings.run import Run
from coview_stream.report.evaluation import driven

EPOCH_NS = 1_700_000_000 * 10**9
"""The begin of the robots' sensor clocks, which is no time of the machine."""

APART = 31
"""Frames between the starts of neighbouring robots."""

Kind = Literal["odom", "cloud"]


@dataclass(frozen=True)
class RobotPlan:
    """Stream of one robot until ``seconds``: clouds and odometry, one each period (0: none)."""

    robot: str
    seconds: float
    cloud: str = "xyz"  # codec
    odometry: str = "json"
    cloud_period: float = 0.1
    odometry_period: float = 0.02
    frame_seconds: float = 0.1  # between frames of the run (recorded: 0.1)
    points: int | None = None  # to which every cloud is resampled

    def schedule(self) -> list[tuple[float, Kind]]:
        """Return the times of all messages with their kinds, in order; at equal times odometry first."""
        periods: tuple[tuple[Kind, float], ...] = (("odom", self.odometry_period), ("cloud", self.cloud_period))
        times = [(round(k * p, 6), kind) for kind, p in periods if p for k in range(round(self.seconds / p))]
        return sorted(times, key=lambda item: item[0])


def stamp_of(content: float) -> int:
    """Sensor stamp, rounded to the microsecond."""
    return EPOCH_NS + round(content * 1e6) * 1000


class Drive:
    """A plan's robot on the recorded run of a world; ``r1`` starts at its first frame, each other one further on."""

    def __init__(self, world: Path, plan: RobotPlan) -> None:
        self._world, self._plan = world, plan
        self._start = APART * (int(plan.robot.lstrip("r")) - 1)
        self._truth = read_tum(world / "truth.tum")[1]

    def _at(self, content: float) -> float:
        """Index into the run, between frames."""
        last = len(self._truth) - 1
        along = (self._start + content / self._plan.frame_seconds) % (2 * last)
        return min(along, 2 * last - along)

    def cloud(self, content: float) -> Points:
        """Return the frame nearest to that moment, (N, 3), body frame, metres."""
        return _cloud(self._world, round(self._at(content)), self._plan.points)

    def T_odom_body(self, content: float) -> Pose:
        """Return the odometry, between frames as well."""
        return _between(_run(self._world).poses, self._at(content))

    def truth(self, stamp_ns: int) -> Pose:
        """Return the true T_map_body at a published stamp."""
        return _between(self._truth, self._at((stamp_ns - EPOCH_NS) / 1e9))

    def metres(self, stamp_ns: int) -> float:
        """Distance driven until a published stamp; only for drives that do not turn back before."""
        way = driven(self._truth)
        at = self._start + (stamp_ns - EPOCH_NS) / 1e9 / self._plan.frame_seconds
        return float(np.interp(at, np.arange(len(way)), way) - way[self._start])


def _between(poses: Floats, at: float) -> Pose:
    low = min(int(at), len(poses) - 2)
    return interpolate(poses[low], poses[low + 1], at - low)


@functools.cache
def _run(world: Path) -> Run:
    return open_run(world / "run")


@functools.cache  # shared by the robots of a process
def _cloud(world: Path, index: int, count: int | None) -> Points:
    points = _run(world).read(index).points
    if count is None:
        return points
    rng = np.random.default_rng(index)
    points = points[rng.choice(len(points), count, replace=count > len(points))]
    return (points + rng.normal(0, 0.01, points.shape)).astype(np.float32)


METRONOME = "bench/metronome"
TICK = 0.1
_AHEAD = 0.5  # seconds between the order to start and the first message

_SPAWN = multiprocessing.get_context("spawn")  # a fork of a process with an open session hangs


def free_port() -> int:
    """Return a loopback port that is not in use."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def open_session(mode: str, connect: Sequence[str] = (), listen: Sequence[str] = ()) -> Any:
    """Open zenoh without discovery and quick to reconnect: the benchmarks measure the node."""
    import zenoh

    config = zenoh.Config()
    for key, value in {
        "mode": mode,
        "connect/endpoints": list(connect),
        "listen/endpoints": list(listen),
        "scouting/multicast/enabled": False,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 200, "period_increase_factor": 1.5},
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def put(session: Any, robot: str, kind: Kind, message: Encoded) -> None:
    """Send a message to a robot's input; clouds may be dropped on a slow link, odometry waits."""
    import zenoh

    control = zenoh.CongestionControl.DROP if kind == "cloud" else zenoh.CongestionControl.BLOCK
    session.put(
        f"coview/{robot}/in/{kind}", message.payload, encoding=message.encoding or None,
        attachment=message.attachment, congestion_control=control,
    )  # fmt: skip


class Helper:
    """A process that reports when it is ready, waits for ``begin``, works, and sends back its result."""

    def __init__(self, work: Callable[..., None], *args: Any) -> None:
        self._ours, theirs = _SPAWN.Pipe()
        self.process = _SPAWN.Process(target=work, args=(theirs, *args), daemon=True)
        self.process.start()
        theirs.close()
        self.result(120.0)

    def send(self, order: Any) -> None:
        """Give an order; most helpers end their work at any order after the first."""
        self._ours.send(order)

    def begin(self, at: float | None = None) -> float:
        """Order the start at a monotonic time; return it."""
        at = time.monotonic() + _AHEAD if at is None else at
        self.send(at)
        return at

    def result(self, timeout: float = 300.0) -> Any:
        """Wait for the next report."""
        if not self._ours.poll(timeout):
            raise TimeoutError(f"a helper process of the benchmark said nothing for {timeout} s")
        return self._ours.recv()

    def kill(self) -> None:
        """Send SIGKILL and wait."""
        self.process.kill()
        self.process.join(10)


def route(conn: Connection, port: int) -> None:
    """Be a router and tick until an order comes."""
    with open_session("router", listen=[f"tcp/127.0.0.1:{port}"]) as session:
        publisher = session.declare_publisher(METRONOME, express=True)
        conn.send("ready")
        tick = time.monotonic()
        while not conn.poll(max(0.0, tick - time.monotonic())):
            publisher.put(b"\0" * 400)
            tick += TICK


class Sent(NamedTuple):
    """Stamps and times of each robot's cloud puts, (N, 2); the sender's longest delay, seconds."""

    puts: dict[str, Floats]
    longest_lag: float


def send(conn: Connection, endpoint: str, world: Path, plans: Sequence[RobotPlan]) -> None:
    """Stream the plans' robots through one session, on time; every cloud is loaded before."""
    drives = {plan.robot: Drive(world, plan) for plan in plans}
    todo = sorted(((*due, plan) for plan in plans for due in plan.schedule()), key=lambda item: item[0])
    for content, kind, plan in todo:
        if kind == "cloud":
            drives[plan.robot].cloud(content)
    puts: dict[str, list[tuple[int, float]]] = {plan.robot: [] for plan in plans}
    lag = 0.0
    with open_session("client", connect=[endpoint]) as session:
        conn.send("ready")
        start = float(conn.recv())
        for content, kind, plan in todo:
            while (wait := start + content - time.monotonic()) > 0:
                time.sleep(wait)
            if conn.poll():
                break
            drive, stamp = drives[plan.robot], stamp_of(content)
            if kind == "cloud":
                message = encode_cloud(CloudMessage(stamp, drive.cloud(content)), plan.cloud)
                puts[plan.robot].append((stamp, time.monotonic()))
            else:
                message = encode_odometry(OdometryMessage(stamp, drive.T_odom_body(content)), plan.odometry)
            put(session, plan.robot, kind, message)
            lag = max(lag, -wait)
    conn.send(Sent({robot: np.array(rows, np.float64).reshape(-1, 2) for robot, rows in puts.items()}, lag))


def vandalise(conn: Connection, endpoint: str, robot: str, rate: float) -> None:
    """Send random bytes and damaged messages to a robot's inputs, ``rate`` a second, until an order comes."""
    rng = random.Random(7)
    cloud, odometry = CloudMessage(EPOCH_NS, np.zeros((300, 3), np.float32)), OdometryMessage(EPOCH_NS, np.eye(4))
    valid = [encode_cloud(cloud, name) for name in CLOUD_CODECS]
    valid += [encode_odometry(odometry, name) for name in ODOMETRY_CODECS]
    strange = ("", "text/plain", "application/x-unheard-of", "application/cdr;some_msgs/msg/Other", "a;b;c;d")
    kinds: tuple[Kind, Kind] = ("odom", "cloud")
    with open_session("client", connect=[endpoint]) as session:
        conn.send("ready")
        due = float(conn.recv())
        while not conn.poll(max(0.0, due - time.monotonic())):
            whole = rng.choice(valid)
            payload = bytearray(whole.payload[: rng.choice((None, rng.randrange(1, len(whole.payload))))])
            for _ in range(rng.randrange(1, 9)):
                payload[rng.randrange(len(payload))] = rng.randrange(256)
            if rng.random() < 0.5:
                payload = bytearray(rng.randbytes(1 << 20 if rng.random() < 0.04 else rng.randrange(5001)))
            encoding = rng.choice((whole.encoding, whole.encoding, *strange))
            attachment = rng.choice((whole.attachment, None, b"", rng.randbytes(8), rng.randbytes(33)))
            put(session, robot, rng.choice(kinds), Encoded(bytes(payload), encoding, attachment))
            due = max(due + 1.0 / rate, time.monotonic() - 0.5)


class Recorder:
    """Arrivals of all outputs of the robots, and of further ``keys``; a message costs microseconds."""

    def __init__(self, endpoint: str, *keys: str) -> None:
        import zenoh

        self.endpoint, self.unreadable = endpoint, 0
        self.arrived: deque[tuple[float, str, bytes, str]] = deque()  # time, key, payload, encoding
        self._tokens: dict[str, bool] = {}

        def record(sample: Any) -> None:
            at = time.monotonic()
            self.arrived.append((at, str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding)))

        def token(sample: Any) -> None:
            self._tokens[str(sample.key_expr)] = sample.kind == zenoh.SampleKind.PUT

        self.session = open_session("client", connect=[endpoint])
        direct = zenoh.handlers.Callback(record, indirect=False)
        self._held = [self.session.declare_subscriber(key, direct) for key in ("coview/*/out/*", METRONOME, *keys)]
        self._held.append(self.session.liveliness().declare_subscriber("coview/*/alive", token, history=True))

    def _of(self, key: str, begin: float, end: float) -> list[tuple[float, str, bytes, str]]:
        return [row for row in self.arrived.copy() if row[1] == key and begin <= row[0] < end]

    def poses(self, robot: str, begin: float = 0.0, end: float = float("inf")) -> list[Posed]:
        """Return a robot's poses that arrived within a period; count the unreadable ones."""
        poses = []
        for at, key, payload, encoding in self._of(f"coview/{robot}/out/pose", begin, end):
            try:
                pose = decode_pose(Sample(key, payload, encoding))
                poses.append(Posed(at, pose.stamp_ns, pose.T_map_body, pose.age))
            except MessageError as error:
                self.unreadable += 1
                print(f"unreadable pose, {encoding}: {error!r}")
        return poses

    def told(self, robot: str, begin: float = 0.0, end: float = float("inf")) -> list[Told]:
        """Return a robot's statuses that arrived within a period."""
        statuses = self._of(f"coview/{robot}/out/status", begin, end)
        return [Told(at, json.loads(payload)) for at, _, payload, _ in statuses]

    def ticks(self, begin: float, end: float) -> list[float]:
        """Return the metronome's arrivals."""
        return [at for at, *_ in self._of(METRONOME, begin, end)]

    def alive(self, robot: str) -> bool:
        """Tell whether the robot's token is there."""
        return self._tokens.get(f"coview/{robot}/alive", False)


def wait_until(true: Callable[[], bool], seconds: float) -> bool:
    """Wait for a condition; return whether it came."""
    deadline = time.monotonic() + seconds
    while not (met := true()) and time.monotonic() < deadline:
        time.sleep(0.05)
    return met
