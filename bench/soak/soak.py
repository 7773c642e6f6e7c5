"""Robots that drive for hours with a fault every minute: false poses, stuck states, time to recover, leaks.

A router, a node (``coview-stream serve``) and robots that replay simulated drives without end. Every fault comes once
before any comes again. Robots in the town of the map have to be localized again within 60 s of a fault; every other
robot drives in another town, where no pose is right. Needs the extra ``bench``.
"""

from __future__ import annotations

import itertools
import math
import sys
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from dataclasses import replace
from random import Random
from typing import Any

import numpy as np

from bench.harness.files import folder
from bench.harness.rows import Row, bounded, informs, judged, table
from bench.harness.worlds import map_of, prepare, prepared_run
from bench.soak.robots import Robot
from bench.soak.stage import ENDS_PROCESSES, FAULTS, Stage, slope
from coview_stream.errors import InputError
from coview_stream.sim import SimulationConfig

STUCK = 60.0  # seconds without a pose after a fault, while frames arrive
FIRST_FIX = 90.0  # seconds, on a machine that starts everything at once
WARM = 600.0  # seconds at a process's start that its slope leaves out
FED = 2.0  # seconds without odometry at the router after which a robot counts as disconnected
MIN_HOURS = 0.25  # a slope over less is no evidence
LEAKS = (("megabytes", 1.0, "MB/h"), ("descriptors", 1.0, "per h"))  # figure, target per hour, unit


def options(parser: ArgumentParser) -> None:
    """Add duration, robots and faults."""
    parser.add_argument("--minutes", type=float, default=60.0, help="from the first fixes on (60)")
    parser.add_argument("--robots", type=int, default=2, help="on the map and elsewhere, in turns (2)")
    parser.add_argument("--every", type=float, default=60.0, metavar="S", help="seconds from fault to fault (60)")
    parser.add_argument("--seed", type=int, default=3101, help="of worlds and faults (3101)")
    parser.add_argument("--faults", nargs="+", metavar="WORD", default=[], help="only those whose names have a word")


def chosen(words: Sequence[str], seed: int) -> Iterator[str]:
    """Yield names of faults without end, in random order, each once per round.

    Every other round, from the second on, ends no process of a node: leaks show only in old processes.
    """
    names = [name for name in FAULTS if not words or any(word in name for word in words)]
    if not names:
        raise InputError(f"--faults {' '.join(words)}: no fault is called so; there are {', '.join(FAULTS)}")
    rng = Random(seed)
    while True:
        yield from rng.sample(names, len(names))
        gentle = [name for name in names if name not in ENDS_PROCESSES]
        yield from rng.sample(gentle, len(gentle))


def rows(asked: Namespace) -> Iterator[Row]:
    """Run the soak; yield the events, then the summary, also after an interruption."""
    faults = chosen(asked.faults, asked.seed)
    first = next(faults)
    if asked.robots < 1:
        raise InputError(f"--robots {asked.robots}: at least one")
    home = SimulationConfig(seed=asked.seed, size=220.0, length=80.0)
    if asked.quick:
        home = replace(home, size=140.0, length=30.0, density=10.0)
    towns = [prepare(folder(), home), prepared_run(folder(), replace(home, seed=home.seed + 1))]
    robots = [Robot(f"r{k + 1}", towns[k % 2], elsewhere=k % 2 == 1) for k in range(asked.robots)]
    stage = Stage(map_of(folder(), home), robots, folder() / "soak.log", asked.seed)
    wanted = [robot for robot in robots if not robot.elsewhere]
    begin, events = time.monotonic(), list[dict[str, Any]]()
    try:
        stage.wait(120.0, lambda: all(robot.state for robot in robots))
        stage.begin()
        recovered(stage, wanted, time.monotonic(), FIRST_FIX)
        fixes = {robot.name: robot.recovered and round(robot.recovered - robot.start, 1) for robot in wanted}
        text = "; ".join(f"{name} {seconds}" for name, seconds in fixes.items())
        yield Row("soak/first fix, s", text=text, details=fixes)
        begin = time.monotonic()
        stage.wait(min(10.0, asked.every / 3))
        for name in itertools.chain([first], faults):
            event = play(stage, wanted, name, begin, asked.every)
            events.append(event)
            times = (f"{name} {'STUCK' if s is None else f'{s:.1f} s'}" for name, s in event["recoveries"].items())
            text = "; ".join((*times, f"{event['false']} false, {event['crashes']} crashes"))
            yield Row(f"soak/{len(events)}: {name}", text=text, details=event)
            if time.monotonic() > begin + 60 * asked.minutes:
                break
    except KeyboardInterrupt:
        print("soak: interrupted; the rows so far:", file=sys.stderr)
    finally:
        ended = stage.close()
    hours = (time.monotonic() - begin) / 3600
    for robot in robots:
        yield from figures(robot, hours)
    unfed = sum(len(event["unfed"]) for event in events)
    stuck = sum(s is None for event in events for s in event["recoveries"].values()) - unfed
    text = f"{stuck} of {len(events) * len(wanted)}"
    yield judged("soak/stuck for 60 s while frames came", text, "0", stuck == 0, stuck)
    yield informs("soak/robots of the bench that did not reach the router again", unfed, "")
    yield from processes(stage, hours)
    yield informs("soak/end after SIGTERM, worst", ended, "s")


