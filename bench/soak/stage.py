"""Router, links, nodes and robots of a soak, as processes; and the faults.

A fault acts on all robots, nodes and links. It returns the monotonic time from which robots have to be localized again:
the end of the damage, or the moment of a fault without duration.
"""

from __future__ import annotations

import contextlib
import functools
import shutil
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import pi
from pathlib import Path
from random import Random
from tempfile import mkdtemp
from typing import Any, NamedTuple

import numpy as np
import psutil

from bench.harness.node import GRACE, MAIN, SEARCH, TRACK, Node
from bench.soak.link import forward
from bench.soak.robots import REOPEN, Manner, Robot, Site, Watch, drive_on
from bench.stream.processes import Helper, free_port, route, vandalise

_SAMPLED, _STEP = 10.0, 0.1  # seconds: between samples of memory; of waiting
_MOST = 1000  # samples per process in a slope


class Sampled(NamedTuple):
    """Memory of a process without pages of files, and its open descriptors."""

    at: float
    megabytes: float
    descriptors: int


class SoakNode(Node):
    """A node with samples of its processes and its crashes; it serves a copy of the map, which faults may damage."""

    def __init__(self, site: Site, robots: Sequence[str], endpoint: str, place: Path, log: Path) -> None:
        place.mkdir()
        self.site, self.map = site, Path(shutil.copy(site.map, place / "site.coview"))
        self.samples: dict[tuple[str, int], list[Sampled]] = {}
        self.crashes: list[str] = []
        super().__init__(self.map, log, "--state", str(place), "--robot", *robots, "--connect", endpoint)

    def revive(self) -> None:
        """Count a crash and start the node again if it ended by itself."""
        if self.process.poll() is not None:
            self.crashes.append(f"exit code {self.process.poll()}")
            self.start()

    def sample(self) -> None:
        """Record memory and descriptors of all processes."""
        at = time.monotonic()
        for part, process in self.family():
            with contextlib.suppress(psutil.Error, OSError):
                lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
                memory = sum(int(line.split()[1]) for line in lines if line.startswith(("RssAnon:", "VmSwap:")))
                row = Sampled(at, memory * 1024 / 1e6, process.num_fds())
                self.samples.setdefault((part, process.pid), []).append(row)

    def end(self, number: int = signal.SIGTERM) -> tuple[float, int]:
        """End the node, see :meth:`Node.end`; engines that outlive it are a crash."""
        seconds, left = super().end(number)
        if left:
            self.crashes.append(f"{left} engines outlived their node by {GRACE:.0f} s")
        return seconds, left


