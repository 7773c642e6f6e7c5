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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bench.harness.rows import Row, failed
from coview_stream.errors import CoViewError


@dataclass(frozen=True)
class Benchmark:
    """One name: where its ``rows`` are and how it is run.

    ``threads`` are counts to run it with, each in a process of its own; None leaves the count to the machine. Without
    any it runs in this process, as long as it takes.
    """

    module: str  # to import, below ``bench``
    what: str  # it measures, in one line
    threads: tuple[int | None, ...] = ()
    suite: tuple[str, ...] | None = None  # words it is run with when no name is given; None: not part of the suite
    limit_s: float = 240.0  # wall time after which it is ended in the suite: a row that does not hold
    page: bool = False  # whether the suite has it when it writes a page: tables and pictures without a target

    def load(self) -> Any:
        """Import its module."""
        return importlib.import_module(f"bench.{self.module}")

    def in_suite(self, writes: bool) -> bool:
        """Tell whether the suite has it, which writes a page or does not."""
        return self.suite is not None or (self.page and writes)


_BOTH, _ANY = (1, 2), (None,)

BENCHMARKS = {
    "kernels": Benchmark("speed.kernels", "each kernel beside its NumPy twin", _BOTH, ()),
    "match": Benchmark("speed.match", "one query against all stations at all shifts, top-K", _BOTH, ()),
    "learned_match": Benchmark(
        "speed.learned_match", "the vote by learned features, beside the dense comparison", (1,), (), 600.0
    ),
    "frame": Benchmark("speed.frame", "a frame: transform, filter, voxels; the descriptor of a keyframe", _BOTH, ()),
    "map_build": Benchmark("speed.map_build", "descriptors of 10,000 stations", _ANY, ()),
    "registration": Benchmark("speed.registration", "trimmed ICP beside small_gicp", _BOTH, ()),
    "engine": Benchmark("speed.engine", "Localizer.step on a large map: times, CPU share, memory", _ANY, ()),
    "search": Benchmark("speed.search", "the whole search step beside an earlier commit", _ANY, (), 1200.0),
    "scale": Benchmark("speed.scale", "the vote of a keyframe on a thousand to a million stations", (1,), (), 1200.0),
    "city": Benchmark("speed.city", "a city of 4 km2 as a directory: build, open, find robots, memory"),
    "large_build": Benchmark("speed.large_build", "building of hundreds of millions of points: time, memory, slopes"),
    "airborne": Benchmark(
        "speed.airborne", "search on a real airborne map of 1.5 km2: times, memory, sizes", limit_s=1800.0, page=True
    ),
    "start": Benchmark("stream.start", "import, first run, ready to serve", _ANY, ()),
    "peers": Benchmark(
        "peers.peers", "other libraries on the same queries", _ANY, ("--places", "10", "--limit", "30"), 420.0
    ),
    "accuracy": Benchmark("accuracy.accuracy", "errors, runs localised and false fixes in held-out worlds"),
    "conditions": Benchmark("accuracy.conditions", "real runs under a leaning sensor, bad odometry, fewer beams, gaps"),
    "lidar_odometry": Benchmark("accuracy.lidar_odometry", "lidar odometry: jitter in roll and pitch, lean, steps"),
    "airborne_real": Benchmark("accuracy.airborne_real", "real runs on airborne-like maps of the same places"),
    "field": Benchmark("accuracy.field", "the likelihood field beside the exact verification", page=True),
    "ablation": Benchmark("accuracy.ablation", "what each choice of the method is worth"),
    "ground": Benchmark("accuracy.ground", "the ground filter on labelled LAS files"),
    "where": Benchmark("speed.where", "where the time of a step goes, stage by stage", page=True),
    "search_stages": Benchmark(
        "speed.search_stages", "where the time of a search step goes, beside its floor", (1,), limit_s=900.0, page=True
    ),
    "plots": Benchmark("speed.plots", "the plots of docs/performance.md", limit_s=900.0, page=True),
    "tracking": Benchmark("tracking.tracking", "errors, covariance, loss and recovery while tracked"),
    "integrity": Benchmark("integrity.integrity", "independent first fixes: right, false, none; with exact bounds"),
    "protection": Benchmark("tracking.protection", "errors against their protection levels; what calibrates these"),
    "forest": Benchmark("forest.forest", "learned re-localization beside descriptors and canopy heights"),
    "forest_runs": Benchmark("forest.runs", "whole runs in forests, and runs outside the map"),
    "forest_scale": Benchmark("forest.scale", "time of a learned query on 0.1 and 1 km2"),
    "forest_plot": Benchmark("forest.plot", "a real plot among real airborne tiles"),
    "recognition": Benchmark("forest.recognition", "place recognition on public sets: AR@1, AR@5, AR@1 %, MRR"),
    "changes": Benchmark("fusion.changes", "what fuse --changes tags as new and gone, and what it leaves out"),
    "joint": Benchmark("fusion.joint", "whether fuse --joint pays: errors of two runs, and the distance between them"),
    "stream": Benchmark("stream.stream", "robots over zenoh: rates, delays, attacks"),
    "many": Benchmark("stream.many_robots", "sixteen robots on one node, of which eight search without end"),
    "fleet": Benchmark("stream.fleet", "hundreds of robots on a fleet of nodes, of which one is killed", limit_s=900.0),
    "fuzz": Benchmark("fuzz.fuzz", "untrusted bytes into every decoder and reader, within limits"),
    "soak": Benchmark(
        "soak.soak", "hours with a fault every minute: false poses, stuck states, time to recover, leaks"
    ),
}
"""Name, and what it is; in the suite's order."""


def thread_settings(threads: int | None) -> dict[str, str]:
    """Environment that gives BLAS, OpenMP and our kernels so many threads; empty for the machine's own."""
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "COVIEW_THREADS")
    return {} if threads is None else dict.fromkeys(names, str(threads))


def counted(threads: int) -> str:
    """Say a number of threads."""
    return "1 thread" if threads == 1 else f"{threads} threads"


ROOT = Path(__file__).parents[2]


def environment(threads: int | None = None) -> dict[str, str]:
    """Return ours, with both import roots of this checkout in front and so many threads."""
    path = os.pathsep.join(filter(None, (str(ROOT), str(ROOT / "kernels"), os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": path, **thread_settings(threads)}


def run(name: str, words: Sequence[str], threads: int | None, limit_s: float = math.inf) -> Iterator[Row]:
    """Yield the rows of ``python -m bench NAME WORDS`` as they come.

    A benchmark that ends in an exception, is killed, runs past its limit or yields nothing adds a row that does
    not hold and says so; what it printed itself is shown on stderr only then. Raises CoViewError as it did.
    """
    conditions = (threads and counted(threads), "--quick" in words and "quick")
    label = "".join(f", {said}" for said in conditions if said)
    read, write = os.pipe()
    with tempfile.TemporaryFile("w+") as said, os.fdopen(read) as pipe:
        process = subprocess.Popen(
            [sys.executable, "-m", "bench", name, *words, "--rows-to", str(write)],
            env=environment(threads), pass_fds=(write,), stdin=subprocess.DEVNULL, stdout=said,
            stderr=subprocess.STDOUT, start_new_session=True,  # so that its own children end with it
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
        said.seek(0)
        tail = said.read().splitlines()[-12:]
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
