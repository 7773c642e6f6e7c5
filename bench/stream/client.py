"""The processes around the node: a router with a metronome, senders, a rogue; and the recorder, in this process.

The metronome ticks at 10 Hz through the same router: what the recorder sees of its jitter is the machine's own,
to be compared with that of the poses.
"""

from __future__ import annotations

import json
import multiprocessing
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np

from bench.stream.drive import Drive, RobotPlan, schedule, stamp_of
from bench.stream.scores import Posed, Told
from bench.stream.wire import CLOUDS, ODOMETRY, read_pose, rubbish
from coview_stream.geometry.arrays import Floats

METRONOME = "bench/metronome"
TICK = 0.1
_AHEAD = 0.5  # seconds between the order to start and the first message

_SPAWN = multiprocessing.get_context("spawn")  # a fork of a process with an open session hangs


def free_port() -> int:
    """Return a loopback port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def open_session(mode: str, connect: Sequence[str] = (), listen: Sequence[str] = ()) -> Any:
    """Open zenoh as a stranger would, but without discovery, and quick to reconnect: the node is what is measured."""
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


class Helper:
    """A process that waits for ``begin``, works, and sends back its result."""

    def __init__(self, work: Callable[..., None], *args: Any) -> None:
        self._ours, theirs = _SPAWN.Pipe()
        self.process: BaseProcess = _SPAWN.Process(target=work, args=(theirs, *args), daemon=True)
        self.process.start()
        theirs.close()

    def ready(self, timeout: float = 120.0) -> None:
        """Wait until it has loaded what it needs."""
        self._receive(timeout)

    def begin(self, at: float | None = None) -> float:
        """Let it start at that monotonic time; returns it."""
        at = time.monotonic() + _AHEAD if at is None else at
        self._ours.send(at)
        return at

    def result(self, timeout: float = 300.0) -> Any:
        """Wait for its result and its end."""
        result = self._receive(timeout)
        self.process.join(10)
        return result

    def ask_to_stop(self) -> None:
        """End the work early; it still sends its result."""
        self._ours.send("stop")

    def kill(self) -> None:
        """SIGKILL."""
        self.process.kill()
        self.process.join(10)

    def _receive(self, timeout: float) -> Any:
        if not self._ours.poll(timeout):
            raise TimeoutError(f"a helper process of the benchmark said nothing for {timeout} s")
        return self._ours.recv()


def route(conn: Connection, port: int) -> None:
    """Be a router until told to stop; tick all the while."""
    with open_session("router", listen=[f"tcp/127.0.0.1:{port}"]) as session:
        publisher = session.declare_publisher(METRONOME, express=True)
        conn.send("ready")
        tick = time.monotonic()
        while not conn.poll(max(0.0, tick - time.monotonic())):
            publisher.put(b"\0" * 400)
            tick += TICK


@dataclass
class Sent:
    """What a sender did: per robot (N, 2) stamps and times of its cloud puts; messages; longest lag and put, s."""

    puts: dict[str, Floats]
    messages: int
    longest_lag: float
    longest_put: float


def send(conn: Connection, endpoint: str, world: str, plans: Sequence[RobotPlan], base: str = "coview") -> None:
    """Stream the plans' robots through one session, on time; every cloud is loaded before."""
    import zenoh

    drives = {plan.robot: Drive(Path(world), plan.robot, plan.frame_seconds) for plan in plans}
    todo = sorted(((due, plan) for plan in plans for due in schedule(plan)), key=lambda item: item[0][0])
    for (_, kind, content, _), plan in todo:
        if kind == "cloud":
            drives[plan.robot].cloud(content, plan.points)
    block = zenoh.CongestionControl.BLOCK
    puts: dict[str, list[tuple[float, float]]] = {plan.robot: [] for plan in plans}
    lag = longest = 0.0
    done = 0
    with open_session("client", connect=[endpoint]) as session:
        conn.send("ready")
        start = float(conn.recv())
        for (due, kind, content, claimed), plan in todo:
            drive, stamp = drives[plan.robot], stamp_of(claimed)
            while (wait := start + due - time.monotonic()) > 0:
                time.sleep(wait)
            if conn.poll():
                break
            if kind == "cloud":
                payload, encoding, attachment = CLOUDS[plan.cloud](drive.cloud(content, plan.points), stamp)
                begin = time.monotonic()
                session.put(f"{base}/{plan.robot}/in/cloud", payload, encoding=encoding, attachment=attachment)
                puts[plan.robot].append((stamp, begin))
            else:
                payload, encoding, _ = ODOMETRY[plan.odometry](drive.T_odom_body(content), stamp)
                begin = time.monotonic()
                session.put(f"{base}/{plan.robot}/in/odom", payload, encoding=encoding, congestion_control=block)
            lag, longest = max(lag, -wait), max(longest, time.monotonic() - begin)
            done += 1
    tables = {robot: np.array(rows, dtype=np.float64).reshape(-1, 2) for robot, rows in puts.items()}
    conn.send(Sent({robot: rows[np.argsort(rows[:, 0])] for robot, rows in tables.items()}, done, lag, longest))