def slope(rows: Sequence[Sequence[Sampled]], figure: str, warm: float, apart: float = 300.0) -> float | None:
    """Return the change per hour of one part: the weighted median over pairs of samples of the same process.

    Pairs are at least ``apart`` seconds apart; the weight is that time. The first ``warm`` seconds of a process do not
    count. None without a pair.
    """
    slopes, weights = [np.zeros(0)], [np.zeros(0)]
    for samples in rows:
        counted = [sample for sample in samples if sample.at - samples[0].at >= warm]
        counted = counted[:: 1 + len(counted) // _MOST]
        at, value = (np.array([getattr(sample, name) for sample in counted], float) for name in ("at", figure))
        i, j = np.triu_indices(len(counted), 1)
        time_apart, change = at[j] - at[i], value[j] - value[i]
        far = time_apart >= apart
        slopes.append(change[far] / time_apart[far] * 3600)
        weights.append(time_apart[far])
    change, weight = np.concatenate(slopes), np.concatenate(weights)
    if not len(change):
        return None
    order = np.argsort(change)
    total = np.cumsum(weight[order])
    return float(change[order][np.searchsorted(total, total[-1] / 2)])


class Actor(Helper):
    """A process that takes orders."""

    def send(self, order: Any) -> None:
        """Give an order."""
        self._ours.send(order)


class Stage:
    """All processes of a soak. Robots reach the router over one link, nodes over another; both can go bad."""

    def __init__(self, sites: Sequence[Site], log: Path, seed: int) -> None:
        self.rng = Random(seed)
        self.folder = Path(mkdtemp(prefix="coview-soak."))
        self._helpers: list[Actor] = []
        self._sampled = 0.0
        self.port = free_port()
        self.start_router()
        ports = {name: free_port() for name in ("robots", "nodes")}
        self.links = {name: self.helper(forward, port, self.port, seed) for name, port in ports.items()}
        self.here = f"tcp/127.0.0.1:{self.port}"
        over = {name: f"tcp/127.0.0.1:{port}" for name, port in ports.items()}
        self.robots = [Robot(f"r{k + 1}", site) for k, site in enumerate(sites)]
        self.watch = Watch(self.here, self.robots)
        log.mkdir(parents=True, exist_ok=True)
        self.nodes = []
        for site in dict.fromkeys(sites):
            names = [robot.name for robot in self.robots if robot.site == site]
            place = self.folder / site.name
            self.nodes.append(SoakNode(site, names, over["nodes"], place, log / f"{site.name}.log"))
        self.senders = {
            robot.name: self.helper(drive_on, over["robots"], robot.site.world, robot.name) for robot in self.robots
        }
        self.manner = Manner()

    def helper(self, work: Any, *args: Any) -> Actor:
        """Start a process that ends with the stage."""
        self._helpers.append(Actor(work, *args))
        return self._helpers[-1]

    def start_router(self) -> None:
        """Start the router, or restart it at the same port."""
        self.router = self.helper(route, self.port)

    def begin(self) -> None:
        """Let all robots drive."""
        for robot in self.robots:
            robot.start = self.senders[robot.name].begin()

    def set_manner(self, manner: Manner) -> None:
        """Change how all robots send."""
        for robot in self.robots:
            if manner not in robot.manners:
                robot.manners.append(manner)
            self.senders[robot.name].send(manner)

    def rescue(self) -> None:
        """Restart all nodes and reopen all robots' sessions, as an operator would."""
        for node in self.nodes:
            node.end()
            node.start()
        for sender in self.senders.values():
            sender.send(REOPEN)

    def count(self) -> tuple[int, int]:
        """Return the false or unreadable poses and the crashes so far."""
        false = sum(len(robot.false) + robot.unreadable for robot in self.robots)
        return false, sum(len(node.crashes) for node in self.nodes)

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Wait and watch; end early on a condition, and return it."""
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
        """End everything; return the seconds from SIGTERM to the end of each node."""
        for process in (process for node in self.nodes for _, process in node.family()):
            with contextlib.suppress(psutil.Error):
                process.send_signal(signal.SIGCONT)
        seconds = [node.end()[0] for node in self.nodes]
        with contextlib.suppress(Exception):
            self.watch.session.close()
        for helper in self._helpers:
            if helper.process.is_alive():
                helper.kill()
        shutil.rmtree(self.folder, ignore_errors=True)
        return seconds


def router(stage: Stage) -> float:
    """Kill the router; start it again three seconds later."""
    stage.router.kill()
    stage.wait(3.0)
    stage.start_router()
    return time.monotonic()


def kill(stage: Stage, part: str) -> float:
    """SIGKILL a process of every node; restart a main process at once, as a supervisor would."""
    moment = time.monotonic()
    for node in stage.nodes:
        if part == MAIN:
            node.end(signal.SIGKILL)
            node.start()
        else:
            node.send(part, signal.SIGKILL)
    return moment if part != MAIN else time.monotonic()


def freeze(stage: Stage, part: str, seconds: float = 10.0) -> float:
    """SIGSTOP a process of every node for a while."""
    frozen = [node.send(part, signal.SIGSTOP) for node in stage.nodes]
    stage.wait(seconds)
    for process in frozen:
        if process is not None and process.is_running():
            process.send_signal(signal.SIGCONT)
    return time.monotonic()


def restart(stage: Stage) -> float:
    """End every node with SIGTERM and start it again."""
    for node in stage.nodes:
        seconds, _ = node.end()
        if seconds > 2.0:
            node.crashes.append(f"ended {seconds:.1f} s after SIGTERM")
        node.start()
    return time.monotonic()


def badly(stage: Stage, seconds: float, **changes: object) -> float:
    """Change how all robots send, for some seconds; 0: for good."""
    manner, moment = replace(stage.manner, **changes), time.monotonic()  # type: ignore[arg-type]
    stage.set_manner(manner)
    if not seconds:
        stage.manner = manner
        return moment
    stage.wait(seconds)
    stage.set_manner(stage.manner)
    return time.monotonic()


def jump(stage: Stage) -> float:
    """Move the odometry frame."""
    x, y = stage.rng.uniform(-40, 40), stage.rng.uniform(-40, 40)
    return badly(stage, 0.0, shift=(x, y, stage.rng.uniform(-pi, pi)))


def flood(stage: Stage, seconds: float) -> float:
    """Send rubbish to all inputs."""
    rogues = [stage.helper(vandalise, stage.here, robot.name, 50.0) for robot in stage.robots]
    for rogue in rogues:
        rogue.begin()
    stage.wait(seconds)
    for rogue in rogues:
        rogue.stop()
    return time.monotonic()


def link(stage: Stage, mode: str, seconds: float) -> float:
    """Spoil the link of the robots or of the nodes."""
    name = stage.rng.choice(sorted(stage.links))
    stage.links[name].send(mode)
    stage.wait(seconds)
    stage.links[name].send("open")
    return time.monotonic()


def map_file(stage: Stage, hangup: bool) -> float:
    """Replace every node's map by half of it, or unlink it, then restore it; ``hangup``: send SIGHUP each time."""
    gone = not hangup and stage.rng.random() < 0.5
    for whole in (False, True):
        for node in stage.nodes:
            part = node.map.with_suffix(".new")
            if whole:
                shutil.copy(node.site.map, part)
            else:
                content = node.site.map.read_bytes()
                part.write_bytes(content[: len(content) // 2])
            part.replace(node.map)
            if gone and not whole:
                node.map.unlink()
            if hangup:
                node.send(MAIN, signal.SIGHUP)
        stage.wait(0.0 if whole else 8.0)
    return time.monotonic()


_P = functools.partial

FAULTS: dict[str, Callable[[Stage], float]] = {
    "router killed, back after 3 s": router,
    "tracking engine SIGKILL": _P(kill, part=TRACK),
    "search engine SIGKILL": _P(kill, part=SEARCH),
    "node SIGKILL, started again": _P(kill, part=MAIN),
    "node SIGTERM, started again": restart,
    "tracking engine SIGSTOP 10 s": _P(freeze, part=TRACK),
    "search engine SIGSTOP 10 s": _P(freeze, part=SEARCH),
    "node SIGSTOP 8 s": _P(freeze, part=MAIN, seconds=8.0),
    "no clouds for 10 s": _P(badly, seconds=10.0, clouds=False),
    "no odometry for 5 s": _P(badly, seconds=5.0, odometry=False),
    "odometry jumps": jump,
    "odometry frozen for 8 s": _P(badly, seconds=8.0, frozen=True),
    "stamps in ms for 8 s": _P(badly, seconds=8.0, unit_ns=1_000_000),
    "stamps frozen for 5 s": _P(badly, seconds=5.0, stopped=True),
    "sensor clock steps 1 h ahead": lambda stage: badly(stage, 0.0, offset=stage.manner.offset + 3600.0),
    "sensor clock steps 10 min back": lambda stage: badly(stage, 0.0, offset=stage.manner.offset - 600.0),
    "100 frames a second for 8 s": _P(badly, seconds=8.0, cloud_period=0.01),
    "flood of rubbish for 10 s": _P(flood, seconds=10.0),
    "link cut for 5 s": _P(link, mode="cut", seconds=5.0),
    "link cut every 2 s, 10 s": _P(link, mode="flapping", seconds=10.0),
    "link half-open for 12 s": _P(link, mode="silent", seconds=12.0),
    "link of 200 ms, 10 s": _P(link, mode="slow", seconds=10.0),
    "link of 1 Mbit/s, 10 s": _P(link, mode="thin", seconds=10.0),
    "link that loses 20 %, 10 s": _P(link, mode="lossy", seconds=10.0),
    "map file gone or half": _P(map_file, hangup=False),
    "SIGHUP for half a map, and for the whole": _P(map_file, hangup=True),
}

ENDS_PROCESSES = [name for name in FAULTS if "SIGKILL" in name or "SIGTERM" in name]
"""Faults that end processes of nodes, whose memory cannot be watched any longer."""
