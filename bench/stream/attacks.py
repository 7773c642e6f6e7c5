"""What goes away in the middle of a stream, what a network does to a node, and what ill-behaved robots do.

The node must live, recover, and count it.
"""

from __future__ import annotations

import time
from typing import Any

from bench.stream import scores
from bench.stream.client import vandalise, wait_until
from bench.stream.drive import Phase, RobotPlan, stamp_of
from bench.stream.stage import Outcome, Setting, Stage, until

FLOOD_POINTS = 166_667
MOST_GROWTH, MOST_LOG = 200.0, 200  # MB, lines
BACK_SOON, BACK_EVENTUALLY = 5.0, 20.0
"""Seconds until poses must be back: after a disturbance, and after a search."""
LONGEST_LEFT, MOST_TERM = 1.0, 2.0  # seconds of poses after the last odometry; seconds to end after SIGTERM
SETTLED = 20.0


def judge_return(
    outcome: Outcome, stage: Stage, what: str, moment: float, limit: float, first: int, last: int | None = None
) -> None:
    """Judge how soon after ``moment`` poses came again whose stamps are ``first`` or later (to ``last``), ns."""
    newer = [pose for pose in stage.recorder.poses("r1", moment) if pose.stamp_ns >= first]
    poses = [pose for pose in newer if last is None or pose.stamp_ns <= last]
    outcome.most(what, poses[0].arrival - moment if poses else None, limit)


def judge_common(outcome: Outcome, stage: Stage, plan: RobotPlan, sent: Any, start: float, **options: Any) -> Any:
    """Measure, and judge what any ill treatment must leave intact."""
    numbers = stage.measure(plan, sent, start, **options)
    outcome.numbers.update(numbers)
    outcome.judge("node alive", stage.node.running(), "True", stage.node.running())
    outcome.none("false or unreadable poses", numbers["false"] + numbers["unreadable"], numbers["poses"])
    outcome.tell("first fix, s / m", (numbers["first_fix_s"], numbers["first_fix_m"]))
    outcome.tell("states", " ".join(numbers["states"]))
    outcome.tell("counters", numbers["counters"])
    lost = scores.unaccounted(numbers["counters"])
    known = lost is not None and 0 <= lost <= 3
    outcome.judge("frames received of unknown fate", lost, "<= 3 underway", known)
    outcome.tell("errors told", numbers["node_errors"])
    outcome.most("lines of log", len(stage.node.log_lines()), MOST_LOG)
    outcome.machine(sent)
    return numbers


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
        judge_common(outcome, stage, plan, sent, start)
        lags = (poured.messages, poured.longest_lag, poured.longest_put)
        outcome.tell("flood: frames put, longest lag / put, s", lags)
        outcome.tell("memory before / most / after, MB", (before, max(memory), after))
        outcome.most("memory that stays, MB", after - before, MOST_GROWTH)
        told = stage.recorder.told("r1", start, start + end + 5)
        dropped = (scores.counter(told, "dropped") or 0) - (scores.counter(counted, "dropped") or 0)
        outcome.some("frames counted as dropped", dropped)
        within = [pose.arrival for pose in stage.recorder.poses("r1", start + begin, start + end)]
        steps = scores.tracking_intervals(within, stage.recorder.told("r1"))
        rate = scores.rate_hz(steps)
        steady = rate is not None and abs(rate - 10) <= 0.2
        outcome.judge("rate during the flood, Hz", rate, "10 +- 2%", steady)
        outcome.tell("jitter during the flood p50 / p99, ms", scores.jitter_ms(steps))
        ticks = scores.tracking_intervals(stage.recorder.ticks(start + begin, start + end), [])
        outcome.tell("... of the machine itself, ms", scores.jitter_ms(ticks))
        outcome.numbers["flood"] = {"rate_hz": rate, "jitter_ms": scores.jitter_ms(steps), "memory_mb": memory}
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
        memory, long = stage.node.megabytes(), setting.seconds(60.0, 10.0)
        end = rogue.begin() + long
        replies = []
        for k in range(20):
            name, payload = ("relocalize", "reset")[k % 2], bytes(range(k * 7 % 256)) * k
            replies.append(stage.recorder.query("r1", name, payload, f"x={k};seconds=-1e999;{'y' * k}"))
        stage.recorder.query("r1", "no_such_thing")
        until(end)
        rogue.ask_to_stop()
        count = rogue.result()
        time.sleep(2.0)
        told = stage.recorder.told("r1")
        outcome.none("poses during the rubbish", len(stage.recorder.poses("r1")))
        malformed = scores.counter(told, "malformed")
        outcome.judge("rubbish sent / counted as malformed", (count, malformed), "counted", bool(malformed))
        last = told[-1].fields if told else {}
        outcome.tell("all counters after it", last.get("counters"))
        silent = scores.longest_silence([status.arrival for status in told], end - long, end)
        outcome.most("longest time without a status, s", silent, 2.5)
        answered = sum(bool(reply) for reply in replies)
        outcome.judge("queries answered", f"{answered} of 20", "all", answered == 20)
        outcome.tell("first answers", replies[:2])
        outcome.tell("memory before / after the rubbish, MB", (memory, stage.node.megabytes()))
        outcome.tell("errors in status", last.get("errors"))
        start = sender.begin()
        outcome.stream(judge_common(outcome, stage, plan, sender.result(), start), "good stream after: ")
    return outcome


