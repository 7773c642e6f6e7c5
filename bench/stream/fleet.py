"""A fleet on one machine: many robots through a router, shared by several nodes, of which one is killed.

The nodes run through the command line, ``serve --fleet``. First all robots are silent, then they send odometry, then a
tenth of them sends clouds as well; the processor time of the nodes in a period gives the cost of a robot. Then a node
is killed. The recorder measures when statuses and poses of its robots come from another one, and every pose is compared
with the truth. A place that is handed on is verified by the robot's next cloud, for which poses wait.
"""

from __future__ import annotations

import contextlib
import itertools
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil

from bench.harness import worlds
from bench.harness.files import folder
from bench.harness.node import Node
from bench.harness.rows import Row, bounded, informs, judged, reached
from bench.stream import scores
from bench.stream.processes import Drive, Helper, Recorder, RobotPlan, free_port, route, send, wait_until
from coview_stream.sim import SimulationConfig

ROBOTS, WITH_CLOUDS, NODES = 300, 30, 2
CLOUD_RATE, ODOMETRY_RATE = 0.5, 2.5  # per second and robot: what two cores can do for all, senders and router too
POINTS = 3000
MAX_GAP = 3.0
"""Target: seconds from a node's death until another one serves its robots."""

_READY, _SETTLE = 180.0, 8.0


def options(parser: ArgumentParser) -> None:
    """Add sizes."""
    parser.add_argument("--robots", type=int, default=ROBOTS, help=f"({ROBOTS})")
    parser.add_argument("--clouds", type=int, default=WITH_CLOUDS, help=f"robots that send clouds ({WITH_CLOUDS})")


def rows(asked: Namespace) -> Iterator[Row]:
    """Play the periods, and yield what was measured."""
    robots, clouds = (60, 6) if asked.quick else (asked.robots, asked.clouds)
    config = SimulationConfig(seed=3101, size=220.0, length=80.0)
    worlds.prepare(folder(), config)
    world, site = folder() / worlds.world_name(config), worlds.map_of(folder(), config)
    names = [f"r{k + 1}" for k in range(robots)]
    port = free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    router = Helper(route, port)
    words = ("--no-state", "--fleet", "bench", "--robot", *names, "--connect", endpoint)
    nodes: list[Node] = []
    with Recorder(endpoint) as recorder:
        try:
            nodes += [Node(site, folder() / f"fleet{k}.log", *words) for k in range(NODES)]
            if not wait_until(lambda: all(map(recorder.alive, names)), _READY):
                raise RuntimeError(f"the nodes did not announce all robots; see {nodes[0].log}")
            time.sleep(_SETTLE)
            yield from _play(recorder, nodes, world, names, clouds, 10.0 if asked.quick else 20.0)
        finally:
            for node in nodes:
                _kill(node)
            router.kill()


def _play(
    recorder: Recorder, nodes: list[Node], world: Path, names: list[str], clouds: int, period: float
) -> Iterator[Row]:
    """Yield the rows of all periods, each of ``period`` seconds; the first ``clouds`` robots send clouds."""
    count, title = len(names), f"fleet/{len(names)} robots"
    silent = _cores(nodes, period)
    blind = RobotPlan("", 3 * period + 50.0, cloud_period=0.0, odometry_period=1.0 / ODOMETRY_RATE, points=POINTS)
    odometry = [replace(blind, robot=name) for name in names[clouds:]]
    seeing = [replace(blind, robot=name, cloud_period=1.0 / CLOUD_RATE) for name in names[:clouds]]
    plain, full = (Helper(send, recorder.endpoint, world, plans) for plans in (odometry, seeing))
    plain.begin()
    time.sleep(3.0)
    driving = _cores(nodes, period)
    begin = full.begin()
    time.sleep(25.0)
    with_clouds = _cores(nodes, period)
    memory = sum(process.memory_full_info().pss for node in nodes for _, process in node.family()) / 1e6 / len(nodes)
    before = {name: recorder.told(name)[-1].fields["node"]["id"] for name in names[:clouds]}
    shares = {node: list(before.values()).count(node) for node in set(before.values())}
    victim = min(shares)
    logs = [node.log.read_text(errors="replace") for node in nodes]
    number = next((k for k, log in enumerate(logs) if f"this node is {victim}" in log), 0)
    killed_at = time.monotonic()
    _kill(nodes.pop(number))
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
    yield Row(f"{title}: those with clouds, on each node", text=" and ".join(map(str, sorted(shares.values()))))
    yield informs(f"{title}: silent, a robot and node", 1e6 * silent / count / NODES, "us/s")
    cost = 1e3 * (driving - silent) / (count - clouds)
    yield informs(f"{title}: odometry {ODOMETRY_RATE:g} Hz, a robot", cost, "ms/s")
    cost = 1e3 * (with_clouds - driving) / (clouds * CLOUD_RATE)
    yield informs(f"{title}: a cloud of {POINTS} points", cost, "ms")
    yield informs(f"{title}: memory of a node, PSS", memory, "MB")
    yield informs(f"{title}: senders behind by, most", 1e3 * lag, "ms")
    yield reached(f"{title}: robots of the killed node posed again", len(found), "", len(orphans))
    yield bounded(f"{title}: served by another one after its death, median", _median(taken), "s", MAX_GAP)
    yield bounded(f"{title}: served by another one after its death, latest", max(taken, default=np.inf), "s", MAX_GAP)
    wait = f"{title}: without poses, a cloud each {1.0 / CLOUD_RATE:g} s"
    yield informs(f"{wait}, median", _median(found), "s")
    yield informs(f"{wait}, longest", max(found, default=np.inf), "s")
    yield judged(f"{title}: false poses", f"{wrong} of {total}", "none", wrong == 0)


def _cores(nodes: Sequence[Node], seconds: float) -> float:
    """Cores that the nodes keep busy together."""

    def spent() -> dict[int, float]:
        out = {}
        for process in (process for node in nodes for _, process in node.family()):
            with contextlib.suppress(psutil.Error):  # it ended in the meantime
                times = process.cpu_times()
                out[process.pid] = times.user + times.system
        return out

    before = spent()
    time.sleep(seconds)
    return sum(after - before[pid] for pid, after in spent().items() if pid in before) / seconds


def _kill(node: Node) -> None:
    """SIGKILL to the node and its engines: the machine is gone."""
    for _, process in node.family():
        with contextlib.suppress(psutil.Error):
            process.kill()


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