def vandalise(conn: Connection, endpoint: str, robots: Sequence[str], rate: float, base: str = "coview") -> None:
    """Send rubbish to the robots' inputs, ``rate`` messages a second, until told to stop; sends back how many."""
    source = rubbish(7)
    keys = [f"{base}/{robot}/in/{name}" for robot in robots for name in ("cloud", "odom")]
    with open_session("client", connect=[endpoint]) as session:
        conn.send("ready")
        due, count = float(conn.recv()), 0
        while not conn.poll(max(0.0, due - time.monotonic())):
            payload, encoding, attachment = next(source)
            session.put(keys[count % len(keys)], payload, encoding=encoding or None, attachment=attachment)
            count += 1
            due = max(due + 1.0 / rate, time.monotonic() - 0.5)
    conn.send(count)


@dataclass
class Recorder:
    """Everything the robots' outputs said, with the time of its arrival; costs microseconds per message."""

    endpoint: str
    base: str = "coview"
    arrived: list[tuple[float, str, bytes, str]] = field(default_factory=list)
    tokens: list[tuple[float, str, bool]] = field(default_factory=list)
    unreadable: int = 0

    def __enter__(self) -> Recorder:
        import zenoh

        self.session = open_session("client", connect=[self.endpoint])
        direct = zenoh.handlers.Callback(self._record, indirect=False)
        self._held = [self.session.declare_subscriber(key, direct) for key in (f"{self.base}/*/out/*", METRONOME)]
        alive = f"{self.base}/*/alive"
        self._held.append(self.session.liveliness().declare_subscriber(alive, self._token, history=True))
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()

    def _record(self, sample: Any) -> None:
        at = time.monotonic()
        self.arrived.append((at, str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding)))

    def _token(self, sample: Any) -> None:
        import zenoh

        self.tokens.append((time.monotonic(), str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))

    def poses(self, robot: str, begin: float = 0.0, end: float = float("inf")) -> list[Posed]:
        """Poses of a robot that arrived within a period; unreadable ones are counted instead."""
        found = []
        for at, key, payload, encoding in list(self.arrived):
            if key == f"{self.base}/{robot}/out/pose" and begin <= at < end:
                try:
                    found.append(read_pose(payload, encoding, at))
                except (ValueError, KeyError, TypeError) as error:
                    self.unreadable += 1
                    print(f"unreadable pose, {encoding}: {error!r}")
        return found

    def told(self, robot: str, begin: float = 0.0, end: float = float("inf")) -> list[Told]:
        """Statuses of a robot that arrived within a period."""
        key = f"{self.base}/{robot}/out/status"
        rows = [row for row in list(self.arrived) if row[1] == key and begin <= row[0] < end]
        return [Told(at, json.loads(payload)) for at, _, payload, _ in rows]

    def ticks(self, begin: float = 0.0, end: float = float("inf")) -> list[float]:
        """Arrivals of the metronome."""
        return [at for at, key, *_ in list(self.arrived) if key == METRONOME and begin <= at < end]

    def alive(self, robot: str) -> bool:
        """Whether the robot's token is there."""
        known = [put for _, key, put in list(self.tokens) if key == f"{self.base}/{robot}/alive"]
        return bool(known and known[-1])

    def query(self, robot: str, name: str, payload: bytes | None = None, parameters: str = "") -> list[str]:
        """Ask one of the node's procedures; every reply as text, errors with their mark."""
        selector = f"{self.base}/{robot}/rpc/{name}" + (f"?{parameters}" if parameters else "")
        return [
            reply.ok.payload.to_string() if reply.ok else "error: " + reply.err.payload.to_string()
            for reply in self.session.get(selector, payload=payload, timeout=3.0)
        ]


def wait_until(true: Callable[[], bool], seconds: float, every: float = 0.05) -> bool:
    """Wait for a condition; returns whether it came."""
    deadline = time.monotonic() + seconds
    while not true():
        if time.monotonic() > deadline:
            return False
        time.sleep(every)
    return True
