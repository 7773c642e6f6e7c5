"""A stage for each scenario (router, node, recorder), and what every scenario measures of a stream."""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bench.stream import scores
from bench.stream.client import Helper, Recorder, Sent, free_port, route, send, wait_until
from bench.stream.drive import Drive, RobotPlan, content_of
from bench.stream.node import Node, foreign_seconds

_READY = 90.0  # seconds in which the node must announce all its robots
MOST_JITTER, RATE, RATE_SHARE, LEAST_POSED, MOST_FIRST_FIX = 15.0, 10.0, 0.02, 0.95, 20.0
"""Targets: ms, Hz, share of it, share of the time from the first fix on, metres."""

MOST_LAG = 0.3
"""Seconds; where a sender was later than that, the machine was too busy for any of the figures to mean anything."""


@dataclass
class Outcome:
    """What a scenario found: lines (what, measured, target, met or None if only told) and all numbers."""

    name: str
    lines: list[tuple[str, str, str, bool | None]] = field(default_factory=list)
    numbers: dict[str, Any] = field(default_factory=dict)

    def judge(self, what: str, measured: Any, target: str, met: bool | None) -> None:
        """Add a line with a verdict."""
        self.lines.append((what, shown(measured), target, met))

    def judge_machine(self, sent: Sent, label: str = "") -> None:
        """Say whether the measurement itself can be trusted."""
        lag = sent.longest_lag
        self.judge(f"{label}sender late by, s (else: measure again)", lag, f"<= {MOST_LAG}", lag <= MOST_LAG)

    def tell(self, what: str, measured: Any) -> None:
        """Add a line without one."""
        self.lines.append((what, shown(measured), "", None))

    @property
    def met(self) -> bool:
        """Whether no line missed its target."""
        return all(met is not False for *_, met in self.lines)


def shown(value: Any) -> str:
    """Write numbers briefly, nothing as a dash."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    if isinstance(value, (tuple, list)):
        return " / ".join(shown(part) for part in value)
    return str(value)


@dataclass
class Setting:
    """What all scenarios share: worlds, map, the node's command before its arguments, and how long."""

    world: Path
    stranger: Path
    site: Path
    command: Sequence[str]
    logs: Path
    quick: bool = False
    extra: Sequence[str] = ()

    def seconds(self, full: float, quick: float) -> float:
        """How long something lasts."""
        return quick if self.quick else full


class Stage:
    """Router, recorder and node, ready: ``with Stage(setting, name, robots) as stage``."""

    def __init__(self, setting: Setting, name: str, robots: Sequence[str], *arguments: str) -> None:
        self.setting, self.name, self.robots = setting, name, tuple(robots)
        self.port = free_port()
        self.endpoint = f"tcp/127.0.0.1:{self.port}"
        self.command = [
            *setting.command, str(setting.site), "--robot", *robots, "--connect", self.endpoint,
            *arguments, *setting.extra,
        ]  # fmt: skip
        self._senders: list[Helper] = []

    def __enter__(self) -> Stage:
        self.start_router()
        self.recorder = Recorder(self.endpoint).__enter__()
        begin = time.monotonic()
        log = Path(tempfile.mkstemp(suffix=".log", prefix=f"{self.name}-", dir=self.setting.logs)[1])
        self.node = Node(self.command, log)
        up = wait_until(lambda: all(map(self.recorder.alive, self.robots)) or not self.node.running(), _READY)
        self.start_s = time.monotonic() - begin
        self._began = (time.monotonic(), foreign_seconds())
        if not up or not self.node.running():
            tail = "\n".join(self.node.log_lines()[-15:])
            self.__exit__()
            raise RuntimeError(f"the node did not announce {self.robots} in {_READY} s:\n{tail}")
        return self

    def __exit__(self, *_: object) -> None:
        for helper in [*self._senders, self.router]:
            if helper.process.is_alive():
                helper.kill()
        self.node.__exit__()
        self.recorder.__exit__()

    def foreign_cores(self) -> float:
        """Processors that other programs kept busy since the node was ready: the noise in every jitter."""
        begin, seconds = self._began
        return (foreign_seconds() - seconds) / (time.monotonic() - begin)

    def start_router(self) -> None:
        """Start the router; also again, at the same port."""
        self.router = Helper(route, self.port)
        self.router.ready()

    def sender(self, *plans: RobotPlan, world: Path | None = None) -> Helper:
        """Return a sender that has loaded its frames and waits for its beginning."""
        helper = self.helper(send, self.endpoint, str(world or self.setting.world), plans)
        helper.ready()
        return helper

    def helper(self, work: Any, *args: Any) -> Helper:
        """Start any process that ends with the stage."""
        helper = Helper(work, *args)
        self._senders.append(helper)
        return helper

    def drive(self, robot: str, frame_seconds: float = 0.1) -> Drive:
        """Return the robot's drive, for its truth."""
        return Drive(self.setting.world, robot, frame_seconds)


def until(moment: float) -> None:
    """Sleep until a monotonic time."""
    time.sleep(max(0.0, moment - time.monotonic()))