def recovered(stage: Stage, robots: Sequence[Robot], since: float, seconds: float) -> None:
    """Wait until all robots have a pose from a frame after ``since``, at most some seconds."""
    for robot in robots:
        robot.expect(max(since, robot.start))
    stage.wait(seconds, lambda: all(robot.recovered for robot in robots))


def play(stage: Stage, wanted: Sequence[Robot], name: str, start: float, every: float) -> dict[str, Any]:
    """Make one fault; wait until all robots have recovered and the next fault is due; return the outcome."""
    begin = time.monotonic()
    false, crashes = count(stage)
    whole = FAULTS[name](stage)
    recovered(stage, wanted, whole, STUCK)
    seconds = {robot.name: robot.recovered and robot.recovered - whole for robot in wanted}
    unfed = [robot.name for robot in wanted if not robot.recovered and time.monotonic() > robot.fed + FED]
    stage.revive()
    if None in seconds.values():  # counted; the next fault needs working robots
        stage.rescue()
        recovered(stage, wanted, time.monotonic(), STUCK)
    stage.wait(max(5.0 if every >= 30 else 1.0, begin + every - time.monotonic()))
    now = count(stage)
    outcome = {"recoveries": seconds, "unfed": unfed, "false": now[0] - false, "crashes": now[1] - crashes}
    return {"fault": name, "begin": begin - start, **outcome}


def count(stage: Stage) -> tuple[int, int]:
    """Return the false or unreadable poses and the crashes so far."""
    return sum(len(robot.false) + robot.unreadable for robot in stage.robots), len(stage.crashes)


def figures(robot: Robot, hours: float) -> Iterator[Row]:
    """Yield false poses and latency of a robot."""
    name, wrong = f"soak/{robot.name}{', elsewhere' * robot.elsewhere}", len(robot.false) + robot.unreadable
    figures = {"states": dict(robot.states), "false": robot.false[:100], "hours": hours}
    row = judged(f"{name}: false or unreadable poses", f"{wrong} of {robot.poses}", "0", wrong == 0, wrong)
    yield replace(row, details=figures)
    if robot.latencies:
        parts = np.percentile(1e3 * np.array(robot.latencies), (50, 95, 99))
        yield Row(f"{name}: cloud to pose p50 / p95 / p99, ms", text=" / ".join(f"{part:.0f}" for part in parts))


def processes(stage: Stage, hours: float) -> Iterator[Row]:
    """Yield crashes, and the growth of memory and descriptors of the node's processes."""
    crashes = "; ".join(stage.crashes) or "0"
    yield judged("soak/ended by itself, or not when asked", crashes, "0", not stage.crashes, len(stage.crashes))
    traces = stage.node.log.read_text(errors="replace").count("Traceback (most recent call last)")
    yield judged("soak/tracebacks in the log", str(traces), "0", traces == 0, traces)
    for figure, most, unit in LEAKS:
        slopes = {}
        for part in sorted({part for part, _ in stage.samples}):
            change = slope([samples for (of, _), samples in stage.samples.items() if of == part], figure, WARM)
            if change is not None:
                slopes[part] = change
        name = f"soak/{figure} of all processes, slope after 10 min"
        total = sum(slopes.values()) if slopes else math.nan
        row = bounded(name, total, unit, most) if slopes and hours >= MIN_HOURS else informs(name, total, unit)
        yield replace(row, details=slopes)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Return one table: a line per kind of fault."""
    events = [row.details for row in rows if "recoveries" in row.details]
    body = []
    for name in sorted({event["fault"] for event in events}):
        played = [event for event in events if event["fault"] == name]
        times = [s for event in played for s in event["recoveries"].values() if s is not None]
        lost = sum(None in event["recoveries"].values() or event["crashes"] > 0 for event in played)
        spent = [f"{np.median(times):.1f}", f"{max(times):.1f}"] if times else ["-", "-"]
        false = str(sum(event["false"] for event in played))
        body.append([name, str(len(played)), str(len(played) - lost), *spent, false])
    return {"": table(["fault", "times", "survived", "back after, median s", "worst s", "false poses"], body)}
