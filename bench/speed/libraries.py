"""Quadrants beside Taichi, and prepared launches beside public calls: processes that take turns, the least of each.

Start, compilation and loading are in seconds of processor time; kernels, at the sizes of a localizer step, in
milliseconds of wall time on one thread. A public call checks and converts its arguments every time, on the owner
thread; see :mod:`coview_kernels.launch`.
"""

from __future__ import annotations

import importlib.util
import json
import math
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

import coview_kernels as ck
from bench.harness.files import environment
from bench.harness.rows import REPEAT, Row, against, number, table
from bench.speed.kernels import cases, street_and_scan
from coview_kernels import launch

_QUADRANTS, _TAICHI, _PUBLIC = "quadrants", "taichi", "quadrants, public calls"
SIDES = {_QUADRANTS: (_QUADRANTS, True), _TAICHI: (_TAICHI, True), _PUBLIC: (_QUADRANTS, False)}
"""Name of each side, its library, and whether launches are prepared."""

_WARM_UP = 3  # calls


def measured(prepared: bool) -> None:
    """Print what the library of this process takes, as JSON."""
    if not prepared:
        vars(launch)["tested"] = lambda library: False
    begin = time.process_time()
    ck.backend()
    started = time.process_time()
    ck.warm_up()
    found = {"import and start, s": started - begin, "all kernels loaded, s": time.process_time() - started}
    lines = (line.split() for line in Path("/proc/self/smaps_rollup").read_text().splitlines()[1:])
    kilobytes = {line[0]: float(line[1]) for line in lines}
    found["resident, MB"] = kilobytes["Rss:"] / 1024
    found["of which written to, MB"] = kilobytes["Private_Dirty:"] / 1024
    few = np.random.default_rng(1).normal(0.0, 20.0, (50, 3)).astype(np.float32)
    street, scan = street_and_scan()
    walls = street[:, 2] > 0.2
    normals = np.where(walls[:, None], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]).astype(np.float32)
    near = np.eye(4)
    near[:3, 3] = 0.2, 0.1, 0.05
    frame = scan[:1500]
    plan = frame, frame[:, 2] > 0.2, near, np.zeros(3), [ck.Scale(1.0, 0.3), ck.Scale(0.5, 0.2)]
    ours = {name: partial(kernel, *arguments) for name, kernel, _, arguments in cases()}
    ours["transform_unique 50"] = partial(ck.transform_unique, few, np.eye(4), 0.5, 1.0, 80.0)
    ours["align_planes 1500"] = partial(
        ck.align_planes, ck.PointGrid(street), normals, *plan, iterations=30, min_pairs=30
    )
    for name, run in ours.items():
        seconds = []
        for _ in range(REPEAT + _WARM_UP):
            begin = time.perf_counter()
            run()
            seconds.append(time.perf_counter() - begin)
        found[f"{name}, ms"] = 1e3 * min(seconds[_WARM_UP:])
    sys.stdout.write(json.dumps(found))


def _in_process(side: str, cache: Path) -> dict[str, float]:
    library, prepared = SIDES[side]
    folders = {"TI_OFFLINE_CACHE_FILE_PATH": str(cache / "ti"), "QD_OFFLINE_CACHE_FILE_PATH": str(cache / "qd")}
    command = [sys.executable, "-c", f"from bench.speed.libraries import measured; measured({prepared})"]
    out = subprocess.check_output(command, env=environment() | folders | {"COVIEW_KERNELS": library}, text=True)
    return dict(json.loads(out.splitlines()[-1]))


def rows(asked: Namespace) -> Iterator[Row]:
    """Compare the libraries; the first process of each compiles everything."""
    if missing := [name for name in (_QUADRANTS, _TAICHI) if importlib.util.find_spec(name) is None]:
        yield Row("libraries", text=f"{missing[0]} is not installed")
        return
    with tempfile.TemporaryDirectory(prefix="coview-cache.") as cache:
        turns = [{side: _in_process(side, Path(cache)) for side in SIDES} for _ in range(2 if asked.quick else 6)]
    first, later = turns[0], turns[1:]
    loaded = "all kernels loaded, s"
    yield _row("all kernels compiled, s", {side: first[side][loaded] for side in (_QUADRANTS, _TAICHI)})
    for key in first[_QUADRANTS]:
        yield _row(key, {side: min(turn[side][key] for turn in later) for side in SIDES})


def _row(name: str, least: dict[str, float]) -> Row:
    row = against(f"libraries/{name}", least[_QUADRANTS], least[_TAICHI], name.rpartition(" ")[2], None)
    return replace(row, details=least)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Return the table of the three sides."""
    del asked
    head = ("", *SIDES, "taichi / quadrants", "public / prepared")
    lines = []
    for row in (row for row in rows if row.details):
        least = [row.details.get(side, math.nan) for side in SIDES]
        cells = (*(number(value, 3) for value in least), *(number(value / least[0], 2) for value in least[1:]))
        lines.append([row.name.removeprefix("libraries/").removesuffix(", 1 thread"), *cells])
    return {"": table(head, lines)} if lines else {}
