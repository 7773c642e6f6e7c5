"""From nothing to ready: import, ``serve``, and the first run ever; each in new processes, wall time.

``serve`` is ready when it says so: map open, kernels warm, sessions open. The first ever run is the same with an empty
cache of compiled kernels. The map is a small simulated one: opening maps a file, whatever its size.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.harness.files import folder
from bench.harness.rows import Row, bounded
from bench.harness.suite import environment
from bench.harness.worlds import map_of, prepare
from coview_stream.sim import SimulationConfig

IMPORT, READY, FIRST = 0.25, 2.0, 10.0  # seconds
_REPEAT, _SERVES = 31, 7
_PATIENCE = 120.0


def imported() -> float:
    """Seconds of ``import coview_stream`` in a new interpreter, without those of the interpreter itself."""
    code = "import time; t = time.perf_counter(); import coview_stream; print(time.perf_counter() - t)"
    return float(subprocess.check_output([sys.executable, "-c", code], env=environment()))


def served(site: Path, **variables: str) -> float:
    """Seconds until a new ``coview-stream serve`` says that it is ready; NaN if it never does."""
    command = [sys.executable, "-m", "coview_stream", "serve", str(site), "--no-state", "--robot", "bench"]
    begin = time.perf_counter()
    node = subprocess.Popen(
        [*command, "--listen", "tcp/127.0.0.1:0"],
        env=environment() | variables, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    try:
        ready = any("ready after" in line for line in node.stdout or ())
        return time.perf_counter() - begin if ready else float("nan")
    finally:
        node.send_signal(signal.SIGTERM)
        node.communicate(timeout=_PATIENCE)


def rows(asked: Namespace) -> Iterator[Row]:
    """Time each start a few times."""
    repeat, serves = (5, 1) if asked.quick else (_REPEAT, _SERVES)
    yield bounded("start/import coview_stream", float(np.median([imported() for _ in range(repeat)])), "s", IMPORT)
    config = SimulationConfig("town", "vlp16", seed=4005, size=120.0, length=0.0, density=10.0)
    prepare(folder(), config)
    site = map_of(folder(), config)
    served(site)  # leaves the compiled kernels in the cache
    yield bounded("start/serve ready", float(np.median([served(site) for _ in range(serves)])), "s", READY)
    with tempfile.TemporaryDirectory(prefix="coview-cache.") as cache:
        yield bounded("start/serve ready, first run ever", served(site, TI_OFFLINE_CACHE_FILE_PATH=cache), "s", FIRST)
