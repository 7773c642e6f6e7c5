"""A fleet on one machine: many robots through a router, shared by several nodes, of which one is killed.

All robots send odometry, a tenth of them clouds as well. The nodes run through the command line, ``serve --fleet``.
First all robots are silent, then they send odometry, then clouds come; the processor time of the nodes in each period
gives what a robot costs. Then a node is killed: when statuses and poses of its robots come from another one is measured
at the recorder, and every pose of all periods is compared with the truth. A place that is handed on is verified by the
robot's next cloud, for which poses wait.
"""

from __future__ import annotations

import itertools
import sys
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path
from subprocess import STDOUT

import numpy as np
import psutil

from bench.harness import worlds
from bench.harness.files import ROOT, environment, folder
from bench.harness.rows import Row, bounded, informs, judged, reached
from bench.stream import scores
from bench.stream.processes import Drive, Helper, Recorder, RobotPlan, free_port, route, send, wait_until
from bench.stream.stage import processor_seconds
from coview_stream.sim import SimulationConfig

ROBOTS, WITH_CLOUDS = 300, 30
CLOUD_RATE, ODOMETRY_RATE = 0.5, 2.5  # per second and robot: what two cores can do for all, senders and router too
POINTS = 3000
MAX_GAP = 3.0
"""Target: seconds from a node's death until another one serves its robots."""

_READY, _SETTLE = 180.0, 8.0


def options(parser: ArgumentParser) -> None:
    """Add sizes."""
    parser.add_argument("--robots", type=int, default=ROBOTS, help=f"({ROBOTS})")
    parser.add_argument("--clouds", type=int, default=WITH_CLOUDS, help=f"robots that send clouds ({WITH_CLOUDS})")
    parser.add_argument("--nodes", type=int, default=2, help="(2)")
    parser.add_argument("--cloud-rate", type=float, default=CLOUD_RATE, help=f"per second and robot ({CLOUD_RATE:g})")
    rate = f"likewise ({ODOMETRY_RATE:g})"
    parser.add_argument("--odometry-rate", type=float, default=ODOMETRY_RATE, help=rate)
    parser.add_argument("--seed", type=int, default=3101, help="of the simulated world (3101)")


class Worker:
    """A node of the fleet."""

    def __init__(self, site: Path, robots: Sequence[str], endpoint: str, log: Path) -> None:
        command = [sys.executable, "-m", "coview_stream", "serve", str(site), "--no-state", "--fleet", "bench"]
        with log.open("wb") as out:
            self.process = psutil.Popen(
                [*command, "--robot", *robots, "--connect", endpoint], stdout=out, stderr=STDOUT, env=environment(),
                cwd=ROOT,
            )  # fmt: skip
        self.log = log

    def family(self) -> list[psutil.Process]:
        """Return the process and its engines."""
        return [self.process, *self.process.children(recursive=True)] if self.process.is_running() else []

    def megabytes(self) -> float:
        """Proportional share of memory, MB."""
        return sum(each.memory_full_info().pss for each in self.family()) / 1e6

    def kill(self) -> None:
        """SIGKILL, to the engines as well: the machine is gone."""
        for each in self.family():
            each.kill()


def rows(asked: Namespace) -> Iterator[Row]:
    """Play the periods, and yield what was measured."""
    robots, clouds = (60, 6) if asked.quick else (asked.robots, asked.clouds)
    config = SimulationConfig(seed=asked.seed, size=220.0, length=80.0)
    worlds.prepare(folder(), config)
    world, site = folder() / worlds.world_name(config), worlds.map_of(folder(), config)
    names = [f"r{k + 1}" for k in range(robots)]
    port = free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    router = Helper(route, port)
    workers: list[Worker] = []
    with Recorder(endpoint) as recorder:
        try:
            workers += [Worker(site, names, endpoint, folder() / f"fleet{k}.log") for k in range(asked.nodes)]
            if not wait_until(lambda: all(map(recorder.alive, names)), _READY):
                raise RuntimeError(f"the nodes did not announce all robots; see {workers[0].log}")
            time.sleep(_SETTLE)
            yield from _play(asked, recorder, workers, world, endpoint, names, clouds)
        finally:
            for each in workers:
                each.kill()
            router.kill()


