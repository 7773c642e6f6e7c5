"""What goes away in the middle of a stream: the router, the odometry, the node itself."""

from __future__ import annotations

import time

from bench.stream.attacks import BACK_SOON, SETTLED, judge_common, judge_return
from bench.stream.client import wait_until
from bench.stream.drive import Phase, RobotPlan, stamp_of
from bench.stream.stage import Outcome, Setting, Stage, measure, until

LONGEST_LEFT, MOST_TERM = 1.0, 2.0
"""Seconds of poses after the last odometry; seconds to end after SIGTERM."""


def router(setting: Setting) -> Outcome:
    """Kill the router, bring it back at the same port after three seconds."""
    outcome = Outcome("router")
    plan = RobotPlan("r1", SETTLED + 25.0)
    with Stage(setting, outcome.name, ["r1"]) as stage:
        sender = stage.sender(plan)
        start = sender.begin()
        until(start + SETTLED)
        before = stage.recorder.told("r1")[-1].fields
        stage.router.kill()
        gone = time.monotonic()
        until(gone + 3.0)
        stage.start_router()
        back = time.monotonic()
        sent = sender.result()
        numbers = measure(stage, plan, sent, start, without=[(gone - 0.2, back)])
        judge_common(outcome, stage, numbers)
        outcome.judge_machine(sent)
        told = stage.recorder.told("r1", back)
        ticks = stage.recorder.ticks(back)
        outcome.tell("the recorder itself was back after, s", ticks[0] - back if ticks else None)
        judge_return(
            outcome, stage, "poses back after the router's return, s", back, BACK_SOON, stamp_of(back - start)
        )
        after = told[-1].fields if told else {}
        kept = after.get("uptime_s", 0.0) > before.get("uptime_s", 0.0)
        outcome.judge("uptime goes on, s", (before.get("uptime_s"), after.get("uptime_s")), "grows", kept)
        states = [status.state for status in told]
        never = bool(states) and "SEARCHING" not in states
        outcome.judge("did not search again", " ".join(dict.fromkeys(states)), "no SEARCHING", never)
        link = after.get("connection") or {}
        outcome.judge("status says so", str(link), "reconnects >= 1", bool(link.get("reconnects")))
        outcome.judge("token back", stage.recorder.alive("r1"), "True", stage.recorder.alive("r1"))
    return outcome


def odometry(setting: Setting) -> Outcome:
    """Clouds without odometry for five seconds."""
    outcome = Outcome("odometry")
    begin, end = SETTLED, SETTLED + 5.0
    plan = RobotPlan("r1", end + 20.0, phases=(Phase(begin, end, "no_odometry"),))
    with Stage(setting, outcome.name, ["r1"]) as stage:
        sender = stage.sender(plan)
        start = sender.begin()
        sent = sender.result()
        numbers = measure(stage, plan, sent, start)
        judge_common(outcome, stage, numbers)
        outcome.judge_machine(sent)
        poses = stage.recorder.poses("r1", start, start + end)
        left = poses[-1].arrival - start - begin if poses else None
        soon = left is not None and left <= LONGEST_LEFT
        outcome.judge(
            "poses end after the odometry, s",
            left,
            f"0 to {LONGEST_LEFT:.0f}",
            soon and left is not None and left > -0.3,
        )
        told = stage.recorder.told("r1", start + begin, start + end)
        states = [status.state for status in told]
        outcome.judge("state meanwhile", " ".join(dict.fromkeys(states)), "LOST", "LOST" in states)
        reasons = {str(status.fields.get("reason")) for status in told if status.state == "LOST"}
        outcome.tell("reason told", "; ".join(sorted(reasons)))
        judge_return(outcome, stage, "poses after it returned, s", start + end, BACK_SOON, stamp_of(end))
    return outcome


def sigterm(setting: Setting) -> Outcome:
    """SIGTERM in the middle of a stream."""
    outcome = Outcome("sigterm")
    plan = RobotPlan("r1", 40.0)
    with Stage(setting, outcome.name, ["r1"]) as stage:
        sender = stage.sender(plan)
        start = sender.begin()
        until(start + 15.0)
        family, posed = stage.node.family(), len(stage.recorder.poses("r1"))
        moment = time.monotonic()
        code, seconds = stage.node.terminate()
        gone = wait_until(lambda: not stage.recorder.alive("r1"), 3.0)
        tokens = [at - moment for at, _, put in stage.recorder.tokens if not put]
        told = stage.recorder.told("r1", moment)
        sender.ask_to_stop()
        outcome.tell("poses until then", posed)
        outcome.judge("exit code", code, "0", code == 0)
        outcome.judge("seconds to its end", seconds, f"< {MOST_TERM:.0f}", seconds < MOST_TERM)
        outcome.judge("statuses after the signal", len(told), ">= 1", len(told) >= 1)
        outcome.tell(
            "the last one",
            [(round(s.arrival - moment, 3), s.state, s.fields.get("reason")) for s in told[-1:]],
        )
        outcome.judge("token gone after, s", tokens[-1] if tokens else None, "gone", gone)
        left = stage.node.orphans(family)
        outcome.judge("processes left over", left, "0", left == 0)
        late = len(stage.recorder.poses("r1", moment + seconds + 0.2))
        outcome.judge("poses after its end", late, "0", late == 0)
        lines = stage.node.log_lines()
        traced = sum("Traceback" in row for row in lines)
        outcome.judge("tracebacks in its log", traced, "0", traced == 0)
        outcome.numbers = {"exit_code": code, "seconds": seconds, "statuses": len(told), "log": lines[-20:]}
    return outcome