def backwards(setting: Setting) -> Outcome:
    """Old stamps among new ones, twins, time running backwards, a stamp of tomorrow, a clock that restarts."""
    outcome = Outcome("backwards")
    late, twice, reverse, future, restart = ((15.0, 20.0), (23.0, 28.0), (31.0, 34.0), (41.0, 42.0), (50.0, 75.0))
    phases = (
        Phase(*late, "late"), Phase(*twice, "twice"), Phase(*reverse, "reversed"), Phase(*future, "future"),
        Phase(*restart, "restart"),
    )  # fmt: skip
    plan = RobotPlan("r1", restart[1], phases=phases)
    with Stage(setting, outcome.name, ["r1"]) as stage:
        sender = stage.sender(plan)
        start = sender.begin()
        judge_common(outcome, stage, plan, sender.result(), start)
        told = stage.recorder.told("r1", start)
        for name in ("out_of_order", "duplicate"):
            outcome.some(f"counted as {name}", scores.counter(told, name))
        restarted = start + restart[0]
        ordered = [pose.stamp_ns for pose in stage.recorder.poses("r1", start, restarted)]
        outcome.none("stamps that go back, clock not restarted", scores.steps_back(ordered))
        outcome.none("poses stamped tomorrow", sum(stamp > stamp_of(restart[1] + 60) for stamp in ordered))
        arrivals = [pose.arrival for pose in stage.recorder.poses("r1", start)]
        for name, (begin, end) in {"old among new": late, "twins": twice}.items():
            share = scores.share_posed(arrivals, start + begin, start + end)
            outcome.judge(f"time posed with {name}", share, ">= 0.95", share >= 0.95)
        moment, soon = start + reverse[1], stamp_of(reverse[1])
        judge_return(outcome, stage, "poses after time ran backwards, s", moment, BACK_SOON, soon)
        silence = scores.longest_silence(arrivals, start + future[0], restarted)
        outcome.most("longest silence after a stamp of tomorrow, s", silence, 2.0)
        what = "poses after the clock restarted, s"
        judge_return(outcome, stage, what, restarted, BACK_EVENTUALLY, 0, stamp_of(0))
    return outcome


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
        judge_common(outcome, stage, plan, sender.result(), start, without=[(gone - 0.2, back)])
        told, ticks = stage.recorder.told("r1", back), stage.recorder.ticks(back)
        outcome.tell("the recorder itself was back after, s", ticks[0] - back if ticks else None)
        what = "poses back after the router's return, s"
        judge_return(outcome, stage, what, back, BACK_SOON, stamp_of(back - start))
        after = told[-1].fields if told else {}
        uptimes = (before.get("uptime_s"), after.get("uptime_s"))
        outcome.judge("uptime goes on, s", uptimes, "grows", (uptimes[1] or 0.0) > (uptimes[0] or 0.0))
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
        judge_common(outcome, stage, plan, sender.result(), start)
        poses = stage.recorder.poses("r1", start, start + end)
        left = poses[-1].arrival - start - begin if poses else None
        soon = left is not None and -0.3 < left <= LONGEST_LEFT
        outcome.judge("poses end after the odometry, s", left, f"0 to {LONGEST_LEFT:.0f}", soon)
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
        last = [(round(s.arrival - moment, 3), s.state, s.fields.get("reason")) for s in told[-1:]]
        outcome.tell("the last one", last)
        outcome.judge("token gone after, s", tokens[-1] if tokens else None, "gone", gone)
        outcome.none("processes left over", stage.node.orphans(family))
        outcome.none("poses after its end", len(stage.recorder.poses("r1", moment + seconds + 0.2)))
        lines = stage.node.log_lines()
        outcome.none("tracebacks in its log", sum("Traceback" in row for row in lines))
        outcome.numbers = {"exit_code": code, "seconds": seconds, "statuses": len(told), "log": lines[-20:]}
    return outcome
