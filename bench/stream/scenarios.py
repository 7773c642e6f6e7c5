"""Good streams in every encoding, beside a robot that searches, and many robots at once."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from bench.stream import scores
from bench.stream.drive import RobotPlan
from bench.stream.rogue import vandalise
from bench.stream.stage import MOST_FIRST_FIX, Outcome, Setting, Stage, measure, report_stream, until

FLEET, FLEET_POINTS, LONGEST_STARVATION, LEAST_JAIN = 16, 16_000, 1.0, 0.95


def _stream(setting: Setting, outcome: Outcome, label: str, plan: RobotPlan, *arguments: str) -> None:
    with Stage(setting, outcome.name, [plan.robot], *arguments) as stage:
        sender = stage.sender(plan)
        start = sender.begin()
        sent = sender.result()
        until(start + plan.seconds + 0.5)
        numbers = measure(stage, plan, sent, start)
        numbers["log_lines"] = len(stage.node.log_lines())
        outcome.numbers[label.strip() or "stream"] = numbers
        report_stream(outcome, numbers, label)
        outcome.judge_machine(sent, label)


def raw(setting: Setting) -> Outcome:
    """Raw xyz with JSON odometry, at 10 and at 20 Hz."""
    outcome = Outcome("raw")
    _stream(setting, outcome, "10 Hz: ", RobotPlan("r1", setting.seconds(53.0, 25.0)))
    fast = RobotPlan("r1", setting.seconds(26.0, 20.0), cloud="xyzi", cloud_period=0.05, frame_seconds=0.05)
    _stream(setting, outcome, "20 Hz, xyzi: ", fast)
    return outcome


def cdr(setting: Setting) -> Outcome:
    """ROS 2 messages in and out."""
    outcome = Outcome("cdr")
    plan = RobotPlan("r1", setting.seconds(53.0, 25.0), cloud="cdr", odometry="cdr")
    _stream(setting, outcome, "", plan, "--pose-encoding", "cdr")
    return outcome


def protobuf(setting: Setting) -> Outcome:
    """Clouds and poses in foxglove's messages."""
    outcome = Outcome("protobuf")
    plan = RobotPlan("r1", setting.seconds(53.0, 25.0), cloud="foxglove")
    _stream(setting, outcome, "", plan, "--pose-encoding", "foxglove")
    return outcome


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
        numbers = measure(stage, plan, sent, start)
        told = stage.recorder.told("r2", start)
        outcome.numbers = {"r1": numbers, "cpu_cores": used}
        outcome.numbers["r2"] = {"states": sorted({status.state for status in told})}
        outcome.numbers["r2"]["counters"] = told[-1].fields.get("counters") if told else None
        report_stream(outcome, numbers)
        outcome.judge_machine(sent)
        poses = len(stage.recorder.poses("r2", start))
        outcome.judge("r2, elsewhere: poses", poses, "0", poses == 0)
        worked = scores.counter(told, "processed")
        outcome.judge("r2: frames processed of sent", (worked, len(stray.puts["r2"])), "> 0", bool(worked))
        outcome.tell("r2: states", " ".join(outcome.numbers["r2"]["states"]))
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
        cpu = stage.node.cpu_seconds()
        memory = []
        while time.monotonic() < start + seconds:
            memory.append(stage.node.megabytes())
            time.sleep(2.0)
        used = (stage.node.cpu_seconds() - cpu) / (time.monotonic() - start)
        rogue.ask_to_stop()
        sent = [sender.result() for sender in senders]
        rows = {p.robot: _robot(stage, p, sent[k // 8], start) for k, p in enumerate(plans)}
        outcome.numbers = {"robots": rows, "cpu_cores": used, "memory_mb": memory, "rubbish": rogue.result()}
        outcome.numbers["sender_lag_put_s"] = [(s.longest_lag, s.longest_put) for s in sent]
        _report_fleet(outcome, rows, stage.node.running())
        outcome.tell(
            "rubbish sent to the sixteenth; its state", (outcome.numbers["rubbish"], _state(stage, names[-1]))
        )
        for part in sent:
            outcome.judge_machine(part)
        outcome.tell("processor, cores", used)
        outcome.tell("memory first / last / most, MB", (memory[0], memory[-1], max(memory)))
    return outcome


def _robot(stage: Stage, plan: RobotPlan, sent: Any, start: float) -> dict[str, Any]:
    numbers = measure(stage, plan, sent, start)
    # while it is being sent to: a robot that has ended does not starve
    told = stage.recorder.told(plan.robot, start + 2.0, start + plan.seconds)
    stale = scores.staleness(sent.puts[plan.robot], scores.processed(told))
    corrections = scores.corrected(stage.recorder.poses(plan.robot, start + 2.0, start + plan.seconds))
    aged = scores.staleness(sent.puts[plan.robot], corrections)
    numbers["longest_starvation_s"] = float(stale.max()) if len(stale) else None
    numbers["longest_without_correction_s"] = float(aged.max()) if len(aged) else None
    numbers["processed"] = scores.counter(told, "processed")
    ends = np.arange(start + 10.0, start + plan.seconds + 1.0, 10.0)
    done = [scores.counter(stage.recorder.told(plan.robot, start, end), "processed") or 0 for end in ends]
    numbers["processed_per_10_s"] = np.diff([0, *done]).tolist()
    return numbers


def _state(stage: Stage, robot: str) -> str:
    told = stage.recorder.told(robot)
    return told[-1].state if told else "no status"


def _report_fleet(outcome: Outcome, rows: dict[str, dict[str, Any]], alive: bool) -> None:
    outcome.judge("node alive", alive, "True", alive)
    print(f"{'robot':6} sent done share starved fix_s fix_m  rate  p99ms false states")
    for name, row in rows.items():
        jitter_ms = row["jitter_ms"][1] if row["jitter_ms"] else None
        parts = [row["clouds_sent"], row["processed"], (row["processed"] or 0) / max(1, row["clouds_sent"])]
        parts += [
            row["longest_starvation_s"],
            row["first_fix_s"],
            row["first_fix_m"],
            row["rate_hz"],
            jitter_ms,
        ]
        cells = " ".join(f"{'-' if p is None else f'{p:.3g}':>5}" for p in parts)
        print(f"{name:6} {cells} {row['false']:>4}  {' '.join(row['states'])}")
    done = [float(row["processed"] or 0) for row in rows.values()]
    waits = [row["longest_starvation_s"] for row in rows.values()]
    worst = None if None in waits else max(waits)
    shares = [n / max(1, row["clouds_sent"]) for n, row in zip(done, rows.values(), strict=True)]
    outcome.judge(
        "longest starvation of any robot, s",
        worst,
        f"< {LONGEST_STARVATION:.0f}",
        worst is not None and worst < LONGEST_STARVATION,
    )
    fair = scores.jain(done)
    outcome.judge("Jain fairness of frames processed", fair, f">= {LEAST_JAIN}", fair >= LEAST_JAIN)
    outcome.tell("frames processed of those sent, least / most", (min(shares), max(shares)))
    outcome.tell(
        "processed each 10 s by all", np.sum([r["processed_per_10_s"] for r in rows.values()], 0).tolist()
    )
    searched = [(row["counters"] or {}).get("searches", 0) for row in rows.values()]
    outcome.tell("searches per robot, least / most", (min(searched), max(searched)))
    false = sum(row["false"] for row in rows.values())
    outcome.judge("false poses", f"{false} of {sum(row['poses'] for row in rows.values())}", "0", false == 0)
    fixed = [row for row in rows.values() if row["first_fix_s"] is not None]
    outcome.judge("robots with a fix", f"{len(fixed)} of {len(rows)}", "all", len(fixed) == len(rows))
    slow = [row["first_fix_m"] for row in fixed]
    outcome.tell(
        f"first fix, least / most m (alone: <= {MOST_FIRST_FIX:.0f})",
        (min(slow), max(slow)) if slow else None,
    )
    rates = [row["rate_hz"] for row in fixed if row["rate_hz"]]
    steady = bool(rates) and min(rates) >= 9.8 and max(rates) <= 10.2
    outcome.judge(
        "pose rates, least / most Hz", (min(rates), max(rates)) if rates else None, "10 +- 2%", steady
    )
    p99 = [row["jitter_ms"][1] for row in fixed if row["jitter_ms"]]
    floor = next(iter(rows.values()))
    outcome.tell(
        "the machine's jitter, ms; cores others used", (floor["machine_jitter_ms"], floor["foreign_cores"])
    )
    outcome.tell("jitter p99, median / most ms", (float(np.median(p99)), max(p99)) if p99 else None)
