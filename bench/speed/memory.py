"""Memory of ``serve`` with one robot on maps of three sizes, process by process, and what it holds.

Proportional set size, MB: a page that processes share counts for each by its share. A robot of another town drives
first, for which the map is searched without end; then one of the map, until it has been tracked for a while.
``searching`` is the largest sum over the processes, looked at four times a second; ``tracking`` is the last one. The
maps are simulated towns with learned features, as ``build`` makes them by default; the large ones take minutes, once.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import sys
import time
from argparse import ArgumentParser, Namespace
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import psutil

from bench.harness.files import PYTHON, built, environment, fingerprint, folder, remembered
from bench.harness.node import Node
from bench.harness.rows import Row, bounded, informs, table
from bench.harness.worlds import MAPPER, prepared_run
from bench.soak.robots import drive_on
from bench.stream.processes import Helper, Recorder, free_port, route, wait_until
from coview_stream.basemap.site.working_file import working_file
from coview_stream.clouds import Cloud
from coview_stream.clouds.files import read_cloud, write_cloud
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.sim import SimulationConfig

TRACKED_MB, SEARCHED_MB = 350.0, 500.0  # targets, on up to 1 km2
SIDES = {"0.05": 0, "1": 2, "4": 4}  # towns of 500 m along each edge by km2; 0: one of 220 m
_IDLE, _SEARCHES, _TRACKS, _EVERY, _PATIENCE = 10.0, 25.0, 20.0, 0.25, 120.0  # seconds
_SMALL = SimulationConfig("town", seed=9101, size=220.0, length=60.0, density=8.0)
_LARGE = SimulationConfig("town", seed=9103, size=500.0, length=40.0, density=8.0)
_STRANGER = SimulationConfig("town", seed=9102, size=220.0, length=60.0, density=8.0)

CONTENTS = {
    "map": r"\.coview\b",
    "kernels": r"quadrants|taichi|qdcache|ticache",
    "zenoh": r"zenoh",
    "NumPy, SciPy": r"numpy|scipy",
    "packages": r"-packages",
    "interpreter": r"/",
    "heap": r"",
}
"""Pattern of the paths of mappings, the first that is found; the heap is all memory without a file."""

Memory = dict[str, Counter[str]]
"""Bytes of each process by what they hold."""


def options(parser: ArgumentParser) -> None:
    """Add the sizes."""
    parser.add_argument("--km2", nargs="+", choices=list(SIDES), default=list(SIDES), help="maps (all)")


def contents(process: psutil.Process) -> Counter[str]:
    """Return the proportional bytes of a process by :data:`CONTENTS`; those of a process that has ended are none."""
    out, path = Counter[str](), ""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{process.pid}/smaps").read_text().splitlines():
            name, _, rest = line.partition(" ")
            if not name.endswith(":"):
                path = rest.split(maxsplit=4)[4] if len(rest.split(maxsplit=4)) > 4 else ""
            elif name in ("Pss:", "SwapPss:"):
                kind = next(kind for kind, pattern in CONTENTS.items() if re.search(pattern, path))
                out[kind] += 1024 * int(rest.split()[0])
    return out


def memory(node: Node) -> Memory:
    """Return the memory of a node's processes."""
    return {part: contents(process) for part, process in node.family()}


def total(sample: Memory) -> int:
    """Bytes of all processes."""
    return sum(sum(part.values()) for part in sample.values())


def site_of(km2: str) -> tuple[Path, Path]:
    """Return a map of that size and the world of a drive on it; make them unless they are there."""
    side = SIDES[km2]
    if not side:
        world = prepared_run(folder(), _SMALL)
        return built(world / "base.laz", world / "learned.coview"), world
    world, below = prepared_run(folder(), _LARGE), folder() / f"memory{side}"
    made = {"world": _LARGE.to_dict(), "code": fingerprint("coview_stream/sim", *MAPPER)}
    site = below / "site"

    def build() -> None:
        sources = [below / f"{k}.laz" for k in range(side * side)]
        below.mkdir(parents=True, exist_ok=True)
        cloud = read_cloud(world / "base.laz")
        for k, source in enumerate(sources):
            write_cloud(source, *stretched(cloud, k, side))
        words = (*PYTHON, "-m", "coview_stream", "build", *map(str, sources), "-o", f"{site}/", "--workers", "2")
        subprocess.run(words, env=environment(1), check=True, stdout=sys.stderr)

    remembered(below / "built.json", made, build)
    return working_file(site), world


