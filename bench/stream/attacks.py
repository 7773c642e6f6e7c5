"""What a network does to a node, and what ill-behaved robots do: it must live, recover, and count it."""

from __future__ import annotations

import time
from typing import Any

from bench.stream import scores
from bench.stream.drive import Phase, RobotPlan, stamp_of
from bench.stream.rogue import vandalise
from bench.stream.stage import Outcome, Setting, Stage, measure, report_stream, until

FLOOD_POINTS = 166_667
MOST_GROWTH, MOST_LOG = 200.0, 200
"""MB, lines."""
BACK_SOON, BACK_EVENTUALLY = 5.0, 20.0
"""Seconds until poses must be back: after a disturbance, and after a search."""

SETTLED = 20.0


def judge_return(
    outcome: Outcome,
    stage: Stage,
    what: str,
    moment: float,
    limit: float,
    first_ns: int,
    last_ns: int | None = None,
) -> None:
    """Judge how soon after ``moment`` poses came again that are stamped ``first_ns`` or later (to ``last_ns``)."""
    newer = [pose for pose in stage.recorder.poses("r1", moment) if pose.stamp_ns >= first_ns]
    poses = [pose for pose in newer if last_ns is None or pose.stamp_ns <= last_ns]
    after = poses[0].arrival - moment if poses else None
    outcome.judge(what, after, f"<= {limit:.0f}", after is not None and after <= limit)


def judge_common(outcome: Outcome, stage: Stage, numbers: dict[str, Any]) -> None:
    """Judge what any ill treatment must leave intact."""
    outcome.numbers.update(numbers)
    outcome.judge("node alive", stage.node.running(), "True", stage.node.running())
    false = numbers["false"] + numbers["unreadable"]
    outcome.judge("false or unreadable poses", f"{false} of {numbers['poses']}", "0", false == 0)
    outcome.tell("first fix, s / m", (numbers["first_fix_s"], numbers["first_fix_m"]))
    outcome.tell("states", " ".join(numbers["states"]))
    outcome.tell("counters", numbers["counters"])
    lost = scores.unaccounted(numbers["counters"])
    outcome.judge(
        "frames received of unknown fate", lost, "<= 3 underway", lost is not None and 0 <= lost <= 3
    )
    outcome.tell("errors told", numbers["node_errors"])
    lines = len(stage.node.log_lines())
    outcome.judge("lines of log", lines, f"<= {MOST_LOG}", lines <= MOST_LOG)


def flood(setting: Setting) -> Outcome:
    """Pour a hundred 2 MB frames a second for ten seconds."""
    outcome = Outcome("flood")
    begin, end = SETTLED, SETTLED + 10.0
    plan = RobotPlan("r1", end + 15.0, phases=(Phase(begin, end, "no_clouds"),))
    much = RobotPlan("r1", end, begin=begin, cloud_period=0.01, odometry_period=0.0, points=FLOOD_POINTS)
    with Stage(setting, outcome.name, ["r1"]) as stage:
        flooder, sender = stage.sender(much), stage.sender(plan)
        start = sender.begin()
        flooder.begin(start)
        until(start + begin - 0.5)
        before, memory = stage.node.megabytes(), []
        counted = stage.recorder.told("r1")[-1:]
        while time.monotonic() < start + end:
            memory.append(stage.node.megabytes())
            time.sleep(0.5)
        sent, poured = sender.result(), flooder.result()
        after = stage.node.megabytes()
        numbers = measure(stage, plan, sent, start)
        judge_common(outcome, stage, numbers)
        outcome.judge_machine(sent)
        outcome.tell(
            "flood: frames put, longest lag / put, s",
            (poured.messages, poured.longest_lag, poured.longest_put),
        )
        outcome.tell("memory before / most / after, MB", (before, max(memory), after))
        outcome.judge(
            "memory that stays, MB", after - before, f"<= {MOST_GROWTH:.0f}", after - before <= MOST_GROWTH
        )
        told = stage.recorder.told("r1", start, start + end + 5)
        dropped = (scores.counter(told, "dropped") or 0) - (scores.counter(counted, "dropped") or 0)
        outcome.judge("frames counted as dropped", dropped, "> 0", dropped > 0)
        within = [pose.arrival for pose in stage.recorder.poses("r1", start + begin, start + end)]
        steps = scores.tracking_intervals(within, stage.recorder.told("r1"))
        rate = scores.rate_hz(steps)
        steady = rate is not None and abs(rate - 10) <= 0.2
        outcome.judge("rate during the flood, Hz", rate, "10 +- 2%", steady)
        outcome.tell("jitter during the flood p50 / p99, ms", scores.jitter_ms(steps))
        outcome.tell(
            "... of the machine itself, ms",
            scores.jitter_ms(scores.tracking_intervals(stage.recorder.ticks(start + begin, start + end), [])),
        )
        outcome.numbers["flood"] = {
            "rate_hz": rate,
            "jitter_ms": scores.jitter_ms(steps),
            "memory_mb": memory,
        }
        share = scores.share_posed(within, start + begin, start + end)
        outcome.tell("time posed during the flood", share)
        judge_return(outcome, stage, "poses after the flood, s", start + end, BACK_SOON, stamp_of(end))
    return outcome


