"""Robots that drive for hours while something goes wrong every minute: what holds, how soon it is back, what leaks.

A router, a node for each site (through the command line), robots that replay simulated drives for ever, and a fault
drawn from the whole matrix, each kind once before any comes again. Robots drive in a town, in which they have to be
found again within 60 s of a fault, and in deceptive sites, in which no pose is a right answer and a false one is not:
a yard of equal boxes, and one whose containers were all moved. Rows are kept after every fault (--json). Needs the
extra ``bench``.
"""

from __future__ import annotations

import itertools
import json
import sys
import time
import traceback
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from random import Random
from typing import Any

import numpy as np

from bench.harness.files import fingerprint, folder
from bench.harness.rows import Row, table
from bench.soak import figures
from bench.soak.faults import FAULTS, SkippedError
from bench.soak.sites import KINDS, prepare
from bench.soak.stage import Stage
from coview_stream.clouds.atomic_file import atomic_path
from coview_stream.errors import InputError

STUCK = 60.0  # seconds without a pose after a fault, while frames arrive
FIRST_FIX = 90.0  # seconds, of a machine that starts everything at once


@dataclass
class Event:
    """One fault: when it began, and what became of every robot that has to be found again."""

    fault: str
    begin: float  # seconds since the first robot drove
    seconds: float  # that it lasted
    recoveries: dict[str, float | None]  # None: not in STUCK seconds
    stuck: list[str]  # of those, whom frames were sent to
    unfed: list[str]  # of those, whose frames did not arrive at the router
    false: int = 0
    crashes: int = 0
    zombies: int = 0
    skipped: str = ""

    @property
    def lasted(self) -> float:
        """Seconds from its begin until all were found again, or were given up."""
        return self.seconds + max((STUCK if each is None else each for each in self.recoveries.values()), default=0.0)


def options(parser: ArgumentParser) -> None:
    """Add how long, how many and what."""
    parser.add_argument("--minutes", type=float, default=60.0, help="after all robots have been found (60)")
    parser.add_argument("--robots", type=int, default=2, help="in a town, a yard of equal boxes, a rearranged yard ...")
    parser.add_argument("--every", type=float, default=60.0, metavar="S", help="seconds from fault to fault (60)")
    parser.add_argument("--seed", type=int, default=3101, help="of worlds and faults (3101)")
    parser.add_argument("--faults", nargs="+", metavar="WORD", default=[], help="only those whose names have a word")


def chosen(words: Sequence[str], seed: int) -> Iterator[str]:
    """Yield names of faults for ever, each once before any comes again, in an order drawn anew each time.

    In every other round, from the second on, no process of a node is ended: some have to grow old for leaks to be seen.
    """
    names = [name for name in FAULTS if not words or any(word in name for word in words)]
    if not names:
        raise InputError(f"--faults {' '.join(words)}: no fault is called so; there are {', '.join(FAULTS)}")
    rng = Random(seed)
    while True:
        yield from rng.sample(names, len(names))
        gentle = [name for name in names if not FAULTS[name].ends_processes]
        yield from rng.sample(gentle, len(gentle))


def rows(asked: Namespace) -> Iterator[Row]:
    """Run the soak; the summary is that of what there was when it is interrupted."""
    faults = chosen(asked.faults, asked.seed)
    first = next(faults)
    if asked.robots < 1:
        raise InputError(f"--robots {asked.robots}: at least one")
    kinds = [KINDS[k % len(KINDS)] for k in range(asked.robots)]
    made = {kind: prepare(folder(), kind, asked.seed, asked.quick) for kind in dict.fromkeys(kinds)}
    stage = Stage([made[kind] for kind in kinds], folder() / "soak", asked.seed)
    soak = Soak(stage, asked)
    ended: list[float] = []
    try:
        try:
            yield soak.find()
            for name in itertools.chain([first], faults):
                yield soak.play(name)
                soak.keep()
                if time.monotonic() > soak.end:
                    break
        except KeyboardInterrupt:
            print("soak: interrupted; what there was until now:", file=sys.stderr)
    finally:
        ended = stage.close()
    yield from soak.summary(ended)


