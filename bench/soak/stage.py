"""Router, links, node and robots of a soak, as processes; and the faults.

A fault acts on all robots. It returns the monotonic time from which robots have to be localized again: the end of the
damage, or the moment of a fault without duration.
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
from scipy.stats import theilslopes

from bench.harness.node import GRACE, MAIN, SEARCH, TRACK, Node
from bench.soak.link import forward
from bench.soak.robots import REOPEN, Manner, Robot, drive_on
from bench.stream.processes import Helper, Recorder, free_port, route
from coview_stream.messages.types import Sample

_SAMPLED, _STEP = 30.0, 0.1  # seconds: between samples of memory; of waiting


class Sampled(NamedTuple):
    """Memory of a process without pages of files, and its open descriptors."""

    at: float
    megabytes: float
    descriptors: int


def slope(processes: Sequence[Sequence[Sampled]], figure: str, warm: float, least: float = 300.0) -> float | None:
    """Return the change per hour of one part: Theil and Sen's slope of each process, weighted by its time.

    The first ``warm`` seconds of a process do not count. None if no process was watched for ``least`` seconds more.
    """
    slopes, weights = [], []
    for samples in processes:
        late = [sample for sample in samples if sample.at - samples[0].at >= warm]
        if late and late[-1].at - late[0].at >= least:
            values, times = [getattr(sample, figure) for sample in late], [sample.at / 3600 for sample in late]
            slopes.append(theilslopes(values, times)[0])
            weights.append(times[-1] - times[0])
    return float(np.average(slopes, weights=weights)) if slopes else None


class Stage:
    """All processes of a soak. Robots reach the router over one link, the node over another; both can go bad."""

    def __init__(self, site: Path, robots: Sequence[Robot], log: Path, seed: int) -> None:
        self.site, self.robots, self.rng, self.manner = site, robots, Random(seed), Manner()
        self.crashes: list[str] = []
        self.samples: dict[tuple[str, int], list[Sampled]] = {}  # of each part and process
        self.folder = Path(mkdtemp(prefix="coview-soak."))
        self._helpers: list[Helper] = []
        self._sampled = 0.0
        self._port = free_port()
        self.start_router()
        ports = {name: free_port() for name in ("robots", "node")}
        self.links = {name: self._helper(forward, port, self._port, seed) for name, port in ports.items()}
        over = {name: f"tcp/127.0.0.1:{port}" for name, port in ports.items()}
        self.recorder = Recorder(f"tcp/127.0.0.1:{self._port}", "coview/*/in/odom")
        self.map = Path(shutil.copy(site, self.folder / "site.coview"))  # a fault damages it
        names = [robot.name for robot in robots]
        words = ("--state", str(self.folder), "--robot", *names, "--connect", over["node"])
        self.node = Node(self.map, log, *words)
        self.senders = [self._helper(drive_on, over["robots"], robot.world, robot.name) for robot in robots]

    def _helper(self, work: Any, *args: Any) -> Helper:
        self._helpers.append(Helper(work, *args))
        return self._helpers[-1]

    def start_router(self) -> None:
        """Start the router, or restart it at the same port."""
        self.router = self._helper(route, self._port)

    def begin(self) -> None:
        """Let all robots drive."""
        for robot, sender in zip(self.robots, self.senders, strict=True):
            robot.start = sender.begin()

    def order(self, order: Any) -> None:
        """Give all robots an order."""
        for sender in self.senders:
            sender.send(order)

    def end_node(self, number: int = signal.SIGTERM) -> float:
        """End the node by a signal; return the seconds until it ended. Engines that outlive it are a crash."""
        seconds, left = self.node.end(number)
        if left:
            self.crashes.append(f"{left} engines outlived their node by {GRACE:.0f} s")
        return seconds

    def revive(self) -> None:
        """Count a crash and start the node again if it ended by itself."""
        if self.node.process.poll() is not None:
            self.crashes.append(f"exit code {self.node.process.poll()}")
            self.node.start()

    def rescue(self) -> None:
        """Restart the node and reopen all robots' sessions, as an operator would."""
        self.end_node()
        self.node.start()
        self.order(REOPEN)

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Wait and watch; end early on a condition."""
        end, robots = time.monotonic() + seconds, {robot.name: robot for robot in self.robots}
        while time.monotonic() < end and not until():
            if time.monotonic() > self._sampled + _SAMPLED:
                self._sample()
            time.sleep(max(0.0, min(_STEP, end - time.monotonic())))
            while self.recorder.arrived:
                at, key, payload, encoding = self.recorder.arrived.popleft()
                if (robot := robots.get(key.split("/")[1])) is not None:
                    robot.take(at, Sample(key, payload, encoding))

    def _sample(self) -> None:
        """Record memory and descriptors of the node's processes."""
        self._sampled = time.monotonic()
        for part, process in self.node.family():
            with contextlib.suppress(psutil.Error, OSError):
                lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
                memory = sum(int(line.split()[1]) for line in lines if line.startswith(("RssAnon:", "VmSwap:")))
                row = Sampled(self._sampled, memory * 1024 / 1e6, process.num_fds())
                self.samples.setdefault((part, process.pid), []).append(row)

    def close(self) -> float:
        """End everything; return the seconds from SIGTERM to the end of the node."""
        for _, process in self.node.family():
            with contextlib.suppress(psutil.Error):
                process.send_signal(signal.SIGCONT)
        seconds = self.end_node()
        with contextlib.suppress(Exception):
            self.recorder.session.close()
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


