"""A node as a process, ``coview-stream serve``: its engines, its memory, signals to it, and its end."""

from __future__ import annotations

import contextlib
import signal
import time
from pathlib import Path
from subprocess import STDOUT

import psutil

from bench.harness.files import PYTHON, ROOT, environment

MAIN, TRACK, SEARCH = "main", "track", "search"
PARTS = (TRACK, SEARCH, "odometry")  # an engine has its name in its command
GRACE = 10.0  # seconds from SIGTERM to SIGKILL


class Node:
    """A node that serves a map; ``words`` follow the map in its command, and ``log`` has both of its streams."""

    def __init__(self, site: Path, log: Path, *words: str) -> None:
        """Start it; do not wait until it is ready."""
        self.log = log
        self._command = [*PYTHON, "-m", "coview_stream", "serve", str(site), *words]
        log.unlink(missing_ok=True)
        self.start()

    def start(self) -> None:
        """Start the node, at first and after its end."""
        with self.log.open("ab") as out:
            self.process = psutil.Popen(self._command, stdout=out, stderr=STDOUT, env=environment(), cwd=ROOT)

    def family(self) -> list[tuple[str, psutil.Process]]:
        """Return the living processes, each with its part: main, track, search, odometry or other."""
        out: list[tuple[str, psutil.Process]] = []
        with contextlib.suppress(psutil.Error):  # processes end meanwhile
            if self.process.poll() is None:
                out.append((MAIN, self.process))
            for child in self.process.children(recursive=True):
                with contextlib.suppress(psutil.Error):
                    if child.status() != psutil.STATUS_ZOMBIE:
                        words = child.cmdline()
                        out.append((next((part for part in PARTS if part in words), "other"), child))
        return out

    def send(self, part: str, number: int) -> psutil.Process | None:
        """Send a signal to a part of the node; return its process, or None if there is none."""
        process = dict(self.family()).get(part)
        if process is not None:
            with contextlib.suppress(psutil.Error):
                process.send_signal(number)
        return process

    def end(self, number: int = signal.SIGTERM) -> tuple[float, int]:
        """End the node by a signal, and kill the rest.

        Returns the seconds until it ended, infinite if it had to be killed, and the number of engines that outlived it
        by :data:`GRACE` seconds.
        """
        engines, begin = [process for part, process in self.family() if part != MAIN], time.monotonic()
        with contextlib.suppress(psutil.Error):
            self.process.send_signal(number)
        try:
            self.process.wait(GRACE)
            seconds = time.monotonic() - begin
        except psutil.TimeoutExpired:
            seconds = float("inf")
        left = psutil.wait_procs(engines, timeout=GRACE)[1]
        for process in [*left, self.process]:
            with contextlib.suppress(psutil.Error):
                process.kill()
        return seconds, len(left)
