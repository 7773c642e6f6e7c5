"""A stage for each scenario: router, node and recorder; the measures of a stream, and the rows of a scenario."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from bench.accuracy.scores import rms
from bench.harness.node import Node
from bench.harness.rows import Row, judged
from bench.stream import scores
from bench.stream.processes import Drive, Helper, Recorder, RobotPlan, Sent, free_port, route, send, wait_until

_READY = 90.0  # seconds in which the node must announce all its robots
MAX_JITTER, RATE, RATE_SHARE, MIN_POSED, MAX_FIRST_FIX = 15.0, 10.0, 0.02, 0.95, 20.0
"""Targets: ms, Hz, share of it, share of the time from the first fix on, metres."""

MAX_LAG = 0.3
"""Seconds; where a sender was later than that, the machine was too busy for any of the figures to mean anything."""


@dataclass
class Findings:
    """Rows of a scenario, and all its numbers."""

    name: str
    rows: list[Row] = field(default_factory=list)
    numbers: dict[str, Any] = field(default_factory=dict)

    def judge(self, what: str, measured: Any, target: str = "", met: bool | None = None) -> None:
        """Add a row; without a target it informs."""
        value = float(measured) if isinstance(measured, (int, float)) else float("nan")
        self.rows.append(judged(f"stream/{self.name}/{what}", shown(measured)[:110], target, met, value))

    def most(self, what: str, value: float | None, limit: float) -> None:
        """Add a row of a number that must be there and may be ``limit`` at most."""
        self.judge(what, value, f"<= {limit:g}", value is not None and value <= limit)

    def none(self, what: str, count: int, of: int | None = None) -> None:
        """Add a row of a count, perhaps of so many, that must be zero."""
        self.judge(what, count if of is None else f"{count} of {of}", "0", count == 0)

    def stream(self, numbers: dict[str, Any], label: str = "") -> None:
        """Judge a stream that ought to have been served well from its first fix on."""
        rate, jitter, fix, share = (numbers[key] for key in ("rate_hz", "jitter_ms", "first_fix_m", "share_posed"))
        found = fix is not None and fix <= MAX_FIRST_FIX
        self.judge(f"{label}first fix, s / m", (numbers["first_fix_s"], fix), f"<= {MAX_FIRST_FIX:.0f} m", found)
        self.none(f"{label}false or unreadable poses", numbers["false"] + numbers["unreadable"], numbers["poses"])
        self.judge(f"{label}RMSE, m / deg", numbers["rmse_m_deg"])
        steady = rate is not None and abs(rate - RATE) <= RATE_SHARE * RATE
        self.judge(f"{label}rate while TRACKING, Hz", rate, f"{RATE:.0f} +- {RATE_SHARE:.0%}", steady)
        still = jitter is not None and jitter[1] < MAX_JITTER
        self.judge(f"{label}jitter p50 / p99, ms", jitter, f"p99 < {MAX_JITTER:.0f}", still)
        self.judge(f"{label}... of the machine itself, ms", numbers["machine_jitter_ms"])
        self.none(f"{label}stamps that go back", numbers["steps_back"])
        self.judge(f"{label}time posed after the first fix", share, f">= {MIN_POSED}", share >= MIN_POSED)
        self.judge(f"{label}cloud to pose p50/p95/p99, ms", numbers["cloud_to_pose_ms"])


def shown(value: Any) -> str:
    """Write numbers briefly, nothing as a dash."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    if isinstance(value, (tuple, list)):
        return " / ".join(shown(part) for part in value)
    return str(value)


class Setting(NamedTuple):
    """What all scenarios share: the world, another one, the first one's map, and how long."""

    world: Path
    stranger: Path
    site: Path
    quick: bool


