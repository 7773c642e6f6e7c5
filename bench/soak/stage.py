"""Router, links, nodes, robots and a stranger of a soak, as processes; and the time that passes between them."""

from __future__ import annotations

import contextlib
import shutil
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random
from subprocess import STDOUT
from tempfile import mkdtemp
from typing import Any, NamedTuple

import numpy as np
import psutil

from bench.harness.files import ROOT, environment
from bench.soak.link import forward
from bench.soak.robots import REOPEN, SIGNED, Manner, Robot, Site, Watch, drive_on
from bench.stream.processes import EPOCH_NS, Helper, free_port, open_session, route, rubbish
from coview_stream.messages import encode_pose
from coview_stream.messages.types import PoseMessage

MAIN, TRACK, SEARCH = "main", "track", "search"
_KINDS = (TRACK, SEARCH, "odometry")
_SAMPLED, _STEP, _GRACE = 10.0, 0.1, 10.0  # seconds: between samples of memory; of waiting; from SIGTERM to SIGKILL
_KEPT = 1000  # samples of a process that a slope is made of


class Sampled(NamedTuple):
    """Anonymous memory of a process, no page of a file, and its open descriptors."""

    at: float
    megabytes: float
    descriptors: int


@dataclass
class Node:
    """``coview-stream serve`` as a process, restarted by hand; ``map`` is its own copy, which faults may damage."""

    site: Site
    robots: Sequence[str]
    endpoint: str
    map: Path
    state: Path
    log: Path
    samples: dict[tuple[str, int], list[Sampled]] = field(default_factory=dict)
    crashes: list[str] = field(default_factory=list)

    def start(self) -> None:
        """Start it; it is not waited for."""
        command = [
            sys.executable, "-P", "-m", "coview_stream", "serve", str(self.map), "--state", str(self.state),
            "--robot", *self.robots, "--connect", self.endpoint,
        ]  # fmt: skip
        with self.log.open("ab") as log:
            self.process = psutil.Popen(command, stdout=log, stderr=STDOUT, env=environment(), cwd=ROOT)

    def revive(self) -> None:
        """Start it again if it ended by itself, which counts as a crash."""
        if self.process.poll() is not None:
            self.crashes.append(f"exit code {self.process.poll()}")
            self.start()

    def family(self) -> dict[str, psutil.Process]:
        """Return its living processes by their part; a zombie is none."""
        parts: dict[str, psutil.Process] = {}
        with contextlib.suppress(psutil.Error):
            if self.process.poll() is None:
                parts[MAIN] = self.process
            for child in self.process.children(recursive=True):
                with contextlib.suppress(psutil.Error):
                    if child.status() != psutil.STATUS_ZOMBIE:
                        words = child.cmdline()
                        parts[next((kind for kind in _KINDS if kind in words), "other")] = child
        return parts

    def send(self, part: str, number: int) -> psutil.Process | None:
        """Send a signal to one of its processes and return that; None if there is none."""
        process = self.family().get(part)
        if process is not None:
            with contextlib.suppress(psutil.Error):
                process.send_signal(number)
        return process

    def sample(self) -> None:
        """Note memory and descriptors of all its processes."""
        at = time.monotonic()
        for part, process in self.family().items():
            with contextlib.suppress(psutil.Error, OSError):
                row = Sampled(at, anonymous(process), process.num_fds())
                self.samples.setdefault((part, process.pid), []).append(row)

    def end(self, number: int = signal.SIGTERM) -> float:
        """End it by a signal; the seconds that took, infinite if it had to be killed after its grace."""
        family, begin = list(self.family().values()), time.monotonic()
        with contextlib.suppress(psutil.Error):
            self.process.send_signal(number)
        try:
            self.process.wait(_GRACE)
            seconds = time.monotonic() - begin
        except psutil.TimeoutExpired:
            seconds = float("inf")
        left = psutil.wait_procs([member for member in family if member.pid != self.process.pid], timeout=_GRACE)[1]
        for process in [*left, self.process]:
            with contextlib.suppress(psutil.Error):
                process.kill()
        if left:
            self.crashes.append(f"{len(left)} engines outlived their node by {_GRACE:.0f} s")
        return seconds


def anonymous(process: psutil.Process) -> float:
    """Megabytes of a process that are of no file, swapped out or not."""
    page = Path(f"/proc/{process.pid}/status")
    if not page.is_file():
        return float(process.memory_full_info().uss / 1e6)
    lines = dict(line.split(":", 1) for line in page.read_text().splitlines() if ":" in line)
    return sum(int(lines[name].split()[0]) * 1024 / 1e6 for name in ("RssAnon", "VmSwap") if name in lines)


