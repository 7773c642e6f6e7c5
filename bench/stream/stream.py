"""Rates, delays and fairness of the streaming node.

A scenario starts a router, a node (through the command line) and senders as processes, speaks with the node over raw
zenoh, and yields its rows with a verdict per target. Needs the extra ``bench``.
"""

from __future__ import annotations

import functools
import traceback
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from bench.harness import worlds
from bench.harness.files import folder
from bench.harness.rows import Row, bounded, failed, informs, judged, reached
from bench.stream import scores
from bench.stream.processes import RobotPlan, vandalise
from bench.stream.stage import MAX_FIRST_FIX, Setting, Stage, punctual, rated, served
from coview_stream.sim import SimulationConfig

FLEET, FLEET_POINTS, MAX_STARVATION, MIN_JAIN = 16, 16_000, 1.0, 0.95


def steady(stage: Stage, label: str = "", full: float = 53.0, quick: float = 25.0, **changes: Any) -> Iterator[Row]:
    """Stream one robot that must be served well."""
    plan = RobotPlan("r1", quick if stage.setting.quick else full, **changes)
    sender = stage.sender(plan)
    start = sender.begin()
    yield from served(stage.measure(plan, sender.result(), start), label)


def jitter(stage: Stage) -> Iterator[Row]:
    """Track one robot while another searches all the time, for its world is not on this map."""
    plan, other = (RobotPlan(name, 25.0 if stage.setting.quick else 53.0) for name in ("r1", "r2"))
    senders = [stage.sender(plan), stage.sender(other, world=stage.setting.stranger)]
    start = senders[0].begin()
    senders[1].begin(start)
    yield from served(stage.measure(plan, senders[0].result(), start))
    count = len(stage.recorder.poses("r2", start))
    yield judged("r2, elsewhere: poses", str(count), "0", count == 0, count)
    processed = scores.counter(stage.recorder.told("r2", start), "processed") or 0
    yield reached("r2: frames processed", processed, "", 1)


def robots(stage: Stage) -> Iterator[Row]:
    """Serve sixteen robots with one node; the last one sends rubbish."""
    seconds = 20.0 if stage.setting.quick else 60.0
    plans = [RobotPlan(name, seconds, odometry_period=0.05, points=FLEET_POINTS) for name in stage.robots[:-1]]
    senders = [stage.sender(*plans[:8]), stage.sender(*plans[8:])]
    rogue = stage.helper(vandalise, stage.endpoint, stage.robots[-1], 50.0)
    start = senders[0].begin()
    for helper in (senders[1], rogue):
        helper.begin(start)
    sent = [sender.result() for sender in senders]
    rogue.send("stop")
    numbers = [stage.measure(plan, sent[k // 8], start) for k, plan in enumerate(plans)]
    waits, done = [], []
    for k, plan in enumerate(plans):  # statuses while frames are sent: a robot that has ended does not starve
        told = stage.recorder.told(plan.robot, start + 2.0, start + seconds)
        stale = scores.staleness(sent[k // 8].puts[plan.robot], scores.processed(told))
        waits.append(float(stale.max(initial=0.0 if len(stale) else np.inf)))
        done.append(float(scores.counter(told, "processed") or 0))

    def all_of(figure: str) -> list[Any]:
        return [row[figure] for row in numbers]

    details = {"robots": numbers, "longest_starvation_s": waits, "processed": done}
    yield replace(punctual("", max(all_of("late_s"))), details=details)
    yield judged("node alive", str(stage.running()), "True", stage.running())
    yield bounded("longest starvation of any robot", max(waits), "s", MAX_STARVATION)
    yield reached("Jain fairness of frames processed", scores.jain(done), "", MIN_JAIN)
    yield informs("frames processed of those sent", 100 * sum(done) / sum(all_of("clouds_sent")), "%")
    wrong = sum(all_of("wrong"))
    yield judged("false or unreadable poses", f"{wrong} of {sum(all_of('poses'))}", "0", wrong == 0)
    fixes = [fix for fix in all_of("first_fix_m") if np.isfinite(fix)]
    yield judged("robots with a fix", f"{len(fixes)} of {len(plans)}", "all", len(fixes) == len(plans))
    yield informs(f"latest first fix (alone: <= {MAX_FIRST_FIX:.0f})", max(fixes, default=np.nan), "m")
    yield rated("pose rates", all_of("rate_hz"))
    yield informs("the machine's jitter p99", numbers[0]["machine_jitter_ms"], "ms")
    yield informs("jitter p99, median", float(np.nanmedian(all_of("jitter_ms"))), "ms")


class Scenario(NamedTuple):
    """A play on a stage, its robots, and further arguments of the node."""

    play: Callable[[Stage], Iterator[Row]]
    robots: tuple[str, ...] = ("r1",)
    arguments: tuple[str, ...] = ()


_FAST = functools.partial(
    steady, label="20 Hz, xyzi: ", full=26.0, quick=20.0, cloud="xyzi", cloud_period=0.05, frame_seconds=0.05
)
_CDR = functools.partial(steady, cloud="cdr", odometry="cdr")
SCENARIOS: dict[str, tuple[Scenario, ...]] = {
    "raw": (Scenario(functools.partial(steady, label="10 Hz: ")), Scenario(_FAST)),
    "cdr": (Scenario(_CDR, arguments=("--pose-encoding", "cdr")),),
    "protobuf": (Scenario(functools.partial(steady, cloud="foxglove"), arguments=("--pose-encoding", "foxglove")),),
    "jitter": (Scenario(jitter, ("r1", "r2")),),
    "robots": (Scenario(robots, tuple(f"r{k + 1}" for k in range(FLEET))),),
}


def options(parser: ArgumentParser) -> None:
    """Add which scenarios."""
    parser.add_argument("names", nargs="*", metavar="SCENARIO", choices=[[], *SCENARIOS],
                        help=f"of {', '.join(SCENARIOS)} (all)")  # fmt: skip
    parser.add_argument("--seed", type=int, default=3101, help="of the simulated world (3101)")


def rows(asked: Namespace) -> Iterator[Row]:
    """Run the scenarios one after the other, in a simulated world; the node's logs stay in its folder."""
    home, stranger = (SimulationConfig(seed=asked.seed + k, size=220.0, length=80.0 / (1 + k)) for k in (0, 1))
    main, other = (worlds.prepare(folder(), config) for config in (home, stranger))
    setting = Setting(main, other, worlds.map_of(folder(), home), asked.quick)
    for name in asked.names or SCENARIOS:
        try:
            for scenario in SCENARIOS[name]:
                with Stage(setting, f"{name}.log", scenario.robots, *scenario.arguments) as stage:
                    for row in scenario.play(stage):
                        yield replace(row, name=f"stream/{name}/{row.name}")
        except Exception as error:  # a target missed; the next scenario runs all the same
            traceback.print_exc()
            yield failed(f"stream/{name}", f"{type(error).__name__}: {error}".splitlines()[0])
