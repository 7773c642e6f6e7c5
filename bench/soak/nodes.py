"""Nodes under test: ``coview-stream serve`` as processes, killed and started again, their memory and descriptors."""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from subprocess import STDOUT
from typing import NamedTuple

import numpy as np
import psutil

from bench.harness.files import ROOT, environment
from bench.soak.sites import Site

MAIN, TRACK, SEARCH = "main", "track", "search"
_KINDS = (TRACK, SEARCH, "odometry")
_KEPT = 1000  # samples of a process that a slope is made of
_GRACE = 10.0  # seconds from SIGTERM to SIGKILL


class Sampled(NamedTuple):
    """Memory that a process has made its own, no page of a file, and its open descriptors."""

    at: float
    megabytes: float
    descriptors: int


@dataclass
class Node:
    """One node, started again by hand; ``map`` is a copy of its own that faults may spoil."""

    site: Site
    robots: Sequence[str]
    endpoint: str
    map: Path
    state: Path
    log: Path
    samples: dict[tuple[str, int], list[Sampled]] = field(default_factory=dict)
    crashes: list[str] = field(default_factory=list)
    started: int = 0

    def start(self) -> None:
        """Start it; it is not waited for."""
        command = [
            sys.executable, "-P", "-m", "coview_stream", "serve", str(self.map), "--state", str(self.state),
            "--robot", *self.robots, "--connect", self.endpoint,
        ]  # fmt: skip
        with self.log.open("ab") as log:
            self.process = psutil.Popen(command, stdout=log, stderr=STDOUT, env=environment(), cwd=ROOT)
        self.started += 1

    def running(self) -> bool:
        """Whether its main process lives."""
        return self.process.poll() is None

    def revive(self) -> None:
        """Start it again if it ended, which nobody asked it to."""
        if not self.running():
            self.crashes.append(f"exit code {self.process.poll()}")
            self.start()

    def family(self) -> dict[str, psutil.Process]:
        """Return its living processes by their part; a zombie is none."""
        found: dict[str, psutil.Process] = {}
        with contextlib.suppress(psutil.Error):
            if self.running():
                found[MAIN] = self.process
            for child in self.process.children(recursive=True):
                with contextlib.suppress(psutil.Error):
                    if child.status() != psutil.STATUS_ZOMBIE:
                        words = child.cmdline()
                        part = next((kind for kind in _KINDS if kind in words), "other")
                        found[part] = child
        return found

    def zombies(self) -> int:
        """How many children have ended and were not waited for."""
        count = 0
        with contextlib.suppress(psutil.Error):
            for child in self.process.children(recursive=True):
                with contextlib.suppress(psutil.Error):
                    count += child.status() == psutil.STATUS_ZOMBIE
        return count

    def send(self, part: str, number: int) -> psutil.Process | None:
        """Send a signal to one of its processes, which is returned; None if there is none."""
        process = self.family().get(part)
        if process is not None:
            with contextlib.suppress(psutil.Error):
                process.send_signal(number)
        return process

    def sample(self) -> None:
        """Note memory and descriptors of all its processes."""
        at = time.monotonic()
        for part, process in self.family().items():
            with contextlib.suppress(psutil.Error, OSError):
                with process.oneshot():
                    row = Sampled(at, anonymous(process), process.num_fds())
                self.samples.setdefault((part, process.pid), []).append(row)

    def end(self, number: int = signal.SIGTERM) -> float:
        """End it by a signal; the seconds that took, infinite if it had to be killed after its grace."""
        family, begin = list(self.family().values()), time.monotonic()
        with contextlib.suppress(psutil.Error):
            self.process.send_signal(number)
        try:
            self.process.wait(_GRACE)
            seconds = time.monotonic() - begin
        except psutil.TimeoutExpired:
            seconds = float("inf")
        left = psutil.wait_procs([each for each in family if each.pid != self.process.pid], timeout=_GRACE)[1]
        for process in [*left, self.process]:
            with contextlib.suppress(psutil.Error):
                process.kill()
        if left:
            self.crashes.append(f"{len(left)} engines outlived their node by {_GRACE:.0f} s")
        return seconds

    def tracebacks(self) -> int:
        """How many its log holds."""
        return self.log.read_text(errors="replace").count("Traceback (most recent call last)")


def anonymous(process: psutil.Process) -> float:
    """Return the megabytes of a process that are of no file, swapped out or not; a map is a file.

    Where the system does not tell, what it shares with no other process.
    """
    page = Path(f"/proc/{process.pid}/status")
    if not page.is_file():
        return float(process.memory_full_info().uss / 1e6)
    lines = dict(line.split(":", 1) for line in page.read_text().splitlines() if ":" in line)
    return sum(int(lines[name].split()[0]) * 1024 / 1e6 for name in ("RssAnon", "VmSwap") if name in lines)


def slope(rows: Sequence[Sequence[Sampled]], what: str, warm: float, apart: float = 300.0) -> float | None:
    """Change per hour of the processes of one part: weighted median over pairs of samples of the same process.

    Pairs are at least ``apart`` seconds apart and no sample is of the first ``warm`` seconds of its process; a pair
    weighs what lies between its samples. None without a pair. Killed and started anew, a process begins anew.
    """
    slopes, weights = [], []
    for samples in rows:
        kept = [each for each in samples if each.at - samples[0].at >= warm]
        kept = kept[:: 1 + len(kept) // _KEPT]
        at = np.array([each.at for each in kept])
        value = np.array([float(getattr(each, what)) for each in kept])
        i, j = np.triu_indices(len(kept), 1)
        far = at[j] - at[i] >= apart if len(kept) else np.zeros(0, bool)
        i, j = i[far], j[far]
        slopes.append((value[j] - value[i]) / (at[j] - at[i]) * 3600)
        weights.append(at[j] - at[i])
    slope_s, weight = (np.concatenate(each) if each else np.zeros(0) for each in (slopes, weights))
    if not len(slope_s):
        return None
    order = np.argsort(slope_s)
    total = np.cumsum(weight[order])
    return float(slope_s[order][np.searchsorted(total, total[-1] / 2)])