def slope(rows: Sequence[Sequence[Sampled]], figure: str, warm: float, apart: float = 300.0) -> float | None:
    """Change per hour of the processes of one part: weighted median over pairs of samples of the same process.

    Pairs are at least ``apart`` seconds apart and weigh their distance; no sample is of the first ``warm`` seconds of
    its process. None without a pair.
    """
    slopes, weights = [np.zeros(0)], [np.zeros(0)]
    for samples in rows:
        kept = [sample for sample in samples if sample.at - samples[0].at >= warm]
        kept = kept[:: 1 + len(kept) // _KEPT]
        at = np.array([sample.at for sample in kept])
        value = np.array([float(getattr(sample, figure)) for sample in kept])
        i, j = np.triu_indices(len(kept), 1)
        far = at[j] - at[i] >= apart if len(kept) else np.zeros(0, bool)
        i, j = i[far], j[far]
        slopes.append((value[j] - value[i]) / (at[j] - at[i]) * 3600)
        weights.append(at[j] - at[i])
    change, weight = np.concatenate(slopes), np.concatenate(weights)
    if not len(change):
        return None
    order = np.argsort(change)
    total = np.cumsum(weight[order])
    return float(change[order][np.searchsorted(total, total[-1] / 2)])


def roam(conn: Connection, endpoint: str, robots: Sequence[str]) -> None:
    """Be a stranger on the network: do the deeds that are received, ``(name, seconds)``, until None."""
    far = np.eye(4)
    far[:3, 3] = 1e5
    message = PoseMessage(EPOCH_NS, robots[0], "TRACKING", far, np.eye(6), 1.0, "0" * 64)
    spoof, source = encode_pose(message, "json"), rubbish(7)
    outputs = [f"coview/{r}/{o}" for r in robots for o in ("out/pose", "out/status", "rpc/reset", "alive")]
    inputs = [f"coview/{robot}/in/{kind}" for robot in robots for kind in ("odom", "cloud")]
    with open_session("client", connect=[endpoint]) as session:
        conn.send("ready")
        while (order := conn.recv()) is not None:
            name, seconds = order
            end, held = time.monotonic() + seconds, []
            with contextlib.suppress(Exception):  # whatever the network does to it
                if name == "claim":
                    held = [session.liveliness().declare_token(f"coview/{robot}/alive") for robot in robots]
                    held.append(session.declare_queryable("coview/*/rpc/*", lambda q: q.reply(q.key_expr, b"\xff")))
                while time.monotonic() < end:
                    if name == "ask":
                        for key in ("**", "coview/**", "*/*/rpc/reset"):
                            list(session.get(key, timeout=2.0))
                    for key in outputs if name == "spoof" else ():
                        session.put(key, spoof.payload, encoding=spoof.encoding, attachment=SIGNED)
                    for key in ("**", *inputs) if name == "delete" else ():
                        session.delete(key, attachment=SIGNED)
                    for key in inputs if name == "flood" else ():
                        trash = next(source)
                        session.put(key, trash.payload, encoding=trash.encoding or None, attachment=trash.attachment)
                    time.sleep(0.02 if name == "flood" else 0.1)
            for declared in held:
                declared.undeclare()
            conn.send(name)


class Actor(Helper):
    """A process that takes orders and may answer."""

    def send(self, order: Any) -> None:
        """Give an order."""
        self._ours.send(order)

    def answered(self) -> bool:
        """Whether an answer was not read yet."""
        return self._ours.poll()


class Stage:
    """All processes of a soak; robots reach the router over one link that can go bad, nodes over another."""

    def __init__(self, sites: Sequence[Site], log: Path, seed: int) -> None:
        self.rng = Random(seed)
        self.folder = Path(mkdtemp(prefix="coview-soak."))
        self._helpers: list[Actor] = []
        self._sampled = 0.0
        self.port = free_port()
        self.start_router()
        ports = {name: free_port() for name in ("robots", "nodes")}
        self.links = {name: self._helper(forward, port, self.port, seed) for name, port in ports.items()}
        here = f"tcp/127.0.0.1:{self.port}"
        over = {name: f"tcp/127.0.0.1:{port}" for name, port in ports.items()}
        self.robots = [Robot(f"r{k + 1}", site) for k, site in enumerate(sites)]
        self.watch = Watch(here, self.robots)
        log.mkdir(parents=True, exist_ok=True)
        self.nodes = [self._node(site, over["nodes"], log / f"{site.name}.log") for site in dict.fromkeys(sites)]
        self.senders = {
            robot.name: self._helper(drive_on, over["robots"], robot.site.world, robot.name) for robot in self.robots
        }
        self.stranger = self._helper(roam, here, [robot.name for robot in self.robots])
        self.manner = Manner()

    def _node(self, site: Site, endpoint: str, log: Path) -> Node:
        names = [robot.name for robot in self.robots if robot.site == site]
        own = self.folder / site.name
        own.mkdir()
        copy = Path(shutil.copy(site.map, own / "site.coview"))
        log.unlink(missing_ok=True)
        node = Node(site, names, endpoint, copy, own, log)
        node.start()
        return node

    def _helper(self, work: Any, *args: Any) -> Actor:
        self._helpers.append(Actor(work, *args))
        return self._helpers[-1]

    def start_router(self) -> None:
        """Start the router; also again, at the same port."""
        self.router = self._helper(route, self.port)

    def begin(self) -> None:
        """Let all robots drive."""
        for robot in self.robots:
            robot.start = self.senders[robot.name].begin()

    def set_manner(self, manner: Manner) -> None:
        """Let all robots send like that from now on."""
        for robot in self.robots:
            if manner not in robot.manners:
                robot.manners.append(manner)
            self.senders[robot.name].send(manner)

    def rescue(self) -> None:
        """Start all nodes again, and let all robots open their sessions anew, as an operator would."""
        for node in self.nodes:
            node.end()
            node.start()
        for sender in self.senders.values():
            sender.send(REOPEN)

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Let time pass while all is watched; a condition ends it early and is returned."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.watch.update()
            if until():
                return True
            if (now := time.monotonic()) - self._sampled > _SAMPLED:
                self._sampled = now
                for node in self.nodes:
                    node.sample()
            time.sleep(max(0.0, min(_STEP, end - time.monotonic())))
        return until()

    def close(self) -> list[float]:
        """End everything; the seconds from SIGTERM to the end of each node."""
        seconds = []
        for node in self.nodes:
            with contextlib.suppress(psutil.Error):
                for process in node.family().values():
                    process.send_signal(signal.SIGCONT)
            seconds.append(node.end())
        with contextlib.suppress(Exception):
            self.watch.session.close()
        for helper in self._helpers:
            if helper.process.is_alive():
                helper.kill()
        shutil.rmtree(self.folder, ignore_errors=True)
        return seconds
