"""Run a benchmark in a process of its own, and turn whatever becomes of it into rows."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO

from bench.harness.rows import Row, failed
from bench.harness.suite import Entry, thread_settings

_ROOT = Path(__file__).parents[2]
_BEAT_S = 0.2


def run(entry: Entry, threads: int | None, quick: bool, beat: Callable[[float], None]) -> Iterator[Row]:
    """Yield the rows of a benchmark as they come; ``beat`` is told the seconds so far, several times a second.

    A benchmark that ends in an exception, is killed, runs past its limit or yields nothing adds a row that does
    not hold and says so; what it printed itself is shown on stderr only then.
    """
    conditions = "".join(f", {said}" for said in (threads and counted(threads), quick and "quick") if said)
    label = f"{entry.name}{conditions}"
    read, write = os.pipe()
    with tempfile.TemporaryFile("w+") as said, os.fdopen(read, "rb", buffering=0) as pipe:
        process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "bench.harness.suite",
                entry.source,
                str(write),
                *(["--quick"] if quick else []),
            ],
            env=_environment(threads),
            pass_fds=(write,),
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # so that its own children end with it
        )
        os.close(write)
        begin, count = time.monotonic(), 0
        try:
            for line in _lines(pipe, process, begin + entry.limit_s, beat):
                count += 1
                row = Row.from_dict(json.loads(line))
                yield replace(row, name=f"{row.name}{conditions}")
            why = _verdict(process, begin + entry.limit_s, count, entry.limit_s)
        finally:
            _end(process)
        if why:
            print(_tail(said), file=sys.stderr)
            yield failed(label, why)


def counted(threads: int) -> str:
    """Say a number of threads."""
    return "1 thread" if threads == 1 else f"{threads} threads"


def _environment(threads: int | None) -> dict[str, str]:
    path = os.pathsep.join(filter(None, (str(_ROOT), str(_ROOT / "kernels"), os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": path, **thread_settings(threads)}


def _lines(
    pipe: IO[bytes], process: subprocess.Popen[bytes], deadline: float, beat: Callable[[float], None]
) -> Iterator[bytes]:
    """Whole lines until the process has closed its end, or is gone (its children may hold it), or time is up."""
    held, begin = b"", time.monotonic()
    while (left := deadline - time.monotonic()) > 0:
        beat(time.monotonic() - begin)
        over = process.poll() is not None
        if not select.select([pipe], [], [], 0.0 if over else min(_BEAT_S, left))[0]:
            if over:
                return
            continue
        chunk = os.read(pipe.fileno(), 1 << 16)
        if not chunk:
            return
        *lines, held = (held + chunk).split(b"\n")
        yield from lines


def _verdict(process: subprocess.Popen[bytes], deadline: float, count: int, limit_s: float) -> str:
    """Say why the benchmark has failed; empty if it has not."""
    try:
        code = process.wait(max(1.0, deadline - time.monotonic()))
    except subprocess.TimeoutExpired:
        return f"ran past its {limit_s:g} s"
    if code < 0:
        return f"ended by signal {signal.Signals(-code).name}"
    if code:
        return f"ended with exit code {code}"
    return "" if count else "yielded no row"


def _end(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _tail(said: IO[str], lines: int = 12) -> str:
    said.seek(0)
    return "\n".join(said.read().splitlines()[-lines:])
