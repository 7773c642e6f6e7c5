"""Router, links, nodes, robots and a stranger of a soak, as processes; and the time that passes between them."""

from __future__ import annotations

import contextlib
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from tempfile import mkdtemp
from typing import Any

import psutil

from bench.soak.link import forward
from bench.soak.nodes import Node
from bench.soak.robots import REOPEN, Manner, drive_on
from bench.soak.sites import Site
from bench.soak.stranger import roam
from bench.soak.watch import Robot, Watch
from bench.stream.processes import Helper, free_port, route

_SAMPLED = 10.0  # seconds between two samples of memory
_STEP = 0.1
_SMALL_DISK = "1m"


class Actor(Helper):
    """A process that is told things and may say some."""

    def send(self, told: Any) -> None:
        """Tell it something."""
        self._ours.send(told)

    def said(self) -> bool:
        """Whether it has said something that was not read yet."""
        return self._ours.poll()


class Stage:
    """Everything of a soak; robots reach the router over one link that can go bad, nodes over another."""

    def __init__(self, sites: Sequence[Site], log: Path, seed: int) -> None:
        self.rng = Random(seed)
        self.folder = Path(mkdtemp(prefix="coview-soak."))
        self._helpers: list[Actor] = []
        self._sampled = 0.0
        self.port = free_port()
        self.start_router()
        self.links: dict[str, Actor] = {}
        ports = {name: free_port() for name in ("robots", "nodes")}
        for name, port in ports.items():
            self.links[name] = self._helper(forward, port, self.port, seed)
        here = f"tcp/127.0.0.1:{self.port}"
        over = {name: f"tcp/127.0.0.1:{port}" for name, port in ports.items()}
        self.robots = [Robot(f"r{k + 1}", site) for k, site in enumerate(sites)]
        self.watch = Watch(here, self.robots)
        self.disk = self._small_disk()
        log.mkdir(parents=True, exist_ok=True)
        self.nodes = [self._node(site, over["nodes"], log) for site in dict.fromkeys(sites)]
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
        page = log / f"{site.name}.log"
        page.unlink(missing_ok=True)
        node = Node(site, names, endpoint, copy, (self.disk or self.folder) / site.name, page)
        node.start()
        return node

    def _helper(self, work: Any, *args: Any) -> Actor:
        self._helpers.append(Actor(work, *args))
        return self._helpers[-1]

    def _small_disk(self) -> Path | None:
        """Return a folder on a file system that a fault can fill; None where none may be mounted."""
        disk = self.folder / "disk"
        disk.mkdir()
        mount = ["mount", "-t", "tmpfs", "-o", f"size={_SMALL_DISK}", "tmpfs", str(disk)]
        with contextlib.suppress(OSError):
            if subprocess.run(mount, capture_output=True, check=False).returncode == 0:
                return disk
        return None

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
            robot.set_manner(manner)
            self.senders[robot.name].send(manner)

    def rescue(self) -> None:
        """Start all nodes again, and let all robots open their sessions anew, as an operator would."""
        for node in self.nodes:
            node.end()
            node.start()
        for sender in self.senders.values():
            sender.send(REOPEN)

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Let time pass, in which all is watched; ended early by a condition, which is returned."""
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
            self.watch.close()
        for helper in self._helpers:
            if helper.process.is_alive():
                helper.kill()
        if self.disk is not None:
            subprocess.run(["umount", str(self.disk)], capture_output=True, check=False)
        shutil.rmtree(self.folder, ignore_errors=True)
        return seconds
