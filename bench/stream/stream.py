"""Rates, delays and fairness of the streaming node.

A scenario starts a router, a node (through the command line) and senders as processes, speaks with the node over raw
zenoh, and yields its rows with a verdict per target. Needs the extra ``bench``.
"""

from __future__ import annotations

import functools
import traceback
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from bench.harness import worlds
from bench.harness.files import folder
from bench.harness.rows import Row, bounded, failed, informs, judged, listed, reached
from bench.stream import scores
from bench.stream.processes import APART, RobotPlan, vandalise
from bench.stream.stage import MAX_FIRST_FIX, MAX_JITTER, Setting, Stage, punctual, rated, served
from coview_stream.errors import InputError
from coview_stream.sim import SimulationConfig
from coview_stream.sim.simulate import scene_of, trajectories

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


LIDARS: dict[str, tuple[str, dict[str, Any]]] = {
    "terrestrial": ("blk360", {"cloud_period": 10 / 3, "frame_seconds": 10 / 3}),  # a scan each 5 m, taken at once
    "spinning": ("vlp16", {}),
    "solid-state": ("mid360", {}),
    "hemispherical": ("bpearl", {}),
}
"""Sensors of :func:`lidars`, and how they stream."""


def _drive_of(home: SimulationConfig, k: int, frames: int) -> tuple[int, str]:
    """Return the seed of a drive of the k-th robot, and where it leads: in a depot into the hall, the second out."""
    scene = scene_of(home)
    if (hall := scene.passage) is None:
        return k + 1, "outdoors"
    for seed in range(k + 1, 1000):
        truth = trajectories(scene, replace(home, drive_seed=seed))[1][APART * k : APART * k + frames]
        inside = hall.holds(truth[:, :2, 3])
        if len(inside) == frames and inside[0] == (k == 1) and 0.25 < inside.mean() < 0.5:
            return seed, "out of the hall" if inside[0] else "into the hall"
    raise InputError(f"{home}: no drive leads through the gate of the hall")


def lidars(stage: Stage) -> Iterator[Row]:
    """Serve four robots at once, each with another kind of lidar, on its own drive over the same map."""
    seconds, home = 12.0 if stage.setting.quick else 53.0, stage.setting.home
    plans, drives, ways = [], [], []
    for k, (sensor, words) in enumerate(LIDARS.values()):
        plans.append(RobotPlan(stage.robots[k], seconds, **words))
        length = 1.5 * (seconds + 15.0)
        seed, way = _drive_of(replace(home, length=length), k, round(10 * seconds))
        ways.append(way)
        drives.append(worlds.prepared_run(folder(), replace(home, sensor=sensor, length=length, drive_seed=seed)))
    senders = [stage.sender(plan, world=drive) for plan, drive in zip(plans, drives, strict=True)]
    start = senders[0].begin()
    for helper in senders[1:]:
        helper.begin(start)
    measured = []
    for kind, way, plan, drive, helper in zip(LIDARS, ways, plans, drives, senders, strict=True):
        numbers = stage.measure(plan, helper.result(), start, drive)
        measured.append({"scene": home.scene, "way": way, "kind": kind, "sensor": LIDARS[kind][0]} | numbers)
        yield informs(f"{kind}: median error", numbers["median_m"], "m", measured[-1])
    found = [numbers for numbers in measured if numbers["poses"]]
    wrong, poses = (sum(numbers[key] for numbers in measured) for key in ("wrong", "poses"))
    yield punctual("", max(numbers["late_s"] for numbers in measured))
    yield judged("robots found", f"{len(found)} of {len(measured)}", "all", len(found) == len(measured))
    yield judged("false or unreadable poses", f"{wrong} of {poses}", "0", wrong == 0)
    if found:
        yield rated("rates while TRACKING", [numbers["rate_hz"] for numbers in found])
        yield bounded("jitter p99, worst", max(numbers["jitter_ms"] for numbers in found), "ms", MAX_JITTER)
    yield informs("the machine's jitter p99", numbers["machine_jitter_ms"], "ms")


class Scenario(NamedTuple):
    """A play on a stage, its robots, further arguments of the node, and the scene."""

    play: Callable[[Stage], Iterator[Row]]
    robots: tuple[str, ...] = ("r1",)
    arguments: tuple[str, ...] = ()
    scene: str = "town"


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
    "lidars": tuple(Scenario(lidars, ("r1", "r2", "r3", "r4"), scene=scene) for scene in ("town", "depot")),
}


def options(parser: ArgumentParser) -> None:
    """Add which scenarios."""
    parser.add_argument("names", nargs="*", metavar="SCENARIO", choices=[[], *SCENARIOS],
                        help=f"of {', '.join(SCENARIOS)} (all)")  # fmt: skip
    parser.add_argument("--seed", type=int, default=3101, help="of the simulated world (3101)")


def rows(asked: Namespace) -> Iterator[Row]:
    """Run the scenarios one after the other, in a simulated world; the node's logs stay in its folder."""
    stranger = worlds.prepared_run(folder(), SimulationConfig(seed=asked.seed + 1, size=220.0, length=40.0))
    for name in asked.names or SCENARIOS:
        try:
            for scenario in SCENARIOS[name][: 1 if asked.quick else None]:
                home = SimulationConfig(scenario.scene, seed=asked.seed, size=220.0, length=80.0)
                main, site = worlds.prepare(folder(), home), worlds.map_of(folder(), home)
                setting = Setting(home, main, stranger, site, asked.quick)
                with Stage(setting, f"{name}.log", scenario.robots, *scenario.arguments) as stage:
                    place = f"{name}/{scenario.scene}" if len({s.scene for s in SCENARIOS[name]}) > 1 else name
                    for row in scenario.play(stage):
                        yield replace(row, name=f"stream/{place}/{row.name}")
        except Exception as error:  # a target missed; the next scenario runs all the same
            traceback.print_exc()
            yield failed(f"stream/{name}", f"{type(error).__name__}: {error}".splitlines()[0])


COLUMNS = (
    ("scene", "scene", None), ("drive", "way", None), ("lidar", "kind", None), ("sensor", "sensor", None),
    ("clouds", "clouds_sent", 0), ("first fix m", "first_fix_m", 1), ("s", "first_fix_s", 1), ("poses", "poses", 0),
    ("false", "wrong", 0), ("median error m", "median_m", 3), ("deg", "median_deg", 2), ("Hz", "rate_hz", 2),
    ("jitter p50 ms", "jitter_p50_ms", 1), ("p99", "jitter_ms", 1), ("posed after it", "share_posed", 3),
)  # fmt: skip


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Return a table of the robots of :func:`lidars`, which one node serves at once."""
    kinds = [row.details for row in rows if "kind" in row.details]
    return {"lidars": listed(COLUMNS, kinds)} if kinds else {}
