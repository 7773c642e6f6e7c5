"""Rates, delays and recovery of the streaming node, under good and ill treatment.

An independent client: everything it sends and reads is written from the documented contract, with raw zenoh. Each
scenario starts a router, a node (through the command line) and senders as processes of their own, and yields its
findings with a verdict per target. Needs the extra ``bench``.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
import traceback
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness.files import folder
from bench.harness.rows import Row, failed
from bench.harness.suite import environment
from bench.stream import scores
from bench.stream.client import vandalise
from bench.stream.drive import RobotPlan
from bench.stream.stage import MOST_FIRST_FIX, Outcome, Setting, Stage, until

SCENARIOS = (
    "raw", "cdr", "protobuf", "jitter", "router", "flood", "random", "backwards", "odometry", "robots", "sigterm",
)  # fmt: skip


def scenario(name: str) -> Callable[[Setting], Outcome]:
    """Return the function of that name."""
    from bench.stream import attacks

    found: Callable[[Setting], Outcome] = globals().get(name) or getattr(attacks, name)
    return found


def prepare(there: Path, seed: int) -> tuple[Path, Path, Path]:
    """Simulate the robot's world and another one, and build the first one's map, through the command line."""
    main, stranger = there / f"town-{seed}", there / f"town-{seed + 1}"
    for out, number, length in ((main, seed, "80"), (stranger, seed + 1, "40")):
        if not (out / "truth.tum").is_file():
            _run("simulate", str(out), "--seed", str(number), "--size", "220", "--length", length)
    site = main / "site.coview"
    if not site.is_file():
        _run("build", str(main / "base.laz"), "-o", str(site))
    return main, stranger, site


def _run(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "coview_stream", *arguments], env=environment(), check=True)


def play(name: str, setting: Setting) -> Iterator[Row]:
    """Run one scenario; one that breaks is a target missed, and the next scenario runs all the same."""
    try:
        outcome = scenario(name)(setting)
    except Exception as error:
        traceback.print_exc()
        yield failed(f"stream/{name}", f"{type(error).__name__}: {error}".splitlines()[0])
        return
    yield from outcome.rows
    verdicts = [row.holds for row in outcome.rows if row.holds is not None]
    said = f"{sum(verdicts)} of {len(verdicts)}"
    yield Row(f"stream/{name}: targets that hold", sum(verdicts), said=said, details=outcome.numbers)


def options(parser: ArgumentParser) -> None:
    """Add which scenarios, and how the node is run."""
    parser.add_argument("names", nargs="*", metavar="SCENARIO", choices=[[], *SCENARIOS],
                        help=f"of {', '.join(SCENARIOS)} (all)")  # fmt: skip
    parser.add_argument("--seed", type=int, default=3101, help="of the simulated world (3101)")
    parser.add_argument("--keep", action="store_true", help="keep the node's logs, and say where")
    parser.add_argument("--serve", default="", metavar="ARGS", help="more arguments for coview-stream serve")


def rows(asked: Namespace) -> Iterator[Row]:
    """Run the scenarios one after the other."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        logs = Path(tempfile.mkdtemp(prefix="bench-stream-")) if asked.keep else Path(scratch)
        setting = Setting(*prepare(folder() / "stream", asked.seed), logs, asked.quick, asked.serve.split())
        for name in asked.names or SCENARIOS:
            yield from play(name, setting)
        if asked.keep:
            print(f"logs: {logs}")


FLEET, FLEET_POINTS, LONGEST_STARVATION, LEAST_JAIN = 16, 16_000, 1.0, 0.95


def _stream(setting: Setting, outcome: Outcome, label: str, plan: RobotPlan, *arguments: str) -> Outcome:
    with Stage(setting, outcome.name, [plan.robot], *arguments) as stage:
        sender = stage.sender(plan)
        start = sender.begin()
        sent = sender.result()
        until(start + plan.seconds + 0.5)
        numbers = stage.measure(plan, sent, start)
        numbers["log_lines"] = len(stage.node.log_lines())
        outcome.numbers[label.strip() or "stream"] = numbers
        outcome.stream(numbers, label)
        outcome.machine(sent, label)
    return outcome


