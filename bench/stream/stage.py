"""A stage for each scenario: router, node and recorder; what every stream is measured by, and what is found."""

from __future__ import annotations

import contextlib
import itertools
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from subprocess import STDOUT
from typing import Any, NamedTuple

import psutil

from bench.accuracy.scores import rms
from bench.harness.files import ROOT, environment
from bench.harness.rows import Row, judged
from bench.stream import scores
from bench.stream.processes import Drive, Helper, Recorder, RobotPlan, Sent, free_port, route, send, wait_until

_READY = 90.0  # seconds in which the node must announce all its robots
_GRACE = 10.0  # seconds from SIGTERM to SIGKILL
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
        """Add a row of a count that must be zero, perhaps of so many."""
        self.judge(what, count if of is None else f"{count} of {of}", "0", count == 0)

    def some(self, what: str, count: int | None, told: Any = None) -> None:
        """Add a row of a count that must not be zero."""
        self.judge(what, count if told is None else told, "> 0", bool(count))

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


class Stream(NamedTuple):
    """A robot's stream under way, and the monotonic time of its beginning."""

    plan: RobotPlan
    sender: Helper
    start: float


class Stage:
    """Router, recorder and a node started through the command line, ready; the node is watched from outside."""

    def __init__(self, setting: Setting, found: Findings, robots: Sequence[str], *arguments: str) -> None:
        self.setting, self.found, self.robots = setting, found, tuple(robots)
        self.port = free_port()
        self.endpoint = f"tcp/127.0.0.1:{self.port}"
        self._arguments = ["--robot", *robots, "--connect", self.endpoint, *arguments]
        self._log = setting.world / f"{found.name}.log"
        self._helpers: list[Helper] = []

    def __enter__(self) -> Stage:
        self.start_router()
        self.recorder = Recorder(self.endpoint).__enter__()
        command = [sys.executable, "-m", "coview_stream", "serve", str(self.setting.site), "--no-state"]
        with self._log.open("wb") as log:
            self.node = psutil.Popen(
                [*command, *self._arguments], stdout=log, stderr=STDOUT, env=environment(), cwd=ROOT
            )
        up = wait_until(lambda: all(map(self.recorder.alive, self.robots)) or not self.running(), _READY)
        if not up or not self.running():
            tail = "\n".join(self.log_lines()[-15:])
            self.__exit__()
            raise RuntimeError(f"the node did not announce {self.robots} in {_READY} s:\n{tail}")
        return self

    def __exit__(self, *_: object) -> None:
        for helper in self._helpers:
            if helper.process.is_alive():
                helper.kill()
        family = self.family()
        if self.running() and self.terminate()[0] is None:
            print(f"the node did not end within {_GRACE} s of SIGTERM; killed")
        for member in family:
            if member.is_running():
                member.kill()
        self.recorder.__exit__()

    def running(self) -> bool:
        """Whether the node's main process lives."""
        return self.node.poll() is None

    def family(self) -> list[psutil.Process]:
        """Return the node's main process and its descendants."""
        try:
            return [self.node, *self.node.children(recursive=True)]
        except psutil.NoSuchProcess:
            return []

    def terminate(self) -> tuple[int | None, float]:
        """SIGTERM; returns the exit code (None: still running after the grace) and the seconds it took."""
        begin = time.monotonic()
        self.node.send_signal(signal.SIGTERM)
        try:
            return self.node.wait(_GRACE), time.monotonic() - begin
        except psutil.TimeoutExpired:
            return None, time.monotonic() - begin

    def megabytes(self) -> float:
        """Resident memory of the family, MB; pages shared between its processes count once per process."""
        total = 0
        for member in self.family():
            with contextlib.suppress(psutil.Error):  # it ended in the meantime
                total += member.memory_info().rss
        return total / 1e6

    def log_lines(self) -> list[str]:
        """Return what the node printed so far, both streams."""
        return self._log.read_text(errors="replace").splitlines()

    def seconds(self, full: float, quick: float) -> float:
        """How long something lasts."""
        return quick if self.setting.quick else full

    def start_router(self) -> None:
        """Start the router; also again, at the same port."""
        self.router = self.helper(route, self.port)

    def helper(self, work: Any, *args: Any) -> Helper:
        """Start a process that ends with the stage, and wait until it has loaded what it needs."""
        self._helpers.append(Helper(work, *args))
        return self._helpers[-1]

    def sender(self, *plans: RobotPlan, world: Path | None = None) -> Helper:
        """Return a sender that waits for its beginning."""
        return self.helper(send, self.endpoint, world or self.setting.world, plans)

    def stream(self, plan: RobotPlan) -> Stream:
        """Begin the stream of one robot."""
        sender = self.sender(plan)
        return Stream(plan, sender, sender.begin())

    def sent(self, sender: Helper, label: str = "") -> Sent:
        """Wait for a sender's end, and judge whether the measurement itself can be trusted."""
        sent: Sent = sender.result()
        self.found.most(f"{label}sender late by, s (else: measure again)", sent.longest_lag, MAX_LAG)
        return sent

    def measure(
        self, plan: RobotPlan, sent: Sent, start: float, without: Sequence[tuple[float, float]] = ()
    ) -> dict[str, Any]:
        """All numbers of a robot's stream that began at ``start``; seconds, metres, degrees unless named otherwise."""
        recorder, drive, end = self.recorder, Drive(self.setting.world, plan), start + plan.seconds
        until(end + 0.5)
        poses, told = recorder.poses(plan.robot, start, end), recorder.told(plan.robot, start, end)
        arrivals = [pose.arrival for pose in poses]
        metres, degrees = scores.errors(poses, drive.truth)
        intervals = scores.tracking_intervals(arrivals, told, without)
        ticks = scores.tracking_intervals(recorder.ticks(start, end), [], without)
        puts = sent.puts[plan.robot]
        last = told[-1].fields if told else {}
        return {
            "poses": len(poses),
            "unreadable": recorder.unreadable,
            "false": scores.false_poses(metres, degrees),
            "first_fix_s": arrivals[0] - start if poses else None,
            "first_fix_m": drive.metres(poses[0].stamp_ns) if poses else None,
            "rmse_m_deg": [rms(metres), rms(degrees)] if poses else None,
            "worst_m_deg": [float(metres.max()), float(degrees.max())] if poses else None,
            "rate_hz": scores.rate_hz(intervals),
            "jitter_ms": scores.jitter_ms(intervals),
            "machine_jitter_ms": scores.jitter_ms(ticks),
            "steps_back": scores.steps_back([pose.stamp_ns for pose in poses]),
            "share_posed": scores.share_posed(arrivals, arrivals[0], end) if poses else 0.0,
            "cloud_to_pose_ms": scores.percentiles_ms(scores.reaction(puts, scores.corrected(poses)), 50, 95, 99),
            "states": [state for state, _ in itertools.groupby(status.state for status in told)],
            "counters": last.get("counters"),
            "node_errors": last.get("errors"),
            "clouds_sent": len(puts),
        }


def until(moment: float) -> None:
    """Sleep until a monotonic time."""
    time.sleep(max(0.0, moment - time.monotonic()))


def processor_seconds(family: Sequence[psutil.Process]) -> dict[int, float]:
    """User and system time of each process so far, by its id."""
    seconds: dict[int, Any] = {}
    for member in family:
        with contextlib.suppress(psutil.Error):  # it ended in the meantime
            times = member.cpu_times()
            seconds[member.pid] = times.user + times.system
    return seconds
