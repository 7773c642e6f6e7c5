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
from collections import Counter
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
    """Play the periods, and yield their figures."""
    robots, clouds = (60, 6) if asked.quick else (asked.robots, asked.clouds)
    config = SimulationConfig(seed=3101, size=220.0, length=80.0)
    world, site = worlds.prepare(folder(), config), worlds.map_of(folder(), config)
    names = [f"r{k + 1}" for k in range(robots)]
    port = free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    router = Helper(route, port)
    words = ("--no-state", "--fleet", "bench", "--robot", *names, "--connect", endpoint)
    recorder = Recorder(endpoint)
    nodes: list[Node] = []
    try:
        nodes += [Node(site, folder() / f"fleet{k}.log", *words) for k in range(NODES)]
        if not wait_until(lambda: all(map(recorder.alive, names)), _READY):
            raise RuntimeError(f"the nodes did not announce all robots; see {nodes[0].log}")
        time.sleep(_SETTLE)
        yield from _play(recorder, nodes, world, names, clouds, 10.0 if asked.quick else 20.0)
    finally:
        for node in nodes:
            _kill(node)
        recorder.session.close()
        router.kill()


def _play(
    recorder: Recorder, nodes: list[Node], world: Path, names: list[str], clouds: int, period: float
) -> Iterator[Row]:
    """Yield the rows of all periods, each of ``period`` seconds; the first ``clouds`` robots send clouds."""
    count, title = len(names), f"fleet/{len(names)} robots"
    silent = _cores(nodes, period)
    yield informs(f"{title}: silent, a robot and node", 1e6 * silent / count / NODES, "us/s")
    blind = RobotPlan("", 3 * period + 50.0, cloud_period=0.0, odometry_period=1.0 / ODOMETRY_RATE, points=POINTS)
    odometry = [replace(blind, robot=name) for name in names[clouds:]]
    seeing = [replace(blind, robot=name, cloud_period=1.0 / CLOUD_RATE) for name in names[:clouds]]
    plain, full = (Helper(send, recorder.endpoint, world, plans) for plans in (odometry, seeing))
    plain.begin()
    time.sleep(3.0)
    driving = _cores(nodes, period)
    cost = 1e3 * (driving - silent) / (count - clouds)
    yield informs(f"{title}: odometry {ODOMETRY_RATE:g} Hz, a robot", cost, "ms/s")
    begin = full.begin()
    time.sleep(25.0)
    cost = 1e3 * (_cores(nodes, period) - driving) / (clouds * CLOUD_RATE)
    yield informs(f"{title}: a cloud of {POINTS} points", cost, "ms")
    memory = sum(process.memory_full_info().pss for node in nodes for _, process in node.family()) / 1e6 / len(nodes)
    yield informs(f"{title}: memory of a node, PSS", memory, "MB")

    servers = {name: recorder.told(name)[-1].fields["node"]["id"] for name in names[:clouds]}
    victim = Counter(servers.values()).most_common()[-1][0]
    logs = [node.log.read_text(errors="replace") for node in nodes]
    number = next((k for k, log in enumerate(logs) if f"this node is {victim}" in log), 0)
    death = time.monotonic()
    _kill(nodes.pop(number))
    time.sleep(12.0)
    orphans = [name for name in servers if servers[name] == victim and recorder.poses(name, death - 1.5, death)]
    taken, gaps = [], []
    for name in orphans:
        told = recorder.told(name, death)
        taken.append(min((s.arrival - death for s in told if s.fields["node"]["id"] != victim), default=np.inf))
        arrivals = [pose.arrival for pose in recorder.poses(name, death - 1.5)]
        if arrivals[-1] > death + 6.0:
            gaps.append(max(b - a for a, b in itertools.pairwise(arrivals)))
    yield reached(f"{title}: robots of the killed node posed again", len(gaps), "", len(orphans))
    yield bounded(f"{title}: served by another one, latest", max(taken, default=np.inf), "s", MAX_GAP)
    wait = f"{title}: without poses, a cloud each {1.0 / CLOUD_RATE:g} s"
    yield informs(f"{wait}, median", float(np.median(gaps or [np.inf])), "s")
    yield informs(f"{wait}, longest", max(gaps, default=np.inf), "s")

    for sender in (plain, full):
        sender.send("stop")
    lag = max(plain.result().longest_lag, full.result().longest_lag)
    yield informs(f"{title}: senders behind by, most", 1e3 * lag, "ms")
    wrong = total = 0
    for plan in seeing:
        poses = recorder.poses(plan.robot, begin)
        wrong += scores.false_poses(*scores.errors(poses, Drive(world, plan).truth))
        total += len(poses)
    yield judged(f"{title}: false poses", f"{wrong} of {total}", "none", wrong == 0)


def _cores(nodes: Sequence[Node], seconds: float) -> float:
    """Return the number of cores that the nodes keep busy together."""

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
    """Send SIGKILL to the node and its engines: the machine is gone."""
    for _, process in node.family():
        with contextlib.suppress(psutil.Error):
            process.kill()