def raw(setting: Setting) -> Outcome:
    """Raw xyz with JSON odometry, at 10 and at 20 Hz."""
    outcome = Outcome("raw")
    _stream(setting, outcome, "10 Hz: ", RobotPlan("r1", setting.seconds(53.0, 25.0)))
    fast = RobotPlan("r1", setting.seconds(26.0, 20.0), cloud="xyzi", cloud_period=0.05, frame_seconds=0.05)
    return _stream(setting, outcome, "20 Hz, xyzi: ", fast)


def cdr(setting: Setting) -> Outcome:
    """ROS 2 messages in and out."""
    plan = RobotPlan("r1", setting.seconds(53.0, 25.0), cloud="cdr", odometry="cdr")
    return _stream(setting, Outcome("cdr"), "", plan, "--pose-encoding", "cdr")


def protobuf(setting: Setting) -> Outcome:
    """Clouds and poses in foxglove's messages."""
    plan = RobotPlan("r1", setting.seconds(53.0, 25.0), cloud="foxglove")
    return _stream(setting, Outcome("protobuf"), "", plan, "--pose-encoding", "foxglove")


def jitter(setting: Setting) -> Outcome:
    """Track one robot while another searches all the time, for its world is not on this map."""
    outcome = Outcome("jitter")
    plan, other = (RobotPlan(name, setting.seconds(53.0, 25.0)) for name in ("r1", "r2"))
    with Stage(setting, outcome.name, ["r1", "r2"]) as stage:
        senders = [stage.sender(plan), stage.sender(other, world=setting.stranger)]
        start = senders[0].begin()
        senders[1].begin(start)
        cpu = stage.node.cpu_seconds()
        sent, stray = (sender.result() for sender in senders)
        until(start + plan.seconds + 0.5)
        used = (stage.node.cpu_seconds() - cpu) / (time.monotonic() - start)
        numbers = stage.measure(plan, sent, start)
        told = stage.recorder.told("r2", start)
        states = sorted({status.state for status in told})
        counters = told[-1].fields.get("counters") if told else None
        outcome.numbers = {"r1": numbers, "cpu_cores": used, "r2": {"states": states, "counters": counters}}
        outcome.stream(numbers)
        outcome.machine(sent)
        outcome.none("r2, elsewhere: poses", len(stage.recorder.poses("r2", start)))
        worked = scores.counter(told, "processed")
        outcome.some("r2: frames processed of sent", worked, (worked, len(stray.puts["r2"])))
        outcome.tell("r2: states", " ".join(states))
        outcome.tell("processor, cores", used)
    return outcome