def random(setting: Setting) -> Outcome:
    """Random bytes on every input key and in queries; then a good stream."""
    outcome = Outcome("random")
    plan = RobotPlan("r1", 25.0)
    with Stage(setting, outcome.name, ["r1"]) as stage:
        sender = stage.sender(plan)
        rogue = stage.helper(vandalise, stage.endpoint, ["r1"], 200.0)
        rogue.ready()
        memory = stage.node.megabytes()
        end = rogue.begin() + setting.seconds(60.0, 10.0)
        replies = []
        for k in range(20):
            name, payload = ("relocalize", "reset")[k % 2], bytes(range(k * 7 % 256)) * k
            replies.append(stage.recorder.query("r1", name, payload, f"x={k};seconds=-1e999;{'y' * k}"))
        replies.append(stage.recorder.query("r1", "no_such_thing"))
        until(end)
        rogue.ask_to_stop()
        count = rogue.result()
        time.sleep(2.0)
        told = stage.recorder.told("r1")
        before = stage.recorder.poses("r1")
        outcome.judge("poses during the rubbish", len(before), "0", not before)
        malformed = scores.counter(told, "malformed")
        outcome.judge("rubbish sent / counted as malformed", (count, malformed), "counted", bool(malformed))
        outcome.tell("all counters after it", told[-1].fields.get("counters") if told else None)
        silent = scores.longest_silence(
            [status.arrival for status in told], end - setting.seconds(60.0, 10.0), end
        )
        outcome.judge("longest time without a status, s", silent, "<= 2.5", silent <= 2.5)
        answered = sum(bool(reply) for reply in replies[:-1])
        outcome.judge("queries answered", f"{answered} of 20", "all", answered == 20)
        outcome.tell("first answers", replies[:2])
        outcome.tell("memory before / after the rubbish, MB", (memory, stage.node.megabytes()))
        outcome.tell("errors in status", told[-1].fields.get("errors") if told else None)
        start = sender.begin()
        sent = sender.result()
        numbers = measure(stage, plan, sent, start)
        judge_common(outcome, stage, numbers)
        outcome.judge_machine(sent)
        report_stream(outcome, numbers, "good stream after: ")
    return outcome


def backwards(setting: Setting) -> Outcome:
    """Old stamps among new ones, twins, time running backwards, a stamp of tomorrow, a clock that restarts."""
    outcome = Outcome("backwards")
    late, twice, reverse, future, restart = (
        (15.0, 20.0),
        (23.0, 28.0),
        (31.0, 34.0),
        (41.0, 42.0),
        (50.0, 75.0),
    )
    phases = (
        Phase(*late, "late"), Phase(*twice, "twice"), Phase(*reverse, "reversed"), Phase(*future, "future"),
        Phase(*restart, "restart"),
    )  # fmt: skip
    plan = RobotPlan("r1", restart[1], phases=phases)
    with Stage(setting, outcome.name, ["r1"]) as stage:
        sender = stage.sender(plan)
        start = sender.begin()
        sent = sender.result()
        numbers = measure(stage, plan, sent, start)
        judge_common(outcome, stage, numbers)
        outcome.judge_machine(sent)
        told = stage.recorder.told("r1", start)
        for name in ("out_of_order", "duplicate"):
            value = scores.counter(told, name)
            outcome.judge(f"counted as {name}", value, "> 0", bool(value))
        ordered = [pose.stamp_ns for pose in stage.recorder.poses("r1", start, start + restart[0])]
        back = scores.steps_back(ordered)
        outcome.judge("stamps that go back, clock not restarted", back, "0", back == 0)
        ahead = sum(stamp > stamp_of(restart[1] + 60) for stamp in ordered)
        outcome.judge("poses stamped tomorrow", ahead, "0", ahead == 0)
        arrivals = [pose.arrival for pose in stage.recorder.poses("r1", start)]
        for name, (begin, end) in {"old among new": late, "twins": twice}.items():
            share = scores.share_posed(arrivals, start + begin, start + end)
            outcome.judge(f"time posed with {name}", share, ">= 0.95", share >= 0.95)
        judge_return(
            outcome,
            stage,
            "poses after time ran backwards, s",
            start + reverse[1],
            BACK_SOON,
            stamp_of(reverse[1]),
        )
        silence = scores.longest_silence(arrivals, start + future[0], start + restart[0])
        outcome.judge("longest silence after a stamp of tomorrow, s", silence, "<= 2", silence <= 2.0)
        restarted = start + restart[0]
        judge_return(
            outcome, stage, "poses after the clock restarted, s", restarted, BACK_EVENTUALLY, 0, stamp_of(0)
        )
    return outcome