class Stage:
    """Router, recorder and a node started through the command line, ready; the node is watched from outside."""

    def __init__(self, setting: Setting, found: Findings, robots: Sequence[str], *arguments: str) -> None:
        self.setting, self.found, self.robots = setting, found, tuple(robots)
        self._arguments = arguments
        self._helpers: list[Helper] = []

    def __enter__(self) -> Stage:
        port = free_port()
        self.endpoint = f"tcp/127.0.0.1:{port}"
        self.helper(route, port)
        self.recorder = Recorder(self.endpoint).__enter__()
        words = ("--no-state", "--robot", *self.robots, "--connect", self.endpoint, *self._arguments)
        self.node = Node(self.setting.site, self.setting.world / f"{self.found.name}.log", *words)
        wait_until(lambda: all(map(self.recorder.alive, self.robots)) or not self.running(), _READY)
        if not self.running() or not all(map(self.recorder.alive, self.robots)):
            tail = "\n".join(self.node.log.read_text(errors="replace").splitlines()[-15:])
            self.__exit__()
            raise RuntimeError(f"the node did not announce {self.robots} in {_READY} s:\n{tail}")
        return self

    def __exit__(self, *_: object) -> None:
        for helper in self._helpers:
            if helper.process.is_alive():
                helper.kill()
        if self.node.end()[0] == math.inf:
            print("the node did not end after SIGTERM; killed")
        self.recorder.__exit__()

    def running(self) -> bool:
        """Whether the node's main process lives."""
        return self.node.process.poll() is None

    def seconds(self, full: float, quick: float) -> float:
        """How long something lasts."""
        return quick if self.setting.quick else full

    def helper(self, work: Any, *args: Any) -> Helper:
        """Start a process that ends with the stage, and wait until it has loaded what it needs."""
        self._helpers.append(Helper(work, *args))
        return self._helpers[-1]

    def sender(self, *plans: RobotPlan, world: Path | None = None) -> Helper:
        """Return a sender that waits for its beginning."""
        return self.helper(send, self.endpoint, world or self.setting.world, plans)

    def sent(self, sender: Helper, label: str = "") -> Sent:
        """Wait for a sender's end, and judge whether the measurement itself can be trusted."""
        sent: Sent = sender.result()
        self.found.most(f"{label}sender late by, s (else: measure again)", sent.longest_lag, MAX_LAG)
        return sent

    def measure(self, plan: RobotPlan, sent: Sent, start: float) -> dict[str, Any]:
        """All numbers of a robot's stream that began at ``start``; seconds, metres, degrees unless named otherwise."""
        recorder, drive, end = self.recorder, Drive(self.setting.world, plan), start + plan.seconds
        time.sleep(max(0.0, end + 0.5 - time.monotonic()))
        poses, told = recorder.poses(plan.robot, start, end), recorder.told(plan.robot, start, end)
        arrivals = [pose.arrival for pose in poses]
        metres, degrees = scores.errors(poses, drive.truth)
        intervals = scores.tracking_intervals(arrivals, told)
        ticks = scores.tracking_intervals(recorder.ticks(start, end), [])
        puts = sent.puts[plan.robot]
        return {
            "poses": len(poses),
            "unreadable": recorder.unreadable,
            "false": scores.false_poses(metres, degrees),
            "first_fix_s": arrivals[0] - start if poses else None,
            "first_fix_m": drive.metres(poses[0].stamp_ns) if poses else None,
            "rmse_m_deg": [rms(metres), rms(degrees)] if poses else None,
            "rate_hz": scores.rate_hz(intervals),
            "jitter_ms": scores.jitter_ms(intervals),
            "machine_jitter_ms": scores.jitter_ms(ticks),
            "steps_back": scores.steps_back([pose.stamp_ns for pose in poses]),
            "share_posed": scores.share_posed(arrivals, arrivals[0], end) if poses else 0.0,
            "cloud_to_pose_ms": scores.percentiles_ms(scores.reaction(puts, scores.corrected(poses)), 50, 95, 99),
            "clouds_sent": len(puts),
        }