def stretched(cloud: Cloud, number: int, side: int) -> tuple[Floats32, Floats]:
    """Return a town's points and origin as another town's, at its place in a square; the first is the town itself.

    Streets and houses are longer or shorter by up to a fifth, one way and the other, so that no two places look alike.
    """
    scale = np.random.default_rng(number).uniform(0.8, 1.25, 2) if number else np.ones(2)
    points = cloud.points.copy()
    low = points[:, :2].min(axis=0)
    points[:, :2] = low + (points[:, :2] - low) * scale
    points = points[(points[:, :2] - low < _LARGE.size).all(axis=1)]
    shift = _LARGE.size * np.array([number % side, number // side, 0.0])
    return points, cloud.origin + shift


class Observed:
    """A node with one robot, and its memory over time."""

    def __init__(self, site: Path, log: Path) -> None:
        port = free_port()
        self.router = Helper(route, port)
        self.endpoint = f"tcp/127.0.0.1:{port}"
        self.recorder = Recorder(self.endpoint, "coview/*/node/health")
        self.node = Node(site, log, "--no-state", "--robot", "r1", "--connect", self.endpoint)

    def state(self) -> str:
        """Return the robot's newest state."""
        newest = next((row for row in reversed(self.recorder.arrived.copy()) if row[1].endswith("/status")), None)
        return "" if newest is None else str(json.loads(newest[2])["state"])

    def watch(self, seconds: float, until: Callable[[], bool] = lambda: False) -> list[Memory]:
        """Look at the memory until a condition holds, or for some seconds."""
        samples, end = [memory(self.node)], time.monotonic() + seconds
        while time.monotonic() < end and not until():
            time.sleep(_EVERY)
            samples.append(memory(self.node))
        return samples

    def drive(self, world: Path) -> Helper:
        """Let the robot drive in a world."""
        sender = Helper(drive_on, self.endpoint, world, "r1")
        sender.begin()
        return sender

    def close(self) -> None:
        """End all processes."""
        self.node.end()
        self.recorder.session.close()
        self.router.kill()


def measured(site: Path, home: Path, stranger: Path, log: Path) -> dict[str, Memory]:
    """Return the memory of a node by what it does."""
    observed = Observed(site, log)
    try:
        if not wait_until(lambda: bool(observed.state()), _PATIENCE):
            raise TimeoutError(f"the node is not ready: {log}")
        # on the first start a process compiles the kernels
        wait_until(lambda: all(part != "other" for part, _ in observed.node.family()), _PATIENCE)
        out = {"idle": observed.watch(_IDLE)[-1]}
        sender = observed.drive(stranger)
        out["searching"] = max(observed.watch(_SEARCHES), key=total)
        sender.kill()
        time.sleep(6.0)  # the sender's clock begins anew: the node takes that only from a sender that was silent
        sender = observed.drive(home)
        found = observed.watch(_PATIENCE, lambda: observed.state() == "TRACKING")
        out["searching"] = max(out["searching"], *found, key=total)
        out["tracking"] = observed.watch(_TRACKS)[-1]
        if observed.state() != "TRACKING":
            raise RuntimeError(f"the robot is {observed.state()}: {log}")
        sender.kill()
        return out
    finally:
        observed.close()


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield the sum of each doing on each map, with all parts."""
    os.environ.setdefault("COVIEW_CACHE", str(folder() / "cache"))
    stranger = prepared_run(folder(), _STRANGER)
    for km2 in asked.km2[:1] if asked.quick else asked.km2:
        figures = measured(*site_of(km2), stranger, folder() / f"memory{SIDES[km2]}.log")
        for doing, sample in figures.items():
            name, megabytes = f"memory/{km2} km2, {doing}", total(sample) / 1e6
            most = {"tracking": TRACKED_MB, "searching": SEARCHED_MB}.get(doing)
            judged = most is not None and float(km2) <= 1.0
            row = bounded(name, megabytes, "MB", most or 0.0) if judged else informs(name, megabytes, "MB")
            row.details.update(km2=km2, doing=doing, parts={part: dict(counts) for part, counts in sample.items()})
            yield row


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Return a line for each process, and one for all of them."""
    body = []
    for row in rows:
        parts = {part: Counter(counts) for part, counts in row.details["parts"].items()}
        for part, counts in [*parts.items(), ("all", sum(parts.values(), Counter()))]:
            cells = [f"{counts[kind] / 1e6:.0f}" for kind in CONTENTS]
            body.append([row.details["km2"], row.details["doing"], part, f"{counts.total() / 1e6:.0f}", *cells])
    return {"": table(["km2", "robot", "process", "PSS, MB", *CONTENTS], body)}