def robots(setting: Setting) -> Outcome:
    """Sixteen robots in one node, the last of which sends rubbish."""
    outcome = Outcome("robots")
    names = [f"r{k + 1}" for k in range(FLEET)]
    seconds = setting.seconds(60.0, 20.0)
    plans = [RobotPlan(name, seconds, odometry_period=0.05, points=FLEET_POINTS) for name in names[:-1]]
    with Stage(setting, outcome.name, names) as stage:
        senders = [stage.sender(*plans[:8]), stage.sender(*plans[8:])]
        rogue = stage.helper(vandalise, stage.endpoint, names[-1:], 50.0)
        rogue.ready()
        start = senders[0].begin()
        for helper in (senders[1], rogue):
            helper.begin(start)
        until(start)
        cpu, memory = stage.node.cpu_seconds(), []
        while time.monotonic() < start + seconds:
            memory.append(stage.node.megabytes())
            time.sleep(2.0)
        used = (stage.node.cpu_seconds() - cpu) / (time.monotonic() - start)
        rogue.ask_to_stop()
        sent = [sender.result() for sender in senders]
        found = {p.robot: _robot(stage, p, sent[k // 8], start) for k, p in enumerate(plans)}
        rubbish = rogue.result()
        outcome.numbers = {"robots": found, "cpu_cores": used, "memory_mb": memory, "rubbish": rubbish}
        outcome.numbers["sender_lag_put_s"] = [(s.longest_lag, s.longest_put) for s in sent]
        outcome.judge("node alive", stage.node.running(), "True", stage.node.running())
        _judge_fleet(outcome, found)
        last = stage.recorder.told(names[-1])
        state = last[-1].state if last else "no status"
        outcome.tell("rubbish sent to the sixteenth; its state", (rubbish, state))
        for part in sent:
            outcome.machine(part)
        outcome.tell("processor, cores", used)
        outcome.tell("memory first / last / most, MB", (memory[0], memory[-1], max(memory)))
    return outcome


def _robot(stage: Stage, plan: RobotPlan, sent: Any, start: float) -> dict[str, Any]:
    numbers = stage.measure(plan, sent, start)
    # while it is being sent to: a robot that has ended does not starve
    begin, end = start + 2.0, start + plan.seconds
    told, puts = stage.recorder.told(plan.robot, begin, end), sent.puts[plan.robot]
    for name, seen in (
        ("longest_starvation_s", scores.processed(told)),
        ("longest_without_correction_s", scores.corrected(stage.recorder.poses(plan.robot, begin, end))),
    ):
        stale = scores.staleness(puts, seen)
        numbers[name] = float(stale.max()) if len(stale) else None
    numbers["processed"] = scores.counter(told, "processed")
    ends = np.arange(start + 10.0, end + 1.0, 10.0)
    done = [scores.counter(stage.recorder.told(plan.robot, start, each), "processed") or 0 for each in ends]
    numbers["processed_per_10_s"] = np.diff([0, *done]).tolist()
    return numbers


def _judge_fleet(outcome: Outcome, found: dict[str, dict[str, Any]]) -> None:
    rows = list(found.values())
    for name, row in found.items():
        jitter_ms = row["jitter_ms"][1] if row["jitter_ms"] else None
        parts = [row[key] for key in ("clouds_sent", "processed", "longest_starvation_s", "first_fix_s",
                                      "first_fix_m", "rate_hz")]  # fmt: skip
        about = (*parts, jitter_ms, row["false"], " ".join(row["states"]))
        outcome.tell(f"{name}: sent, done, starved s, fix s, m, rate, p99 ms, false, states", about)
    waits = [row["longest_starvation_s"] for row in rows]
    worst = None if None in waits else max(waits)
    fed = worst is not None and worst < LONGEST_STARVATION
    outcome.judge("longest starvation of any robot, s", worst, f"< {LONGEST_STARVATION:.0f}", fed)
    done = [float(row["processed"] or 0) for row in rows]
    shares = [n / max(1, row["clouds_sent"]) for n, row in zip(done, rows, strict=True)]
    fair = scores.jain(done)
    outcome.judge("Jain fairness of frames processed", fair, f">= {LEAST_JAIN}", fair >= LEAST_JAIN)
    outcome.tell("frames processed of those sent, least / most", (min(shares), max(shares)))
    outcome.tell("processed each 10 s by all", np.sum([r["processed_per_10_s"] for r in rows], 0).tolist())
    searched = [(row["counters"] or {}).get("searches", 0) for row in rows]
    outcome.tell("searches per robot, least / most", (min(searched), max(searched)))
    outcome.none("false poses", sum(row["false"] for row in rows), sum(row["poses"] for row in rows))
    fixed = [row for row in rows if row["first_fix_s"] is not None]
    outcome.judge("robots with a fix", f"{len(fixed)} of {len(rows)}", "all", len(fixed) == len(rows))
    slow = [row["first_fix_m"] for row in fixed]
    limits = (min(slow), max(slow)) if slow else None
    outcome.tell(f"first fix, least / most m (alone: <= {MOST_FIRST_FIX:.0f})", limits)
    rates = [row["rate_hz"] for row in fixed if row["rate_hz"]]
    steady = bool(rates) and min(rates) >= 9.8 and max(rates) <= 10.2
    limits = (min(rates), max(rates)) if rates else None
    outcome.judge("pose rates, least / most Hz", limits, "10 +- 2%", steady)
    noise = (rows[0]["machine_jitter_ms"], rows[0]["foreign_cores"])
    outcome.tell("the machine's jitter, ms; cores others used", noise)
    p99 = [row["jitter_ms"][1] for row in fixed if row["jitter_ms"]]
    outcome.tell("jitter p99, median / most ms", (float(np.median(p99)), max(p99)) if p99 else None)
