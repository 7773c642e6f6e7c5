"""A stage for each scenario: router, node and recorder; the measures of a stream, and their rows."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.accuracy.scores import rms
from bench.harness.node import Node
from bench.harness.rows import Row, bounded, informs, judged, reached
from bench.stream import scores
from bench.stream.processes import Drive, Helper, Recorder, RobotPlan, Sent, free_port, route, send, wait_until
from coview_stream.sim import SimulationConfig

_READY = 90.0  # seconds in which the node must announce all its robots
MAX_JITTER, RATE, RATE_SHARE, MIN_POSED, MAX_FIRST_FIX = 15.0, 10.0, 0.02, 0.95, 20.0
"""Targets: ms, Hz, share of it, share of the time from the first fix on, metres."""

MAX_LAG = 0.3
"""Seconds; where a sender was later than that, the machine was too busy for any of the figures to mean anything."""


class Setting(NamedTuple):
    """Configuration of the world, the world, another one, the first one's map, and whether times are short."""

    home: SimulationConfig
    world: Path
    stranger: Path
    site: Path
    quick: bool


class Stage:
    """Router, recorder and a node started through the command line, ready; the node is watched from outside."""

    def __init__(self, setting: Setting, log: str, robots: Sequence[str], *arguments: str) -> None:
        self.setting, self.robots = setting, robots
        port = free_port()
        self.endpoint = f"tcp/127.0.0.1:{port}"
        self._helpers = [Helper(route, port)]
        self.recorder = Recorder(self.endpoint)
        words = ("--no-state", "--robot", *robots, "--connect", self.endpoint, *arguments)
        self.node = Node(setting.site, setting.world / log, *words)

    def __enter__(self) -> Stage:
        def ready() -> bool:
            return all(map(self.recorder.alive, self.robots))

        wait_until(lambda: ready() or not self.running(), _READY)
        if not ready():
            self.__exit__()
            log = self.node.log.read_text(errors="replace")
            raise RuntimeError(f"the node did not announce {self.robots} in {_READY} s: {log[-1000:]}")
        return self

    def __exit__(self, *_: object) -> None:
        for helper in self._helpers:
            if helper.process.is_alive():
                helper.kill()
        if self.node.end()[0] == math.inf:
            print("the node did not end after SIGTERM; killed")
        self.recorder.session.close()

    def running(self) -> bool:
        """Tell whether the node's main process lives."""
        return self.node.process.poll() is None

    def helper(self, work: Any, *args: Any) -> Helper:
        """Start a process that ends with the stage, and wait until it is ready."""
        self._helpers.append(Helper(work, *args))
        return self._helpers[-1]

    def sender(self, *plans: RobotPlan, world: Path | None = None) -> Helper:
        """Return a sender that waits for its beginning."""
        return self.helper(send, self.endpoint, world or self.setting.world, plans)

    def measure(self, plan: RobotPlan, sent: Sent, start: float, world: Path | None = None) -> dict[str, Any]:
        """Return all numbers of a robot's stream that began at ``start``; NaN without poses."""
        recorder, drive, end = self.recorder, Drive(world or self.setting.world, plan), start + plan.seconds
        time.sleep(max(0.0, end + 0.5 - time.monotonic()))
        poses, told = recorder.poses(plan.robot, start, end), recorder.told(plan.robot, start, end)
        arrivals = [pose.arrival for pose in poses]
        metres, degrees = scores.errors(poses, drive.truth)
        intervals = scores.tracking_intervals(arrivals, told)
        ticks = np.diff(recorder.ticks(start, end))
        puts = sent.puts[plan.robot]
        return {
            "poses": len(poses),
            "wrong": scores.false_poses(metres, degrees) + recorder.unreadable,
            "first_fix_m": drive.metres(poses[0].stamp_ns) if poses else math.nan,
            "first_fix_s": poses[0].arrival - start if poses else math.nan,
            "rmse_m": rms(metres) if poses else math.nan,
            "median_m": float(np.median(metres)) if poses else math.nan,
            "median_deg": float(np.median(degrees)) if poses else math.nan,
            "rate_hz": scores.rate_hz(intervals),
            "jitter_ms": scores.jitter_ms(intervals),
            "jitter_p50_ms": scores.percentile_ms(np.abs(intervals - 0.1), 50),
            "machine_jitter_ms": scores.jitter_ms(ticks),
            "share_posed": scores.share_posed(arrivals, arrivals[0], end) if poses else 0.0,
            "cloud_to_pose_ms": scores.percentile_ms(scores.reaction(puts, scores.corrected(poses)), 95),
            "clouds_sent": len(puts),
            "late_s": sent.longest_lag,
        }


def rated(name: str, rates: Sequence[float]) -> Row:
    """Judge rates of poses, which must all be constant."""
    text = " to ".join(f"{rate:.2f}" for rate in sorted({min(rates), max(rates)}))
    constant = all(abs(rate - RATE) <= RATE_SHARE * RATE for rate in rates)
    return judged(f"{name}, Hz", text, f"{RATE:.0f} +- {RATE_SHARE:.0%}", constant, min(rates))


def punctual(label: str, late: float) -> Row:
    """Judge whether the senders were on time, else the measurement cannot be trusted."""
    return bounded(f"{label}sender late by (else: measure again)", late, "s", MAX_LAG)


def served(numbers: dict[str, Any], label: str = "") -> Iterator[Row]:
    """Judge a stream that ought to have been served well from its first fix on."""
    yield replace(punctual(label, numbers["late_s"]), details=numbers)
    yield bounded(f"{label}first fix", numbers["first_fix_m"], "m", MAX_FIRST_FIX)
    wrong = numbers["wrong"]
    yield judged(f"{label}false or unreadable poses", f"{wrong} of {numbers['poses']}", "0", wrong == 0)
    yield informs(f"{label}RMSE", numbers["rmse_m"], "m")
    yield rated(f"{label}rate while TRACKING", [numbers["rate_hz"]])
    yield bounded(f"{label}jitter p99", numbers["jitter_ms"], "ms", MAX_JITTER)
    yield informs(f"{label}... of the machine itself", numbers["machine_jitter_ms"], "ms")
    yield reached(f"{label}time posed after the first fix", numbers["share_posed"], "", MIN_POSED)
    yield informs(f"{label}cloud to pose p95", numbers["cloud_to_pose_ms"], "ms")
