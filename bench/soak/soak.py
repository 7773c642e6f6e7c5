"""Robots that drive for hours with a fault every minute: false poses, stuck states, time to recover, leaks.

A router, a node per site (``coview-stream serve``) and robots that replay simulated drives without end. Every fault
comes once before any comes again. In a town the robots have to be localized again within 60 s of a fault. On two
deceptive sites (a yard of equal boxes, and one whose containers were all moved) no pose is right. Needs the extra
``bench``.
"""

from __future__ import annotations

import itertools
import math
import sys
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from random import Random

import numpy as np

from bench.harness.files import folder
from bench.harness.rows import Row, judged, table
from bench.soak.robots import KINDS, Robot, prepare
from bench.soak.stage import ENDS_PROCESSES, FAULTS, SoakNode, Stage, slope
from coview_stream.errors import InputError

STUCK = 60.0  # seconds without a pose after a fault, while frames arrive
FIRST_FIX = 90.0  # seconds, on a machine that starts everything at once
WARM = 600.0  # seconds at a process's start that its slope leaves out
MIN_HOURS = 0.25  # a slope over less is no evidence
LEAKS = (("megabytes", 1.0, "MB/h"), ("descriptors", 1.0, "per h"))  # figure, target per hour, unit


@dataclass
class Event:
    """One fault: its start, and the recovery of every robot in the town."""

    fault: str
    begin: float  # seconds since the first robot drove
    recoveries: dict[str, float | None] = field(default_factory=dict)  # seconds; None: not within STUCK
    stuck: list[str] = field(default_factory=list)  # robots that did not recover although frames arrived
    unfed: list[str] = field(default_factory=list)  # robots whose frames did not reach the router
    false: int = 0
    crashes: int = 0

    def text(self) -> str:
        """Describe the fault's outcome."""
        back = [f"{name} {'STUCK' if s is None else f'{s:.1f} s'}" for name, s in self.recoveries.items()]
        marks = [f"{self.false} FALSE"] * bool(self.false) + [f"{self.crashes} CRASHES"] * bool(self.crashes)
        return "; ".join([*(back or ["no robot to localize"]), *marks])


def options(parser: ArgumentParser) -> None:
    """Add duration, robots and faults."""
    parser.add_argument("--minutes", type=float, default=60.0, help="from the first fixes on (60)")
    parser.add_argument("--robots", type=int, default=2, help="in a town, a yard of equal boxes, a rearranged yard ...")
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
    kinds = [KINDS[k % len(KINDS)] for k in range(asked.robots)]
    sites = {kind: prepare(folder(), kind, asked.seed, asked.quick) for kind in dict.fromkeys(kinds)}
    stage = Stage([sites[kind] for kind in kinds], folder() / "soak", asked.seed)
    wanted = [robot for robot in stage.robots if not robot.site.deceptive]
    begin, events, ended = time.monotonic(), list[Event](), list[float]()
    try:
        try:
            stage.wait(120.0, lambda: all(robot.state for robot in stage.robots))
            stage.begin()
            recovered(stage, wanted, time.monotonic(), FIRST_FIX)
            fixes = {robot.name: robot.recovered and round(robot.recovered - robot.start, 1) for robot in wanted}
            text = "; ".join(f"{name} {seconds}" for name, seconds in fixes.items())
            yield Row("soak/first fix, s", text=text, details=fixes)
            begin = time.monotonic()
            stage.wait(min(10.0, asked.every / 3))
            for name in itertools.chain([first], faults):
                events.append(play(stage, wanted, name, begin, asked.every))
                yield Row(f"soak/{len(events)}: {name}", text=events[-1].text(), details=asdict(events[-1]))
                if time.monotonic() > begin + 60 * asked.minutes:
                    break
        except KeyboardInterrupt:
            print("soak: interrupted; the rows so far:", file=sys.stderr)
    finally:
        ended = stage.close()
    hours = (time.monotonic() - begin) / 3600
    for robot in stage.robots:
        yield from figures(robot, hours)
    yield from survived(events)
    yield from processes(stage.nodes, hours)
    yield Row("soak/end after SIGTERM, worst s", max(ended, default=math.nan))


def recovered(stage: Stage, robots: Sequence[Robot], since: float, seconds: float) -> None:
    """Wait until all robots have a pose from a frame after ``since``, at most some seconds."""
    for robot in robots:
        robot.expect(max(since, robot.start))
    stage.wait(seconds, lambda: all(robot.recovered for robot in robots))


