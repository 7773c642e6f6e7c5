"""Rates, delays and recovery of the streaming node, under good and ill treatment.

Each scenario starts a router, a node (through the command line) and senders as processes of their own, speaks with the
node over raw zenoh, and yields its findings with a verdict per target. Needs the extra ``bench``.
"""

from __future__ import annotations

import functools
import itertools
import time
import traceback
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from bench.harness import worlds
from bench.harness.files import fingerprint, folder, remembered
from bench.harness.rows import Row, failed
from bench.stream import scores
from bench.stream.processes import RobotPlan, vandalise, wait_until
from bench.stream.scores import Told
from bench.stream.stage import MAX_FIRST_FIX, MAX_JITTER, Findings, Setting, Stage, processor_seconds
from coview_stream import BaseMap
from coview_stream.geometry.arrays import Floats
from coview_stream.sim import SimulationConfig

FLEET, FLEET_POINTS, MAX_STARVATION, MIN_JAIN = 16, 16_000, 1.0, 0.95
HOME, AWAY = 8, 8  # robots on the map, and off it
MAX_DELAY, MAX_SEARCHLESS = 5.0, 3.0
"""Targets, seconds: a robot found later than alone; a lost robot without a search."""

_ALONE = 30.0  # seconds in which a robot alone must be found
_WARM = 4.0  # seconds of the node after its announcement


def steady(stage: Stage, label: str = "", full: float = 53.0, quick: float = 25.0, **changes: Any) -> None:
    """Stream one robot that ought to be served well."""
    stream = stage.stream(RobotPlan("r1", stage.seconds(full, quick), **changes))
    numbers = stage.measure(stream.plan, stage.sent(stream.sender, label), stream.start)
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
    stage.found.numbers = {"r1": numbers, "r2": told[-1].fields if told else {}}
    stage.found.stream(numbers)
    stage.found.none("r2, elsewhere: poses", len(stage.recorder.poses("r2", start)))
    worked = scores.counter(told, "processed")
    stage.found.some("r2: frames processed of sent", worked, (worked, len(stray.puts["r2"])))


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


def many(stage: Stage) -> None:
    """Find eight robots one at a time, then together while eight that are elsewhere search without end.

    A robot is starved of searches for as long as its statuses, one a second, show no new search while it drives lost.
    """
    time.sleep(_WARM)
    first_fix(stage, stage.robots[0])  # in a fresh process; the first alone is measured again
    alone = [first_fix(stage, name) for name in stage.robots[: 3 if stage.setting.quick else HOME]]
    stage.found.judge("memory after robots one at a time, MB", stage.megabytes())
    together(stage, alone)


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
    return RobotPlan(name, seconds, odometry_period=0.05, points=FLEET_POINTS)


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
    found.most("longest time without a search, s", max(starved.values()), MAX_SEARCHLESS)
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


class Scenario(NamedTuple):
    """What is done on a stage, for which robots, with which further arguments of the node."""

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
    "many": (Scenario(many, tuple(f"r{k + 1}" for k in range(HOME + AWAY))),),
}


def options(parser: ArgumentParser) -> None:
    """Add which scenarios."""
    parser.add_argument("names", nargs="*", metavar="SCENARIO", choices=[[], *SCENARIOS],
                        help=f"of {', '.join(SCENARIOS)} (all)")  # fmt: skip
    parser.add_argument("--seed", type=int, default=3101, help="of the simulated world (3101)")


def rows(asked: Namespace) -> Iterator[Row]:
    """Run the scenarios one after the other, in a simulated world, where the node's logs stay; see also ``--work``."""
    home, stranger = (SimulationConfig(seed=asked.seed + k, size=220.0, length=80.0 / (1 + k)) for k in (0, 1))
    for config in (home, stranger):
        worlds.prepare(folder(), config)
    main, other = (folder() / worlds.world_name(config) for config in (home, stranger))
    setting = Setting(main, other, worlds.map_of(folder(), home), asked.quick)
    for name in asked.names or SCENARIOS:
        if name == "many":  # the search by both recognizers takes longest
            site, made = main / "learned.coview", {"learned": True, "code": fingerprint(*worlds.MAPPER)}
            remembered(
                main / "learned.json", made, lambda out=site: BaseMap.build(main / "base.laz", learned=True).save(out)
            )
            setting = setting._replace(site=site)
        yield from played(name, setting)


def played(name: str, setting: Setting) -> Iterator[Row]:
    """Run one scenario; one that breaks is a target missed, and the next scenario runs all the same."""
    found = Findings(name)
    try:
        for scenario in SCENARIOS[name]:
            with Stage(setting, found, scenario.robots, *scenario.arguments) as stage:
                scenario.play(stage)
    except Exception as error:
        traceback.print_exc()
        yield failed(f"stream/{name}", f"{type(error).__name__}: {error}".splitlines()[0])
        return
    yield from found.rows
    verdicts = [row.holds for row in found.rows if row.holds is not None]
    said = f"{sum(verdicts)} of {len(verdicts)}"
    yield Row(f"stream/{name}: targets that hold", sum(verdicts), text=said, details=found.numbers)
