"""What goes away in a stream, what a network does to a node, and ill-behaved robots: it must live, recover, count."""

from __future__ import annotations

import time

import psutil

from bench.stream import scores
from bench.stream.drive import Phase, RobotPlan, stamp_of
from bench.stream.processes import vandalise, wait_until
from bench.stream.stage import RATE, RATE_SHARE, Stage, until

FLOOD_POINTS = 166_667
MAX_GROWTH = 200.0  # MB
BACK_SOON, BACK_EVENTUALLY = 5.0, 20.0
"""Seconds until poses must be back: after a disturbance, and after a search."""
MAX_LEFT, MAX_TERM = 1.0, 2.0  # seconds of poses after the last odometry; seconds to end after SIGTERM
SETTLED = 20.0


def flood(stage: Stage) -> None:
    """Pour a hundred 2 MB frames a second for ten seconds."""
    begin, end, found, recorder = SETTLED, SETTLED + 10.0, stage.found, stage.recorder
    plan = RobotPlan("r1", end + 15.0, phases={"no_cloud": (begin, end)})
    much = RobotPlan("r1", end, begin=begin, cloud_period=0.01, odometry_period=0.0, points=FLOOD_POINTS)
    flooder, stream = stage.sender(much), stage.stream(plan)
    start = flooder.begin(stream.start)
    until(start + begin - 0.5)
    before = stage.megabytes()
    stage.ill_treated(stream)
    found.most("memory that stays, MB", stage.megabytes() - before, MAX_GROWTH)
    periods = ((0.0, start + begin - 0.5), (start, start + end + 5.0))
    earlier, now = (scores.counter(recorder.told("r1", *period), "dropped") or 0 for period in periods)
    found.some("frames counted as dropped", now - earlier)
    within = [pose.arrival for pose in recorder.poses("r1", start + begin, start + end)]
    rate = scores.rate_hz(scores.tracking_intervals(within, recorder.told("r1")))
    steady = rate is not None and abs(rate - RATE) <= RATE_SHARE * RATE
    found.judge("rate during the flood, Hz", rate, f"{RATE:.0f} +- {RATE_SHARE:.0%}", steady)
    stage.returned("poses after the flood, s", start + end, BACK_SOON, stamp_of(end))


def random(stage: Stage) -> None:
    """Random bytes on every input key and in queries; then a good stream."""
    found, long, rogue = stage.found, stage.seconds(60.0, 10.0), stage.helper(vandalise, stage.endpoint, "r1", 200.0)
    end = rogue.begin() + long
    replies = []
    for k in range(20):
        name, payload = ("relocalize", "reset")[k % 2], bytes(range(k * 7 % 256)) * k
        replies.append(stage.recorder.query("r1", name, payload, f"x={k};seconds=-1e999;{'y' * k}"))
    stage.recorder.query("r1", "no_such_thing")
    until(end)
    rogue.stop()
    count = rogue.result()
    time.sleep(2.0)
    told = stage.recorder.told("r1")
    found.none("poses during the rubbish", len(stage.recorder.poses("r1")))
    malformed = scores.counter(told, "malformed")
    found.judge("rubbish sent / counted as malformed", (count, malformed), "counted", bool(malformed))
    silent = scores.longest_silence([status.arrival for status in told], end - long, end)
    found.most("longest time without a status, s", silent, 2.5)
    answered = sum(bool(reply) for reply in replies)
    found.judge("queries answered", f"{answered} of 20", "all", answered == 20)
    found.stream(stage.ill_treated(stage.stream(RobotPlan("r1", 25.0))), "good stream after: ")


