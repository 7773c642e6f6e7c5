"""The node under test as a process: started through the command line, watched from outside."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import psutil

_ROOT = Path(__file__).parents[2]
_GRACE = 10.0

PRODUCT = (sys.executable, "-m", "coview_stream", "serve", "--no-state")


def environment() -> dict[str, str]:
    """Return ours, with both import roots of this checkout in front."""
    paths = [str(_ROOT), str(_ROOT / "kernels"), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


class Node:
    """A running ``coview-stream serve``; as a context manager it is ended, whatever happens."""

    def __init__(self, command: Sequence[str], log: Path) -> None:
        self.log = log
        self._file = log.open("wb")
        self.process = subprocess.Popen(
            list(command), stdout=self._file, stderr=subprocess.STDOUT, env=environment(), cwd=_ROOT
        )
        self._tree = psutil.Process(self.process.pid)

    def __enter__(self) -> Node:
        return self

    def __exit__(self, *_: object) -> None:
        family = self.family()
        if self.running():
            self.process.terminate()
        try:
            self.process.wait(_GRACE)
        except subprocess.TimeoutExpired:
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
        times = [_or_zero(lambda m=member: sum(m.cpu_times()[:2])) for member in self.family()]
        return float(sum(times))

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
    """Processor time of everybody but this process and its descendants, since the machine started."""
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
