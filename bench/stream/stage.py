"""A stage for each scenario (router, node, recorder), and what every scenario measures of a stream."""

from __future__ import annotations

import itertools
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from bench.harness.rows import Row, judged
from bench.harness.suite import ROOT, environment
from bench.stream import scores
from bench.stream.client import Helper, Recorder, Sent, free_port, route, send, wait_until
from bench.stream.drive import Drive, RobotPlan, content_of

_READY = 90.0  # seconds in which the node must announce all its robots
_GRACE = 10.0
MOST_JITTER, RATE, RATE_SHARE, LEAST_POSED, MOST_FIRST_FIX = 15.0, 10.0, 0.02, 0.95, 20.0
"""Targets: ms, Hz, share of it, share of the time from the first fix on, metres."""

MOST_LAG = 0.3
"""Seconds; where a sender was later than that, the machine was too busy for any of the figures to mean anything."""


@dataclass
class Outcome:
    """What a scenario found: its rows, and all numbers."""

    name: str
    rows: list[Row] = field(default_factory=list)
    numbers: dict[str, Any] = field(default_factory=dict)

    def judge(self, what: str, measured: Any, target: str, met: bool | None) -> None:
        """Add a row with a verdict."""
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

    def machine(self, sent: Sent, label: str = "") -> None:
        """Say whether the measurement itself can be trusted."""
        self.most(f"{label}sender late by, s (else: measure again)", sent.longest_lag, MOST_LAG)

    def tell(self, what: str, measured: Any) -> None:
        """Add a row without a verdict."""
        self.judge(what, measured, "", None)

    def stream(self, numbers: dict[str, Any], label: str = "") -> None:
        """Judge a stream that ought to have been served well from its first fix on."""
        rate, spread, fix = (numbers[key] for key in ("rate_hz", "jitter_ms", "first_fix_m"))
        first = (numbers["first_fix_s"], fix)
        limit = f"<= {MOST_FIRST_FIX:.0f} m"
        self.judge(f"{label}first fix, s / m", first, limit, fix is not None and fix <= MOST_FIRST_FIX)
        false = numbers["false"] + numbers["unreadable"]
        self.none(f"{label}false or unreadable poses", false, numbers["poses"])
        self.tell(f"{label}RMSE, m / deg", numbers["rmse_m_deg"])
        self.tell(f"{label}worst, m / deg", numbers["worst_m_deg"])
        steady = rate is not None and abs(rate - RATE) <= RATE_SHARE * RATE
        self.judge(f"{label}rate while TRACKING, Hz", rate, f"{RATE:.0f} +- {RATE_SHARE:.0%}", steady)
        still = spread is not None and spread[1] < MOST_JITTER
        self.judge(f"{label}jitter p50 / p99, ms", spread, f"p99 < {MOST_JITTER:.0f}", still)
        machine = (numbers["machine_jitter_ms"], numbers["foreign_cores"])
        self.tell(f"{label}... of the machine itself, ms; cores others used", machine)
        self.none(f"{label}stamps that go back", numbers["steps_back"])
        share = numbers["share_posed"]
        self.judge(f"{label}time posed after the first fix", share, f">= {LEAST_POSED}", share >= LEAST_POSED)
        self.tell(f"{label}cloud to pose p50/p95/p99, ms", numbers["cloud_to_pose_ms"])
        self.tell(f"{label}newest frame in status p50/p95/p99, ms", numbers["cloud_to_status_ms"])
        self.tell(f"{label}latency as the node says", numbers["node_latency_ms"])
        self.tell(f"{label}states", " ".join(numbers["states"]))