def play(stage: Stage, wanted: Sequence[Robot], name: str, start: float, every: float) -> Event:
    """Make one fault; wait until all robots have recovered and the next fault is due."""
    begin, event = time.monotonic(), Event(name, time.monotonic() - start)
    false, crashes = stage.count()
    whole = FAULTS[name](stage)
    recovered(stage, wanted, whole, STUCK)
    for robot in wanted:
        event.recoveries[robot.name] = None if robot.recovered is None else robot.recovered - whole
        if robot.recovered is None:
            (event.stuck if robot.fed(time.monotonic()) else event.unfed).append(robot.name)
    for node in stage.nodes:
        node.revive()
    if event.stuck or event.unfed:  # counted; the next fault needs working robots
        stage.rescue()
        recovered(stage, wanted, time.monotonic(), STUCK)
    stage.wait(max(5.0 if every >= 30 else 1.0, begin + every - time.monotonic()))
    now_false, now_crashes = stage.count()
    event.false, event.crashes = now_false - false, now_crashes - crashes
    return event


def figures(robot: Robot, hours: float) -> Iterator[Row]:
    """Yield poses, false poses and latency of a robot."""
    name = f"soak/{robot.name} ({robot.site.name})"
    details = {"states": dict(robot.states), "false": robot.false[:100], "unreadable": robot.unreadable}
    yield Row(f"{name}: poses", robot.poses, text=f"{robot.poses} in {hours:.2f} h", details=details)
    wrong = len(robot.false) + robot.unreadable
    yield judged(f"{name}: false or unreadable poses", f"{wrong} of {robot.poses}", "0", wrong == 0, wrong)
    yield Row(f"{name}: worst pose, m / degrees", text=f"{robot.worst[0]:.2f} / {robot.worst[1]:.2f}")
    if robot.latencies:
        parts = np.percentile(1e3 * np.array(robot.latencies), (50, 95, 99))
        yield Row(f"{name}: cloud to pose p50 / p95 / p99, ms", text=" / ".join(f"{part:.0f}" for part in parts))


def survived(events: Sequence[Event]) -> Iterator[Row]:
    """Yield the faults, and the robots that did not recover."""
    times = [seconds for event in events for seconds in event.recoveries.values() if seconds is not None]
    stuck, unfed = (sum(len(getattr(event, name)) for event in events) for name in ("stuck", "unfed"))
    yield Row("soak/faults", len(events), text=f"{len(events)} of {len({event.fault for event in events})} kinds")
    if times:
        yield Row("soak/back after, median / worst s", text=f"{np.median(times):.1f} / {max(times):.1f}")
    yield judged("soak/stuck for 60 s while frames came", f"{stuck} of {len(times) + stuck}", "0", stuck == 0, stuck)
    yield Row("soak/robots of the bench that did not reach the router again", float(unfed))


def processes(nodes: Sequence[SoakNode], hours: float) -> Iterator[Row]:
    """Yield crashes, and the growth of memory and descriptors of all nodes' processes."""
    crashes = [f"{node.site.name}: {crash}" for node in nodes for crash in node.crashes]
    text = "; ".join(crashes) or "0"
    yield judged("soak/ended by themselves, or not when asked", text, "0", not crashes, len(crashes))
    logs = (node.log.read_text(errors="replace") for node in nodes)
    traces = sum(log.count("Traceback (most recent call last)") for log in logs)
    yield judged("soak/tracebacks in logs", str(traces), "0", traces == 0, traces)
    for node in nodes:
        parts = sorted({part for part, _ in node.samples})
        for figure, most, unit in LEAKS:
            slopes = {p: slope([s for (of, _), s in node.samples.items() if of == p], figure, WARM) for p in parts}
            known = [value for value in slopes.values() if value is not None]
            total = sum(known) if known else math.nan
            text = "; ".join(f"{part} {'-' if value is None else f'{value:+.2f}'}" for part, value in slopes.items())
            long = hours >= MIN_HOURS and bool(known)
            yield judged(
                f"soak/{node.site.name}: {figure} of its processes, slope after 10 min",
                f"{total:+.2f} {unit} ({text})" if known else "-",
                f"< {most:g} {unit}" if long else "", total < most if long else None, total,
            )  # fmt: skip
        last = {part: samples[-1].megabytes for (part, _), samples in node.samples.items()}
        yield Row(f"soak/{node.site.name}: memory of its own at the end, MB", sum(last.values()), details=last)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Return one table: a line per kind of fault."""
    events = [row.details for row in rows if "recoveries" in row.details]
    body = []
    for name in sorted({event["fault"] for event in events}):
        played = [event for event in events if event["fault"] == name]
        times = [s for event in played for s in event["recoveries"].values() if s is not None]
        lost = sum(len(event["stuck"]) + len(event["unfed"]) + event["crashes"] > 0 for event in played)
        spent = [f"{np.median(times):.1f}", f"{max(times):.1f}"] if times else ["-", "-"]
        false = str(sum(event["false"] for event in played))
        body.append([name, str(len(played)), str(len(played) - lost), *spent, false])
    return {"": table(["fault", "times", "survived", "back after, median s", "worst s", "false poses"], body)}