def measure(
    stage: Stage,
    plan: RobotPlan,
    sent: Sent,
    start: float,
    end: float | None = None,
    without: Sequence[tuple[float, float]] = (),
) -> dict[str, Any]:
    """All numbers of a robot's stream that began at ``start``; seconds, metres, degrees unless named otherwise."""
    recorder, drive = stage.recorder, stage.drive(plan.robot, plan.frame_seconds)
    end = start + plan.seconds if end is None else end
    poses, told = recorder.poses(plan.robot, start, end), recorder.told(plan.robot, start, end)
    arrivals = [pose.arrival for pose in poses]
    metres, degrees = scores.errors(poses, drive.truth)
    intervals = scores.tracking_intervals(arrivals, told, without)
    floor = scores.tracking_intervals(recorder.ticks(start, end), [], without)
    puts = sent.puts[plan.robot]
    first = poses[0] if poses else None
    last = told[-1].fields if told else {}
    rmse = (float(np.sqrt(np.mean(metres**2))), float(np.sqrt(np.mean(degrees**2)))) if poses else None
    return {
        "poses": len(poses),
        "unreadable": recorder.unreadable,
        "false": scores.false_poses(metres, degrees),
        "first_fix_s": first.arrival - start if first else None,
        "first_fix_m": drive.metres(content_of(first.stamp_ns)) if first else None,
        "rmse_m_deg": rmse,
        "worst_m_deg": (float(metres.max()), float(degrees.max())) if poses else None,
        "rate_hz": scores.rate_hz(intervals),
        "jitter_ms": scores.jitter_ms(intervals),
        "longest_interval_s": float(intervals.max()) if len(intervals) else None,
        "machine_jitter_ms": scores.jitter_ms(floor),
        "steps_back": scores.steps_back([pose.stamp_ns for pose in poses]),
        "same_stamps": sum(a.stamp_ns == b.stamp_ns for a, b in itertools.pairwise(poses)),
        "share_posed": scores.share_posed(arrivals, first.arrival, end) if first else 0.0,
        "cloud_to_pose_ms": scores.percentiles_ms(scores.reaction(puts, scores.corrected(poses))),
        "cloud_to_status_ms": scores.percentiles_ms(scores.staleness(puts, scores.processed(told))),
        "pose_age_ms": scores.percentiles_ms(np.array([pose.age for pose in poses if pose.age is not None])),
        "statuses": len(told),
        "states": _in_a_row([status.state for status in told]),
        "node_latency_ms": last.get("latency_ms"),
        "node_pose": last.get("pose"),
        "counters": last.get("counters"),
        "node_errors": last.get("errors"),
        "sender_lag_put_s": (sent.longest_lag, sent.longest_put),
        "clouds_sent": len(puts),
        "node_start_s": stage.start_s,
        "node_megabytes": stage.node.megabytes(),
        "foreign_cores": stage.foreign_cores(),
    }


def report_stream(outcome: Outcome, numbers: dict[str, Any], label: str = "", jitter: bool = True) -> None:
    """Judge a stream that ought to have been served well from its first fix on."""
    rate, spread = numbers["rate_hz"], numbers["jitter_ms"]
    fix = numbers["first_fix_m"]
    outcome.judge(
        f"{label}first fix, s / m", (numbers["first_fix_s"], fix), f"<= {MOST_FIRST_FIX:.0f} m",
        fix is not None and fix <= MOST_FIRST_FIX,
    )  # fmt: skip
    false = numbers["false"] + numbers["unreadable"]
    outcome.judge(f"{label}false or unreadable poses", f"{false} of {numbers['poses']}", "0", false == 0)
    outcome.tell(f"{label}RMSE, m / deg", numbers["rmse_m_deg"])
    outcome.tell(f"{label}worst, m / deg", numbers["worst_m_deg"])
    steady = rate is not None and abs(rate - RATE) <= RATE_SHARE * RATE
    outcome.judge(f"{label}rate while TRACKING, Hz", rate, f"{RATE:.0f} +- {RATE_SHARE:.0%}", steady)
    still = spread is not None and spread[1] < MOST_JITTER
    outcome.judge(
        f"{label}jitter p50 / p99, ms",
        spread,
        f"p99 < {MOST_JITTER:.0f}" if jitter else "",
        still if jitter else None,
    )
    outcome.tell(
        f"{label}... of the machine itself, ms; cores others used",
        (numbers["machine_jitter_ms"], numbers["foreign_cores"]),
    )
    back = numbers["steps_back"]
    outcome.judge(f"{label}stamps that go back", back, "0", back == 0)
    share = numbers["share_posed"]
    outcome.judge(f"{label}time posed after the first fix", share, f">= {LEAST_POSED}", share >= LEAST_POSED)
    outcome.tell(f"{label}cloud to pose p50/p95/p99, ms", numbers["cloud_to_pose_ms"])
    outcome.tell(f"{label}newest frame in status p50/p95/p99, ms", numbers["cloud_to_status_ms"])
    outcome.tell(f"{label}latency as the node says", numbers["node_latency_ms"])
    outcome.tell(f"{label}states", " ".join(numbers["states"]))


def _in_a_row(states: Sequence[str]) -> list[str]:
    """Without repetitions."""
    return [state for k, state in enumerate(states) if k == 0 or state != states[k - 1]]