def _play(
    asked: Namespace,
    recorder: Recorder,
    workers: list[Worker],
    world: Path,
    endpoint: str,
    names: list[str],
    clouds: int,
) -> Iterator[Row]:
    count, period, title = len(names), 10.0 if asked.quick else 20.0, f"fleet/{len(names)} robots"
    silent = _cores(workers, period)
    seconds = 3 * period + 50.0
    odometry = [
        RobotPlan(n, seconds, cloud_period=0.0, odometry_period=1.0 / asked.odometry_rate) for n in names[clouds:]
    ]
    seeing = [
        RobotPlan(
            n, seconds, cloud_period=1.0 / asked.cloud_rate, odometry_period=1.0 / asked.odometry_rate, points=POINTS
        )
        for n in names[:clouds]
    ]
    plain, full = Helper(send, endpoint, world, odometry), Helper(send, endpoint, world, seeing)
    plain.begin()
    time.sleep(3.0)
    driving = _cores(workers, period)
    begin = full.begin()
    time.sleep(25.0)
    with_clouds = _cores(workers, period)
    memory = [each.megabytes() for each in workers]
    before = {name: recorder.told(name)[-1].fields["node"]["id"] for name in names[:clouds]}
    shares = {node: list(before.values()).count(node) for node in set(before.values())}
    victim = min(shares)
    killed_at = _kill(workers, victim)
    time.sleep(12.0)
    orphans = [
        name for name in names[:clouds] if before[name] == victim and recorder.poses(name, killed_at - 1.5, killed_at)
    ]
    gaps = [_gap(recorder, name, killed_at) for name in orphans]
    taken = [_taken_over(recorder, name, victim, killed_at) for name in orphans]
    plain.stop()
    full.stop()
    lag = max(plain.result().longest_lag, full.result().longest_lag)
    wrong = total = 0
    for plan in seeing:
        poses, drive = recorder.poses(plan.robot, begin), Drive(world, plan)
        metres, degrees = scores.errors(poses, drive.truth)
        wrong, total = wrong + scores.false_poses(metres, degrees), total + len(poses)
    found = [gap for gap in gaps if gap is not None]
    rate = clouds * asked.cloud_rate
    each = "a robot"
    said = " and ".join(map(str, sorted(shares.values())))
    yield Row(f"{title}: those with clouds, on each node", text=said)
    yield informs(f"{title}: silent, {each} and node", 1e6 * silent / count / asked.nodes, "us/s")
    yield informs(
        f"{title}: odometry {asked.odometry_rate:g} Hz, {each}", 1e3 * (driving - silent) / (count - clouds), "ms/s"
    )
    yield informs(f"{title}: a cloud of {POINTS} points", 1e3 * (with_clouds - driving) / rate, "ms")
    yield informs(f"{title}: memory of a node, PSS", float(np.mean(memory)), "MB")
    yield informs(f"{title}: senders behind by, most", 1e3 * lag, "ms")
    yield reached(f"{title}: robots of the killed node posed again", len(found), "", len(orphans))
    yield bounded(f"{title}: served by another one after its death, median", _median(taken), "s", MAX_GAP)
    yield bounded(f"{title}: served by another one after its death, latest", max(taken, default=np.inf), "s", MAX_GAP)
    wait = f"{title}: without poses, a cloud each {1.0 / asked.cloud_rate:g} s"
    yield informs(f"{wait}, median", _median(found), "s")
    yield informs(f"{wait}, longest", max(found, default=np.inf), "s")
    yield judged(f"{title}: false poses", f"{wrong} of {total}", "none", wrong == 0)
    yield Row(f"{title}: all numbers", text=f"{len(orphans)} robots moved", details={
        "gaps": gaps, "taken": taken, "shares": shares,
        "statuses": {name: recorder.told(name)[-1].fields for name in names[:clouds]},
    })  # fmt: skip


def _cores(workers: Sequence[Worker], seconds: float) -> float:
    """Cores that the nodes keep busy together."""
    family = [each for worker in workers for each in worker.family()]
    before = processor_seconds(family)
    time.sleep(seconds)
    after = processor_seconds(family)
    return sum(after[pid] - before[pid] for pid in after if pid in before) / seconds


def _kill(workers: list[Worker], victim: str) -> float:
    """Kill the worker of that name, by what it logs of itself; return when."""
    said = f"this node is {victim}"
    number = next((k for k, each in enumerate(workers) if said in each.log.read_text(errors="replace")), 0)
    at = time.monotonic()
    workers.pop(number).kill()
    return at


def _taken_over(recorder: Recorder, name: str, victim: str, since: float) -> float:
    """Seconds until a status of a robot came from another node; infinite if none did."""
    others = (each.arrival for each in recorder.told(name) if each.fields["node"]["id"] != victim)
    return min((arrival - since for arrival in others if arrival > since), default=np.inf)


def _gap(recorder: Recorder, name: str, since: float) -> float | None:
    """Longest time between two poses of a robot around a node's death; None if none came after it."""
    arrivals = [pose.arrival for pose in recorder.poses(name, since - 1.5)]
    if not arrivals or arrivals[-1] < since + 6.0:
        return None
    return max(b - a for a, b in itertools.pairwise(arrivals))


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else np.inf