def shown(value: Any) -> str:
    """Write numbers briefly, nothing as a dash."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    if isinstance(value, (tuple, list)):
        return " / ".join(shown(part) for part in value)
    return str(value)


class Node:
    """A running ``coview-stream serve``, started through the command line and watched from outside."""

    def __init__(self, arguments: Sequence[str], log: Path) -> None:
        self.log = log
        self._file = log.open("wb")
        self.process = subprocess.Popen(
            [sys.executable, "-m", "coview_stream", "serve", "--no-state", *arguments],
            stdout=self._file, stderr=subprocess.STDOUT, env=environment(), cwd=ROOT,
        )  # fmt: skip
        self._tree = psutil.Process(self.process.pid)

    def end(self) -> None:
        """End it and its descendants."""
        family = self.family()
        if self.running() and self.terminate()[0] is None:
            print(f"the node did not end within {_GRACE} s of SIGTERM; killed")
        for member in family:
            if member.is_running():
                member.kill()
        self._file.close()

    def running(self) -> bool:
        """Whether its main process lives."""
        return self.process.poll() is None

    def terminate(self) -> tuple[int | None, float]:
        """SIGTERM; returns the exit code (None: still running after the grace) and the seconds it took."""
        begin = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        try:
            return self.process.wait(_GRACE), time.monotonic() - begin
        except subprocess.TimeoutExpired:
            return None, time.monotonic() - begin

    def orphans(self, family: Sequence[psutil.Process]) -> int:
        """How many of its former processes still run."""
        return sum(member.is_running() and member.status() != psutil.STATUS_ZOMBIE for member in family)

    def megabytes(self) -> float:
        """Resident memory of the family, MB; pages shared between its processes count once per process."""
        return sum(_or_zero(lambda m=member: m.memory_info().rss) for member in self.family()) / 1e6

    def cpu_seconds(self) -> float:
        """Processor time that the family used so far."""
        return sum(_or_zero(lambda m=member: sum(m.cpu_times()[:2])) for member in self.family())

    def log_lines(self) -> list[str]:
        """Return what it printed so far, both streams."""
        return self.log.read_text(errors="replace").splitlines()

    def family(self) -> list[psutil.Process]:
        """Return it and its descendants."""
        try:
            return [self._tree, *self._tree.children(recursive=True)]
        except psutil.NoSuchProcess:
            return []


def foreign_seconds() -> float:
    """Processor time of all but this process and its descendants, since the machine started."""
    times = psutil.cpu_times()
    machine = sum(times) - times.idle - getattr(times, "iowait", 0.0) - getattr(times, "guest", 0.0)
    own = psutil.Process()
    family = [own, *own.children(recursive=True)]
    return float(machine - sum(_or_zero(lambda m=member: sum(m.cpu_times()[:4])) for member in family))


def _or_zero(read: Callable[[], float]) -> float:
    """Nothing, for a process that ended in the meantime."""
    try:
        return float(read())
    except psutil.Error:
        return 0.0


@dataclass
class Setting:
    """What all scenarios share: worlds, map, more arguments for the node, and how long."""

    world: Path
    stranger: Path
    site: Path
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
        site = str(setting.site)
        self._arguments = [site, "--robot", *robots, "--connect", self.endpoint, *arguments, *setting.extra]
        self._senders: list[Helper] = []

    def __enter__(self) -> Stage:
        self.start_router()
        self.recorder = Recorder(self.endpoint).__enter__()
        begin = time.monotonic()
        log = Path(tempfile.mkstemp(suffix=".log", prefix=f"{self.name}-", dir=self.setting.logs)[1])
        self.node = Node(self._arguments, log)
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
        self.node.end()
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

    def measure(
        self, plan: RobotPlan, sent: Sent, start: float, without: Sequence[tuple[float, float]] = ()
    ) -> dict[str, Any]:
        """All numbers of a robot's stream that began at ``start``; seconds, metres, degrees unless named otherwise."""
        recorder, drive = self.recorder, Drive(self.setting.world, plan.robot, plan.frame_seconds)
        end = start + plan.seconds
        poses, told = recorder.poses(plan.robot, start, end), recorder.told(plan.robot, start, end)
        arrivals = [pose.arrival for pose in poses]
        metres, degrees = scores.errors(poses, drive.truth)
        intervals = scores.tracking_intervals(arrivals, told, without)
        floor = scores.tracking_intervals(recorder.ticks(start, end), [], without)
        puts = sent.puts[plan.robot]
        first = poses[0] if poses else None
        last = told[-1].fields if told else {}
        states = [status.state for status in told]
        rms = [float(np.sqrt(np.mean(part**2))) for part in (metres, degrees)] if poses else None
        return {
            "poses": len(poses),
            "unreadable": recorder.unreadable,
            "false": scores.false_poses(metres, degrees),
            "first_fix_s": first.arrival - start if first else None,
            "first_fix_m": drive.metres(content_of(first.stamp_ns)) if first else None,
            "rmse_m_deg": rms,
            "worst_m_deg": [float(metres.max()), float(degrees.max())] if poses else None,
            "rate_hz": scores.rate_hz(intervals),
            "jitter_ms": scores.jitter_ms(intervals),
            "longest_interval_s": float(intervals.max()) if len(intervals) else None,
            "machine_jitter_ms": scores.jitter_ms(floor),
            "steps_back": scores.steps_back([pose.stamp_ns for pose in poses]),
            "same_stamps": sum(a.stamp_ns == b.stamp_ns for a, b in itertools.pairwise(poses)),
            "share_posed": scores.share_posed(arrivals, first.arrival, end) if first else 0.0,
            "cloud_to_pose_ms": scores.percentiles_ms(scores.reaction(puts, scores.corrected(poses))),
            "cloud_to_status_ms": scores.percentiles_ms(scores.staleness(puts, scores.processed(told))),
            "pose_age_ms": scores.percentiles_ms(np.array([p.age for p in poses if p.age is not None])),
            "statuses": len(told),
            "states": [state for k, state in enumerate(states) if k == 0 or state != states[k - 1]],
            "node_latency_ms": last.get("latency_ms"),
            "node_pose": last.get("pose"),
            "counters": last.get("counters"),
            "node_errors": last.get("errors"),
            "sender_lag_put_s": (sent.longest_lag, sent.longest_put),
            "clouds_sent": len(puts),
            "node_start_s": self.start_s,
            "node_megabytes": self.node.megabytes(),
            "foreign_cores": self.foreign_cores(),
        }


def until(moment: float) -> None:
    """Sleep until a monotonic time."""
    time.sleep(max(0.0, moment - time.monotonic()))