def restart(stage: Stage, number: int) -> float:
    """End the node by a signal and start it again, as a supervisor would."""
    seconds = stage.end_node(number)
    if seconds > 2.0:
        stage.crashes.append(f"ended {seconds:.1f} s after signal {number}")
    stage.node.start()
    return time.monotonic()


def strike(stage: Stage, part: str, number: int, seconds: float = 0.0) -> float:
    """Send a signal to a process of the node, and SIGCONT after some seconds."""
    process = stage.node.send(part, number)
    stage.wait(seconds)
    if process is not None:
        with contextlib.suppress(psutil.Error):  # it has ended
            process.send_signal(signal.SIGCONT)
    return time.monotonic()


def badly(stage: Stage, seconds: float, **changes: object) -> float:
    """Change how all robots send for some seconds."""
    stage.order(replace(stage.manner, **changes))  # type: ignore[arg-type]  # its callers' names
    stage.wait(seconds)
    stage.order(stage.manner)
    return time.monotonic()


def jump(stage: Stage) -> float:
    """Move the odometry frame for good."""
    x, y = stage.rng.uniform(-40, 40), stage.rng.uniform(-40, 40)
    stage.manner = Manner(shift=(x, y, stage.rng.uniform(-pi, pi)))
    stage.order(stage.manner)
    return time.monotonic()


def link(stage: Stage, mode: str, seconds: float) -> float:
    """Spoil the link of the robots or of the node."""
    name = stage.rng.choice(sorted(stage.links))
    stage.links[name].send(mode)
    stage.wait(seconds)
    stage.links[name].send("open")
    return time.monotonic()


def map_file(stage: Stage) -> float:
    """Replace the node's map by half of it, then by the whole, with SIGHUP each time."""
    content, part = stage.site.read_bytes(), stage.map.with_suffix(".new")
    for size in (len(content) // 2, len(content)):
        part.write_bytes(content[:size])
        part.replace(stage.map)
        stage.node.send(MAIN, signal.SIGHUP)
        stage.wait(8.0 if size < len(content) else 0.0)
    return time.monotonic()


_P = functools.partial

FAULTS: dict[str, Callable[[Stage], float]] = {
    "router killed, back after 3 s": router,
    "tracking engine SIGKILL": _P(strike, part=TRACK, number=signal.SIGKILL),
    "search engine SIGKILL": _P(strike, part=SEARCH, number=signal.SIGKILL),
    "node SIGKILL, started again": _P(restart, number=signal.SIGKILL),
    "node SIGTERM, started again": _P(restart, number=signal.SIGTERM),
    "tracking engine SIGSTOP 10 s": _P(strike, part=TRACK, number=signal.SIGSTOP, seconds=10.0),
    "node SIGSTOP 8 s": _P(strike, part=MAIN, number=signal.SIGSTOP, seconds=8.0),
    "no clouds for 10 s": _P(badly, seconds=10.0, clouds=False),
    "no odometry for 5 s": _P(badly, seconds=5.0, odometry=False),
    "odometry jumps": jump,
    "odometry frozen for 8 s": _P(badly, seconds=8.0, frozen=True),
    "100 frames a second for 8 s": _P(badly, seconds=8.0, cloud_period=0.01),
    "link cut for 5 s": _P(link, mode="cut", seconds=5.0),
    "link half-open for 12 s": _P(link, mode="silent", seconds=12.0),
    "link of 200 ms, 10 s": _P(link, mode="slow", seconds=10.0),
    "link of 1 Mbit/s, 10 s": _P(link, mode="thin", seconds=10.0),
    "SIGHUP for half a map, and for the whole": map_file,
}

ENDS_PROCESSES = [name for name in FAULTS if "SIGKILL" in name or "SIGTERM" in name]
"""Faults that end processes of the node, whose memory cannot be watched any longer."""
