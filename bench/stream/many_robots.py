"""Many robots on one node: eight that are lost on the map, while eight that are elsewhere search without end.

The node runs through the command line and is spoken with over raw zenoh. Each of the eight is first found alone, one
after the other, on the same node; then all sixteen start at once. A robot is starved of searches for as long as its
statuses, which come once a second, show no new search while it drives and is not found.
"""

from __future__ import annotations

import contextlib
import itertools
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import psutil

from bench.harness import worlds
from bench.harness.files import fingerprint, folder, remembered
from bench.harness.rows import Row
from bench.stream import scores
from bench.stream.drive import RobotPlan
from bench.stream.processes import wait_until
from bench.stream.scores import Told
from bench.stream.stage import MAX_JITTER, Findings, Setting, Stage
from coview_stream import BaseMap
from coview_stream.geometry.arrays import Floats
from coview_stream.sim import SimulationConfig

HOME, AWAY = 8, 8  # robots on the map, and off it
POINTS = 16_000  # of every cloud
MAX_DELAY, MAX_STARVATION = 5.0, 3.0
"""Targets, seconds: by how much a robot is found later than alone; without a search."""

_ALONE = 30.0  # seconds in which a robot must be found that is alone
_WARM = 4.0  # seconds after the node's announcement that are its own


def options(parser: ArgumentParser) -> None:
    """Add the world."""
    parser.add_argument("--seed", type=int, default=3101, help="of the simulated world (3101)")


def rows(asked: Namespace) -> Iterator[Row]:
    """Play both phases on one node, in a simulated world, where the node's log stays; see also ``--work``."""
    home, stranger = (SimulationConfig(seed=asked.seed + k, size=220.0, length=80.0 / (1 + k)) for k in (0, 1))
    for config in (home, stranger):
        worlds.prepare(folder(), config)
    main, other = (folder() / worlds.world_name(config) for config in (home, stranger))
    site, made = main / "learned.coview", {"learned": True, "code": fingerprint(*worlds.MAPPER)}
    remembered(main / "learned.json", made, lambda: BaseMap.build(main / "base.laz", learned=True).save(site))
    setting = Setting(main, other, site, asked.quick)
    found = Findings("many")
    names = [f"r{k + 1}" for k in range(HOME + AWAY)]
    with Stage(setting, found, names) as stage:
        time.sleep(_WARM)
        first_fix(stage, names[0])  # in a fresh process; the first alone is measured again
        alone = [first_fix(stage, name) for name in names[: 3 if asked.quick else HOME]]
        found.judge("memory after robots one at a time, MB", stage.megabytes())
        together(stage, alone)
    yield from found.rows
    yield Row("stream/many: all numbers", said=f"{len(names)} robots", details=found.numbers)


def first_fix(stage: Stage, name: str) -> float | None:
    """Seconds until a robot that is alone is found; None if it is not. The node forgets it afterwards."""
    sender = stage.sender(_plan(name, _ALONE))
    start = sender.begin()
    wait_until(lambda: bool(stage.recorder.poses(name, start)), _ALONE)
    poses = stage.recorder.poses(name, start)
    sender.stop()
    sender.result()
    stage.recorder.query(name, "reset")
    time.sleep(1.0)  # in which it is told of its reset, and what is under way ends
    return poses[0].arrival - start if poses else None


def _plan(name: str, seconds: float) -> RobotPlan:
    return RobotPlan(name, seconds, odometry_period=0.05, points=POINTS)


