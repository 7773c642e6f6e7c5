"""The names that ``python -m bench`` knows, and a benchmark in a process of its own."""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from bench.harness.files import environment
from bench.harness.rows import Row, failed
from coview_stream.errors import CoViewError


class Benchmark(NamedTuple):
    """One name: the module of its ``rows`` below ``bench``, one line about it, and its thread counts.

    For each thread count it runs in a process of its own; None leaves the count to the machine. Without any it runs in
    this process.
    """

    module: str
    about: str
    threads: tuple[int | None, ...] = ()

    def load(self) -> Any:
        """Import its module."""
        return importlib.import_module(f"bench.{self.module}")


_BOTH, _ANY = (1, 2), (None,)

BENCHMARKS = {
    "kernels": Benchmark("speed.kernels", "each kernel beside its NumPy twin", _BOTH),
    "match": Benchmark("speed.match", "one keyframe against all stations at all shifts", _BOTH),
    "frame": Benchmark("speed.frame", "a frame: transform, filter, voxels; the descriptor of a keyframe", _BOTH),
    "map_build": Benchmark("speed.map_build", "descriptors of 10,000 stations"),
    "registration": Benchmark("speed.registration", "trimmed ICP beside small_gicp", _BOTH),
    "engine": Benchmark("speed.engine", "Localizer.step on a large map: times, CPU share, memory", _ANY),
    "stages": Benchmark("speed.stages", "milliseconds of each stage of a tracking step and a search step", (1,)),
    "search": Benchmark("speed.search", "the whole search step beside an earlier commit"),
    "scale": Benchmark("speed.scale", "the vote of a keyframe on a thousand to a million stations", (1,)),
    "city": Benchmark("speed.city", "a city of 4 km2 as a directory: build, open, find robots, memory"),
    "start": Benchmark("speed.start", "import, first run, ready to serve", _ANY),
    "peers": Benchmark("peers.peers", "other libraries on the same queries", _ANY),
    "accuracy": Benchmark("accuracy.accuracy", "errors, runs localised and false fixes in held-out worlds"),
    "conditions": Benchmark("accuracy.conditions", "real runs: leaning sensor, bad odometry, airborne-like maps"),
    "odometry": Benchmark("accuracy.odometry", "lidar odometry of whole runs: jitter in roll and pitch, lean, steps"),
    "ground": Benchmark("accuracy.ground", "the ground filter on labelled LAS files"),
    "ablation": Benchmark("accuracy.ablation", "effect of each choice of the method"),
    "tracking": Benchmark("tracking.tracking", "errors, covariance, loss and recovery while tracked"),
    "protection": Benchmark("tracking.protection", "errors against their protection levels; calibrates these"),
    "integrity": Benchmark("integrity.integrity", "independent first fixes: right, false, none; with exact bounds"),
    "forest": Benchmark("forest.forest", "learned re-localization beside descriptors and canopy heights"),
    "forest_runs": Benchmark("forest.runs", "whole runs in forests, and runs outside the map"),
    "forest_scale": Benchmark("forest.scale", "time of a learned query on 0.1 and 1 km2"),
    "recognition": Benchmark("forest.recognition", "place recognition on public sets: AR@1, AR@5, AR@1 %, MRR"),
    "changes": Benchmark("fusion.changes", "precision and recall of fuse --changes"),
    "joint": Benchmark("fusion.joint", "errors of two runs with and without fuse --joint"),
    "stream": Benchmark("stream.stream", "robots over zenoh: rates, delays; sixteen robots on one node"),
    "fleet": Benchmark("stream.fleet", "hundreds of robots on a fleet of nodes, of which one is killed"),
    "fuzz": Benchmark("fuzz.fuzz", "untrusted bytes into every decoder and reader, within limits"),
    "soak": Benchmark("soak.soak", "hours with a fault every minute: false poses, stuck states, recovery, leaks"),
}


def counted(threads: int) -> str:
    """Write a number of threads."""
    return "1 thread" if threads == 1 else f"{threads} threads"


def run(name: str, words: Sequence[str], threads: int | None, limit_s: float = math.inf) -> Iterator[Row]:
    """Yield the rows of ``python -m bench NAME WORDS`` as they come.

    A benchmark that ends in an exception, is killed, runs past its limit or yields nothing adds a row that does not
    hold; its own output is shown on stderr only then. Raises CoViewError as it did.
    """
    conditions = (threads and counted(threads), "--quick" in words and "quick")
    label = "".join(f", {text}" for text in conditions if text)
    read, write = os.pipe()
    with tempfile.TemporaryFile("w+") as output, os.fdopen(read) as pipe:
        process = subprocess.Popen(
            [sys.executable, "-m", "bench", name, *words, "--rows-to", str(write)],
            env=environment(threads), pass_fds=(write,), stdin=subprocess.DEVNULL, stdout=output,
            stderr=subprocess.STDOUT, start_new_session=True,  # its own children end with it
        )  # fmt: skip
        os.close(write)
        late, count = threading.Event(), 0

        def end_late() -> None:
            late.set()
            _end(process)

        watch = threading.Timer(min(limit_s, threading.TIMEOUT_MAX), end_late)
        watch.daemon = True
        watch.start()
        try:
            for line in pipe:
                if line.endswith("\n"):  # not cut off
                    count += 1
                    row = Row.from_dict(json.loads(line))
                    yield replace(row, name=f"{row.name}{label}")
            code = process.wait()
        finally:
            watch.cancel()
            _end(process)
        output.seek(0)
        tail = output.read().splitlines()[-12:]
        if code == 2 and tail:
            raise CoViewError(tail[-1].removeprefix(f"bench {name}: "))
        if code < 0:
            why = f"ran past its {limit_s:g} s" if late.is_set() else f"ended by signal {signal.Signals(-code).name}"
        else:
            why = f"ended with exit code {code}" if code else "" if count else "yielded no row"
        if why:
            print("\n".join(tail), file=sys.stderr)
            yield failed(f"{name}{label}", why)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Kill a process with its children."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
