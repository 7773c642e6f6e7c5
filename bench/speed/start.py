"""From nothing to ready: import, ``serve``, its search engine, and the first run ever; new processes, wall time.

``serve`` is ready when it reports so: map and sessions are open, and the tracking engine waits for frames with its
first kernels loaded. ``search prepared`` is a search engine alone, until it has its kernels, index and features. The
first run ever has an empty cache of compiled kernels. The map is small and simulated: files of any size are mapped.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np

from bench.harness.files import environment, folder
from bench.harness.rows import Row, bounded, informs
from bench.harness.worlds import map_of, prepare
from coview_stream.basemap.basemap import BaseMap
from coview_stream.sim import SimulationConfig
from coview_stream.stream.node.engine_process import EngineProcess

IMPORT, READY, FIRST = 0.25, 1.0, 10.0  # seconds
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


def search_prepared(site: Path, **variables: str) -> float:
    """Seconds until a new search engine would begin with a keyframe."""
    engine = EngineProcess("search", str(site), BaseMap.load(site).sha256)
    with mock.patch.dict(os.environ, variables):
        begin = time.perf_counter()
        try:
            engine.start()
            engine.wait_prepared()
            return time.perf_counter() - begin
        finally:
            engine.close()


def rows(asked: Namespace) -> Iterator[Row]:
    """Time each start a few times."""
    repeat, serves = (5, 1) if asked.quick else (_REPEAT, _SERVES)
    yield bounded("start/import coview_stream", float(np.median([imported() for _ in range(repeat)])), "s", IMPORT)
    config = SimulationConfig("town", "vlp16", seed=4005, size=120.0, length=0.0, density=10.0)
    prepare(folder(), config)
    site = map_of(folder(), config)
    served(site)  # leaves the compiled kernels in the cache
    yield bounded("start/serve ready", float(np.median([served(site) for _ in range(serves)])), "s", READY)
    yield informs("start/search prepared", float(np.median([search_prepared(site) for _ in range(serves)])), "s")
    for name, measure in (("serve ready", served), ("search prepared", search_prepared)):
        with tempfile.TemporaryDirectory(prefix="coview-cache.") as cache:
            seconds = measure(site, TI_OFFLINE_CACHE_FILE_PATH=cache, QD_OFFLINE_CACHE_FILE_PATH=cache)
            yield bounded(f"start/{name}, first run ever", seconds, "s", FIRST)