class Soak:
    """One soak under way: its events so far, and the rows made of them."""

    def __init__(self, stage: Stage, asked: Namespace) -> None:
        self.stage, self.asked = stage, asked
        self.events: list[Event] = []
        self.start = self.end = time.monotonic()
        self.rows: list[Row] = []

    def find(self) -> Row:
        """Wait until the robots of the town are found for the first time."""
        stage = self.stage
        stage.wait(120.0, lambda: all(robot.status for robot in stage.robots))
        stage.begin()
        self.start = time.monotonic()
        wanted = [robot for robot in stage.robots if not robot.site.deceptive]
        for robot in wanted:
            robot.expect(robot.start)
        stage.wait(FIRST_FIX, lambda: all(robot.recovered for robot in wanted))
        fixes = {each.name: each.recovered and each.recovered - each.start for each in wanted}
        self.end = time.monotonic() + 60 * self.asked.minutes
        stage.wait(min(10.0, self.asked.every / 3))
        row = Row(
            "soak/first fix, s",
            text="; ".join(f"{name} {fix and round(fix, 1)}" for name, fix in fixes.items()),
            details=fixes,
        )
        self.rows.append(row)
        return row

    def play(self, name: str) -> Row:
        """Make one fault, and wait until all is well again and the next is due."""
        stage, begin = self.stage, time.monotonic()
        wanted = [each for each in stage.robots if not each.site.deceptive]
        false, crashes = self.false(), self.crashes()
        event = Event(name, begin - self.start, 0.0, {}, [], [])
        try:
            whole = FAULTS[name].make(stage)
        except SkippedError as error:
            event.skipped = str(error)
        except Exception as error:  # of the bench, not of what it tests; the soak goes on
            traceback.print_exc()
            event.skipped = f"{type(error).__name__}: {error}"
        if not event.skipped:
            event.seconds = whole - begin
            for robot in wanted:
                robot.expect(whole)
            stage.wait(STUCK, lambda: all(robot.recovered for robot in wanted))
            now = time.monotonic()
            for robot in wanted:
                event.recoveries[robot.name] = None if robot.recovered is None else robot.recovered - whole
                if robot.recovered is None:
                    (event.stuck if robot.fed(now) else event.unfed).append(robot.name)
        for node in stage.nodes:
            node.revive()
        if event.stuck or event.unfed:  # counted; the next fault is to find robots that work
            stage.rescue()
            for robot in wanted:
                robot.expect(time.monotonic())
            stage.wait(STUCK, lambda: all(robot.recovered for robot in wanted))
        stage.wait(max(5.0 if self.asked.every >= 30 else 1.0, begin + self.asked.every - time.monotonic()))
        event.false, event.crashes = self.false() - false, self.crashes() - crashes
        event.zombies = sum(node.zombies() for node in stage.nodes)
        self.events.append(event)
        row = Row(f"soak/{len(self.events)}: {name}", text=self._said(event), details=asdict(event))
        self.rows.append(row)
        return row

    def _said(self, event: Event) -> str:
        if event.skipped:
            return f"skipped: {event.skipped}"
        back = [f"{name} {'STUCK' if each is None else f'{each:.1f} s'}" for name, each in event.recoveries.items()]
        marks = (
            ["nodes started again by hand"] * bool(event.stuck or event.unfed)
            + [f"{event.false} FALSE"] * bool(event.false)
            + [f"{event.crashes} CRASHES"] * bool(event.crashes)
        )
        states = " ".join(f"{each.name}:{each.state}" for each in self.stage.robots)
        return "; ".join([*(back or ["nobody had to be found"]), *marks, states])

    def false(self) -> int:
        """Return how many poses were false so far."""
        return sum(len(each.false) + each.unreadable for each in self.stage.robots)

    def crashes(self) -> int:
        """Return how many processes ended so far that nobody ended, or did not end that should have."""
        return sum(len(node.crashes) for node in self.stage.nodes)

    def summary(self, ended: Sequence[float] = ()) -> Iterator[Row]:
        """Yield the rows of the targets."""
        hours = (time.monotonic() - self.start) / 3600
        faults = [(self.start + each.begin - 1.0, self.start + each.begin + each.lasted + 15.0) for each in self.events]
        yield from figures.held(self.stage.robots, hours, faults)
        yield from figures.survived(self.events)
        yield from figures.processes(self.stage.nodes, hours, ended)
        details: dict[str, Any] = {"code": fingerprint(), "bench": fingerprint("bench/soak")}
        details |= {"minutes": 60 * hours, "robots": len(self.stage.robots), "seed": self.asked.seed}
        yield Row("soak/code", text=fingerprint(), details=details)

    def keep(self) -> None:
        """Write what there is so far where --json will be written at the end."""
        if self.asked.json is not None:
            every = [*self.rows, *self.summary()]
            with atomic_path(self.asked.json) as part:
                part.write_text(json.dumps([row.to_dict() for row in every], indent=1, allow_nan=False) + "\n")


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Lay out the faults by kind, and what was held."""
    del asked
    events = [row.details for row in rows if "recoveries" in row.details]
    body = []
    for name in dict.fromkeys(event["fault"] for event in events):
        own = [event for event in events if event["fault"] == name and not event["skipped"]]
        times = [each for event in own for each in event["recoveries"].values() if each is not None]
        lost = sum(len(event["stuck"]) + len(event["unfed"]) + event["crashes"] > 0 for event in own)
        body.append(
            [
                name,
                str(len(own)),
                str(len(own) - lost),
                f"{np.median(times):.1f}" if times else "-",
                f"{max(times):.1f}" if times else "-",
                str(sum(event["false"] for event in own)),
            ]
        )
    facts = [row for row in rows if "recoveries" not in row.details]
    verdict = {True: "holds", False: "**does not hold**", None: ""}
    said = [
        [row.name.removeprefix("soak/"), row.text or f"{row.ours:.3g} {row.unit}", row.target, verdict[row.holds]]
        for row in facts
    ]
    head = ["fault", "times", "survived", "back after, median s", "worst s", "false poses"]
    return {"faults": table(head, sorted(body)), "held": table(["what", "measured", "target", "verdict"], said)}
