"""Quadrants beside Taichi, prepared launches beside public calls, and each kernel beside its NumPy twin.

Processes that take turns; the least of each counts. A kernel that does not win over its twin is deleted.
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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import coview_kernels as ck
from bench.harness.files import environment
from bench.harness.rows import REPEAT, Row, against, number, table
from coview_kernels import launch, reference
from coview_stream.geometry.transforms import pose_from

_QUADRANTS, _TAICHI, _PUBLIC, _NUMPY = "quadrants", "taichi", "quadrants, public calls", "NumPy twin"
SIDES = {_QUADRANTS: _QUADRANTS, _TAICHI: _TAICHI, _PUBLIC: _QUADRANTS, _NUMPY: _QUADRANTS}
"""Name of each side, and its library."""

_WARM_UP = 3  # calls


def street_and_scan() -> tuple[np.ndarray, np.ndarray]:
    """Points of a street's ground and its two walls, and 5,000 of them with 10 cm of noise."""
    rng = np.random.default_rng(0)
    along, side = np.meshgrid(np.arange(-60, 60, 0.25), np.arange(-15, 15, 0.25))
    parts = [np.column_stack([along.ravel(), side.ravel(), np.zeros(along.size)])]
    parts += [np.column_stack([along.ravel(), np.full(along.size, y), side.ravel() + 15]) for y in (-15.0, 15.0)]
    street = np.concatenate(parts).astype(np.float32)
    street += rng.normal(0, 0.02, street.shape).astype(np.float32)
    scan = street[rng.permutation(len(street))[:5_000]]
    return street, scan + rng.normal(0, 0.1, scan.shape).astype(np.float32)


def cases() -> Iterator[tuple[str, Callable[..., Any], Callable[..., Any], tuple[Any, ...]]]:
    """Name, our kernel, its twin, and what both are called with."""

    def nearest_in_tree(grid: ck.PointGrid, scan: np.ndarray, radius: float) -> object:
        return reference.nearest(grid.tree, scan, radius)  # SciPy's k-d tree, queries alone

    def einsum_distance(query: np.ndarray, spectra: np.ndarray, sectors: int) -> np.ndarray:
        product = np.einsum("fmr,qrf->qmf", spectra.conj(), np.fft.rfft(ck.unit_columns(query), axis=-1))
        return 1.0 - np.fft.irfft(product, n=sectors, axis=-1) / sectors

    rng = np.random.default_rng(0)
    cloud = rng.normal(0.0, 20.0, (131_072, 3)).astype(np.float32)
    T = pose_from([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]], [1.0, 2.0, 3.0])
    for n in (20_000, 131_072):
        move = (cloud[:n], T, 0.3, 1.0, 80.0)
        yield f"transform_unique {n}", ck.transform_unique, reference.transform_unique, move
        yield f"polar_bin {n}", ck.polar_bin, reference.polar_bin, (cloud[:n], np.zeros(3), 20, 60, 50.0)
    top = rng.normal(5.0, 2.0, (600, 600)).astype(np.float32)
    count = rng.integers(0, 3, top.shape).astype(np.int32)
    at = rng.integers(0, 600, (2, 300)).astype(np.int32)
    raster = (top, count, 0.5, *at, rng.normal(size=300).astype(np.float32), 20, 60, 50.0)
    yield "station_bins 300", ck.station_bins, reference.station_bins, raster
    grid = reference.station_bins(*raster, raster_mean=top - 1.0)
    yield "coview 300", ck.coview, reference.coview, grid[:2]
    yield "paper_context 300", ck.paper_context, reference.paper_context, grid
    street, scan = street_and_scan()
    grid = ck.PointGrid(street)
    for radius in (0.4, 3.0):
        yield f"nearest 5000, {radius} m", ck.nearest, nearest_in_tree, (grid, scan, radius)
    desc = rng.normal(2.0, 1.0, (9_527, 20, 60)).astype(np.float32)
    spectra = ck.column_spectra(desc)
    for q in (1, 8):  # BLAS beside einsum
        yield f"all_shift_distance {q} x 9527", ck.all_shift_distance, einsum_distance, (desc[:q], spectra, 60)


def measured(side: str) -> None:
    """Print what a side takes in this process, as JSON."""
    if side == _PUBLIC:
        vars(launch)["tested"] = lambda library: False
    begin = time.process_time()
    ck.backend()
    started = time.process_time()
    ck.warm_up()
    found = {"import and start, s": started - begin, "all kernels loaded, s": time.process_time() - started}
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
    if side == _NUMPY:
        ours, found = {name: partial(twin, *arguments) for name, _, twin, arguments in cases()}, {}
    for name, run in ours.items():
        seconds = []
        for _ in range(REPEAT + _WARM_UP):
            begin = time.perf_counter()
            run()
            seconds.append(time.perf_counter() - begin)
        found[f"{name}, ms"] = 1e3 * min(seconds[_WARM_UP:])
    sys.stdout.write(json.dumps(found))


def _in_process(side: str, cache: Path) -> dict[str, float]:
    folders = {"TI_OFFLINE_CACHE_FILE_PATH": str(cache / "ti"), "QD_OFFLINE_CACHE_FILE_PATH": str(cache / "qd")}
    command = [sys.executable, "-c", f"from bench.speed.libraries import measured; measured({side!r})"]
    out = subprocess.check_output(command, env=environment() | folders | {"COVIEW_KERNELS": SIDES[side]}, text=True)
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
        yield _row(key, {side: min(turn[side][key] for turn in later) for side in SIDES if key in first[side]})


def _row(name: str, least: dict[str, float]) -> Row:
    row = against(f"libraries/{name}", least[_QUADRANTS], least[_TAICHI], name.rpartition(" ")[2], None)
    return replace(row, details=least)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Return the table of all sides."""
    del asked
    head = ("", *SIDES, "taichi / quadrants", "public / prepared", "NumPy / ours")
    lines = []
    for row in (row for row in rows if row.details):
        least = [row.details.get(side, math.nan) for side in SIDES]
        cells = (*(number(value, 3) for value in least), *(number(value / least[0], 2) for value in least[1:]))
        lines.append([row.name.removeprefix("libraries/").removesuffix(", 1 thread"), *cells])
    return {"": table(head, lines)} if lines else {}