def backwards(stage: Stage) -> None:
    """Old stamps among new ones, twins, time running backwards, a stamp of tomorrow, a clock that restarts."""
    late, twice, reverse, future, restart = (15.0, 20.0), (23.0, 28.0), (31.0, 34.0), (41.0, 42.0), (50.0, 75.0)
    phases: dict[Phase, tuple[float, float]] = {
        "late": late, "twice": twice, "reversed": reverse, "future": future, "restart": restart,
    }  # fmt: skip
    plan, found = RobotPlan("r1", restart[1], phases=phases), stage.found
    stream = stage.stream(plan)
    start = stream.start
    stage.ill_treated(stream)
    restarted = start + restart[0]
    told, poses = stage.recorder.told("r1", start), stage.recorder.poses("r1", start)
    for name in ("out_of_order", "duplicate"):
        found.some(f"counted as {name}", scores.counter(told, name))
    ordered = [pose.stamp_ns for pose in poses if pose.arrival < restarted]
    found.none("stamps that go back, clock not restarted", scores.steps_back(ordered))
    found.none("poses stamped tomorrow", sum(stamp > stamp_of(restart[1] + 60) for stamp in ordered))
    arrivals = [pose.arrival for pose in poses]
    for name, (begin, end) in {"old among new": late, "twins": twice}.items():
        share = scores.share_posed(arrivals, start + begin, start + end)
        found.judge(f"time posed with {name}", share, ">= 0.95", share >= 0.95)
    stage.returned("poses after time ran backwards, s", start + reverse[1], BACK_SOON, stamp_of(reverse[1]))
    silence = scores.longest_silence(arrivals, start + future[0], restarted)
    found.most("longest silence after a stamp of tomorrow, s", silence, 2.0)
    stage.returned("poses after the clock restarted, s", restarted, BACK_EVENTUALLY, 0, stamp_of(0))


def router(stage: Stage) -> None:
    """Kill the router, bring it back at the same port after three seconds."""
    plan, found = RobotPlan("r1", SETTLED + 25.0), stage.found
    stream = stage.stream(plan)
    start = stream.start
    until(start + SETTLED)
    before = stage.recorder.told("r1")[-1].fields
    stage.router.kill()
    gone = time.monotonic()
    until(gone + 3.0)
    stage.start_router()
    back = time.monotonic()
    stage.ill_treated(stream, without=[(gone - 0.2, back)])
    stage.returned("poses back after the router's return, s", back, BACK_SOON, stamp_of(back - start))
    told = stage.recorder.told("r1", back)
    after = told[-1].fields if told else {}
    uptimes = (before.get("uptime_s"), after.get("uptime_s"))
    found.judge("uptime goes on, s", uptimes, "grows", (uptimes[1] or 0.0) > (uptimes[0] or 0.0))
    states = dict.fromkeys(status.state for status in told)
    never = bool(states) and "SEARCHING" not in states
    found.judge("did not search again", " ".join(states), "no SEARCHING", never)
    link = after.get("connection") or {}
    found.judge("status says so", str(link), "reconnects >= 1", bool(link.get("reconnects")))
    found.judge("token back", stage.recorder.alive("r1"), "True", stage.recorder.alive("r1"))


def odometry(stage: Stage) -> None:
    """Clouds without odometry for five seconds."""
    begin, end, found = SETTLED, SETTLED + 5.0, stage.found
    plan = RobotPlan("r1", end + 20.0, phases={"no_odometry": (begin, end)})
    stream = stage.stream(plan)
    start = stream.start
    stage.ill_treated(stream)
    poses = stage.recorder.poses("r1", start, start + end)
    left = poses[-1].arrival - start - begin if poses else None
    soon = left is not None and -0.3 < left <= MAX_LEFT
    found.judge("poses end after the odometry, s", left, f"0 to {MAX_LEFT:.0f}", soon)
    states = dict.fromkeys(status.state for status in stage.recorder.told("r1", start + begin, start + end))
    found.judge("state meanwhile", " ".join(states), "LOST", "LOST" in states)
    stage.returned("poses after it returned, s", start + end, BACK_SOON, stamp_of(end))


def sigterm(stage: Stage) -> None:
    """SIGTERM in the middle of a stream."""
    stream, found = stage.stream(RobotPlan("r1", 40.0)), stage.found
    until(stream.start + 15.0)
    family, moment = stage.family(), time.monotonic()
    code, seconds = stage.terminate()
    gone = wait_until(lambda: not stage.recorder.alive("r1"), 3.0)
    tokens = [at - moment for at, _, put in stage.recorder.tokens if not put]
    told = stage.recorder.told("r1", moment)
    stream.sender.stop()
    found.judge("exit code", code, "0", code == 0)
    found.judge("seconds to its end", seconds, f"< {MAX_TERM:.0f}", seconds < MAX_TERM)
    found.judge("statuses after the signal", len(told), ">= 1", len(told) >= 1)
    found.judge("token gone after, s", tokens[-1] if tokens else None, "gone", gone)
    found.none("processes left over", sum(p.is_running() and p.status() != psutil.STATUS_ZOMBIE for p in family))
    found.none("poses after its end", len(stage.recorder.poses("r1", moment + seconds + 0.2)))
    found.none("tracebacks in its log", sum("Traceback" in row for row in stage.log_lines()))
    found.numbers = {"log": stage.log_lines()[-20:]}
