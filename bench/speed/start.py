"""From nothing to ready: import, ``serve``, its search engine, and the first run ever; new processes, wall time.

``serve`` is ready when it reports so: map and sessions are open, and the tracking engine waits for frames with its
first kernel loaded. ``serve can search`` is when its health says so: the search engine has its kernels, index and
features, and would begin with a keyframe. The first run ever has an empty cache of compiled kernels. The map is small
and simulated: files of any size are mapped. Python keeps the bytecode of our modules, as an installation does.
"""

from __future__ import annotations

import contextlib
import math
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.harness.files import environment, folder
from bench.harness.rows import Row, bounded, informs
from bench.harness.worlds import map_of, prepare
from coview_stream.sim import SimulationConfig

IMPORT, READY, FIRST = 0.25, 1.0, 20.0  # seconds
_REPEAT, _SERVES = 31, 7
_PATIENCE, _INTERVAL = 120.0, 0.02


def imported() -> float:
    """Seconds of ``import coview_stream`` in a new interpreter, without those of the interpreter itself."""
    code = "import time; t = time.perf_counter(); import coview_stream; print(time.perf_counter() - t)"
    return float(subprocess.check_output([sys.executable, "-c", code], env=_environment()))


def served(site: Path, **variables: str) -> tuple[float, float]:
    """Seconds until a new ``coview-stream serve`` is ready, and until it can search as well; NaN if it never is."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        metrics = "{}:{}".format(*free.getsockname())
    command = [sys.executable, "-m", "coview_stream", "serve", str(site), "--no-state", "--robot", "bench"]
    begin = time.perf_counter()
    node = subprocess.Popen(
        [*command, "--listen", "tcp/127.0.0.1:0", "--metrics", metrics],
        env=_environment() | variables, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    try:
        ready = any("ready after" in line for line in node.stdout or ())
        seconds = time.perf_counter() - begin
        while ready and time.perf_counter() < begin + _PATIENCE:
            with contextlib.suppress(OSError), urllib.request.urlopen(f"http://{metrics}/health"):  # 503 until then
                return seconds, time.perf_counter() - begin
            time.sleep(_INTERVAL)
        return seconds if ready else math.nan, math.nan
    finally:
        node.send_signal(signal.SIGTERM)
        node.communicate(timeout=_PATIENCE)


def _environment() -> dict[str, str]:
    """Return our environment with the bytecode of all modules kept, and not in the checkout."""
    ours = {name: value for name, value in environment().items() if name != "PYTHONDONTWRITEBYTECODE"}
    return ours | {"PYTHONPYCACHEPREFIX": str(folder() / "bytecode")}


def rows(asked: Namespace) -> Iterator[Row]:
    """Time each start a few times."""
    repeat, serves = (5, 1) if asked.quick else (_REPEAT, _SERVES)
    yield bounded("start/import coview_stream", float(np.median([imported() for _ in range(repeat)])), "s", IMPORT)
    config = SimulationConfig("town", "vlp16", seed=4005, size=120.0, length=0.0, density=10.0)
    prepare(folder(), config)
    site = map_of(folder(), config)
    with tempfile.TemporaryDirectory(prefix="coview-cache.") as cache:
        caches = {"TI_OFFLINE_CACHE_FILE_PATH": cache, "QD_OFFLINE_CACHE_FILE_PATH": cache}
        first = served(site, **caches)
        ready, search = np.median([served(site, **caches) for _ in range(serves)], axis=0)
    yield bounded("start/serve ready", ready, "s", READY)
    yield informs("start/serve can search", search, "s")
    yield bounded("start/serve ready, first run ever", first[0], "s", FIRST)
    yield bounded("start/serve can search, first run ever", first[1], "s", FIRST)
