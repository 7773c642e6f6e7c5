"""Rates, delays and recovery of the streaming node, under good and ill treatment.

A scenario starts a router, a node (through the command line) and senders as processes, speaks with the node over raw
zenoh, and yields its rows with a verdict per target. Needs the extra ``bench``.
"""

from __future__ import annotations

import functools
import traceback
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from bench.harness import worlds
from bench.harness.files import folder
from bench.harness.rows import Row, failed
from bench.stream import scores
from bench.stream.processes import RobotPlan, vandalise
from bench.stream.stage import MAX_FIRST_FIX, Findings, Setting, Stage
from coview_stream.sim import SimulationConfig

FLEET, FLEET_POINTS, MAX_STARVATION, MIN_JAIN = 16, 16_000, 1.0, 0.95


def steady(stage: Stage, label: str = "", full: float = 53.0, quick: float = 25.0, **changes: Any) -> None:
    """Stream one robot that must be served well."""
    plan = RobotPlan("r1", stage.seconds(full, quick), **changes)
    sender = stage.sender(plan)
    start = sender.begin()
    numbers = stage.measure(plan, stage.sent(sender, label), start)
    stage.found.numbers[label.strip() or "stream"] = numbers
    stage.found.stream(numbers, label)


def jitter(stage: Stage) -> None:
    """Track one robot while another searches all the time, for its world is not on this map."""
    plan, other = (RobotPlan(name, stage.seconds(53.0, 25.0)) for name in ("r1", "r2"))
    senders = [stage.sender(plan), stage.sender(other, world=stage.setting.stranger)]
    start = senders[0].begin()
    senders[1].begin(start)
    numbers = stage.measure(plan, stage.sent(senders[0]), start)
    stray = senders[1].result()
    told = stage.recorder.told("r2", start)
    stage.found.numbers = {"r1": numbers}
    stage.found.stream(numbers)
    stage.found.none("r2, elsewhere: poses", len(stage.recorder.poses("r2", start)))
    worked = scores.counter(told, "processed")
    stage.found.judge("r2: frames processed of sent", (worked, len(stray.puts["r2"])), "> 0", bool(worked))


def robots(stage: Stage) -> None:
    """Sixteen robots in one node, the last of which sends rubbish."""
    found, seconds = stage.found, stage.seconds(60.0, 20.0)
    plans = [RobotPlan(name, seconds, odometry_period=0.05, points=FLEET_POINTS) for name in stage.robots[:-1]]
    senders = [stage.sender(*plans[:8]), stage.sender(*plans[8:])]
    rogue = stage.helper(vandalise, stage.endpoint, stage.robots[-1], 50.0)
    start = senders[0].begin()
    for helper in (senders[1], rogue):
        helper.begin(start)
    sent = [stage.sent(sender) for sender in senders]
    rogue.stop()
    rows = [stage.measure(plan, sent[k // 8], start) for k, plan in enumerate(plans)]
    waits, done = [], []
    for k, plan in enumerate(plans):
        # while it is being sent to: a robot that has ended does not starve
        told = stage.recorder.told(plan.robot, start + 2.0, start + seconds)
        stale = scores.staleness(sent[k // 8].puts[plan.robot], scores.processed(told))
        waits.append(float(stale.max()) if len(stale) else np.inf)
        done.append(float(scores.counter(told, "processed") or 0))
    found.numbers = {"robots": rows, "longest_starvation_s": waits, "processed": done}
    found.judge("node alive", stage.running(), "True", stage.running())
    fed = max(waits) < MAX_STARVATION
    found.judge("longest starvation of any robot, s", max(waits), f"< {MAX_STARVATION:.0f}", fed)
    fair = scores.jain(done)
    found.judge("Jain fairness of frames processed", fair, f">= {MIN_JAIN}", fair >= MIN_JAIN)
    shares = [n / max(1, row["clouds_sent"]) for n, row in zip(done, rows, strict=True)]
    found.judge("frames processed of those sent, least / most", _range(shares))
    found.none("false poses", sum(row["false"] for row in rows), sum(row["poses"] for row in rows))
    fixed = [row for row in rows if row["first_fix_s"] is not None]
    found.judge("robots with a fix", f"{len(fixed)} of {len(rows)}", "all", len(fixed) == len(rows))
    fixes = _range([row["first_fix_m"] for row in fixed])
    found.judge(f"first fix, least / most m (alone: <= {MAX_FIRST_FIX:.0f})", fixes)
    rates = _range([row["rate_hz"] for row in fixed if row["rate_hz"]])
    constant = rates is not None and rates[0] >= 9.8 and rates[1] <= 10.2
    found.judge("pose rates, least / most Hz", rates, "10 +- 2%", constant)
    found.judge("the machine's jitter, ms", rows[0]["machine_jitter_ms"])
    p99 = [row["jitter_ms"][1] for row in fixed if row["jitter_ms"]]
    found.judge("jitter p99, median / most ms", (float(np.median(p99)), max(p99)) if p99 else None)


def _range(values: list[float]) -> tuple[float, float] | None:
    return (min(values), max(values)) if values else None


class Scenario(NamedTuple):
    """A play on a stage, its robots, and further arguments of the node."""

    play: Callable[[Stage], None]
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
    for config in (home, stranger):
        worlds.prepare(folder(), config)
    main, other = (folder() / worlds.world_name(config) for config in (home, stranger))
    setting = Setting(main, other, worlds.map_of(folder(), home), asked.quick)
    for name in asked.names or SCENARIOS:
        found = Findings(name)
        try:
            for scenario in SCENARIOS[name]:
                with Stage(setting, found, scenario.robots, *scenario.arguments) as stage:
                    scenario.play(stage)
        except Exception as error:  # a target missed; the next scenario runs all the same
            traceback.print_exc()
            yield failed(f"stream/{name}", f"{type(error).__name__}: {error}".splitlines()[0])
            continue
        yield from found.rows
        verdicts = [row.holds for row in found.rows if row.holds is not None]
        text = f"{sum(verdicts)} of {len(verdicts)}"
        yield Row(f"stream/{name}: targets that hold", sum(verdicts), text=text, details=found.numbers)