def together(stage: Stage, alone: Sequence[float | None]) -> None:
    """Start all robots at once; ``alone`` are the first fixes of the first few without the others."""
    found, seconds = stage.found, stage.seconds(60.0, 30.0)
    plans = [_plan(name, seconds) for name in stage.robots]
    senders = [stage.sender(*plans[:HOME]), stage.sender(*plans[HOME:], world=stage.setting.stranger)]
    start = senders[0].begin()
    senders[1].begin(start)
    time.sleep(max(0.0, start - time.monotonic()))
    before = processor_seconds(stage.family())
    time.sleep(seconds)
    after = processor_seconds(stage.family())
    memory = stage.megabytes()
    sent = [stage.sent(sender, label) for sender, label in zip(senders, ("home: ", "elsewhere: "), strict=True)]
    measured = [stage.measure(plan, sent[0], start) for plan in plans[:HOME]]
    told = {name: stage.recorder.told(name, start, start + seconds) for name in stage.robots}

    fixes = [row["first_fix_s"] for row in measured]
    found.judge("node alive", stage.running(), "True", stage.running())
    found.judge("robots found", f"{sum(fix is not None for fix in fixes)} of {HOME}", "all", None not in fixes)
    found.judge("first fix alone, s", [fix for fix in alone if fix is not None])
    found.judge("first fix together, s", [fix for fix in fixes if fix is not None])
    pairs = [(a, b) for a, b in zip(alone, fixes, strict=False) if a is not None]
    delays = [np.inf if b is None else b - a for a, b in pairs]
    found.most("found later than alone by, worst, s", max(delays) if delays else None, MAX_DELAY)
    found.judge("found later than alone by, median, s", float(np.median(delays)) if delays else None)

    starved = {name: starvation(rows, start + 2.0) for name, rows in told.items()}
    found.most("longest time without a search, s", max(starved.values()), MAX_STARVATION)
    waits = [rows[-1].fields.get("longest_search_wait_s") for rows in told.values() if rows]
    found.judge("longest wait of a keyframe, the node says, s", max((w for w in waits if w is not None), default=None))
    searches = [scores.counter(told[name], "searches") or 0 for name in stage.robots[HOME:]]
    skipped = [scores.counter(told[name], "searches_skipped") or 0 for name in stage.robots[HOME:]]
    found.judge("elsewhere: searches of keyframes, least / most", (min(searches), max(searches)))
    found.judge("elsewhere: keyframes without a search, least / most", (min(skipped), max(skipped)))
    found.none("elsewhere: poses", sum(len(stage.recorder.poses(name, start)) for name in stage.robots[HOME:]))
    found.none("false poses", sum(row["false"] for row in measured), sum(row["poses"] for row in measured))

    pooled = [intervals(stage, name, start, start + seconds) for name in stage.robots[:HOME]]
    jitter = scores.jitter_ms(np.concatenate(pooled))
    still = jitter is not None and jitter[1] < MAX_JITTER
    found.judge("jitter of all poses p50 / p99, ms", jitter, f"p99 < {MAX_JITTER:.0f}", still)
    p99 = [row["jitter_ms"][1] for row in measured if row["jitter_ms"]]
    found.judge("jitter p99 of a robot, least / most, ms", (min(p99), max(p99)) if p99 else None)
    found.judge("... of the machine itself p50 / p99, ms", measured[0]["machine_jitter_ms"])
    shares = [(scores.counter(told[plan.robot], "processed") or 0) / (10 * seconds) for plan in plans]
    found.judge("frames processed of those sent, least / most", (min(shares), max(shares)))
    busy = [(after[pid] - before[pid]) / seconds for pid in after if pid in before]
    found.judge("cores busy: node / engines", busy)
    found.judge("memory of the node with all, MB", memory)
    found.numbers = {"robots": measured, "starved_s": starved, "alone_s": alone, "cores": busy, "fixes_s": fixes}


def intervals(stage: Stage, name: str, start: float, end: float) -> Floats:
    """Seconds between successive poses of a robot while it was tracked."""
    poses, told = stage.recorder.poses(name, start, end), stage.recorder.told(name, start, end)
    return scores.tracking_intervals([pose.arrival for pose in poses], told)


def starvation(told: Sequence[Told], begin: float) -> float:
    """Longest time between statuses that tell of one more search, of a robot that is not found; from ``begin`` on."""
    longest, since, count = 0.0, begin, 0
    for before, status in itertools.pairwise([Told(begin, {}), *told]):
        searches = (status.fields.get("counters") or {}).get("searches", 0)
        if searches != count or "TRACKING" in (before.state, status.state):
            since, count = max(since, status.arrival), searches
        longest = max(longest, status.arrival - since)
    return longest


def processor_seconds(family: Sequence[psutil.Process]) -> dict[int, float]:
    """User and system time of each process so far, by its id."""
    seconds: dict[int, Any] = {}
    for member in family:
        with contextlib.suppress(psutil.Error):  # it ended in the meantime
            times = member.cpu_times()
            seconds[member.pid] = times.user + times.system
    return seconds
