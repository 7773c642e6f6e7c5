"""Each kernel beside its NumPy twin, and quadrants beside Taichi: ``python -m bench kernels``.

A row per kernel at the sizes of a localizer step and of a map build; a kernel that does not win here is deleted.
The libraries, where both are installed, take turns in processes of their own: start, memory, and the same kernels.
``match``, ``frame``, ``map_build`` and ``registration`` compare with the best formulation known. Run it on idle cores:
a busy neighbour slows the kernels, which use all threads, more than NumPy.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import coview_kernels as ck
from bench.harness.files import environment
from bench.harness.rows import REPEAT, Row, against, medians
from coview_kernels import reference
from coview_stream.geometry.transforms import pose_from


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
    along, side = np.meshgrid(np.arange(-60, 60, 0.25), np.arange(-15, 15, 0.25))  # a street's ground and two walls
    parts = [np.column_stack([along.ravel(), side.ravel(), np.zeros(along.size)])]
    parts += [np.column_stack([along.ravel(), np.full(along.size, y), side.ravel() + 15]) for y in (-15.0, 15.0)]
    street = np.concatenate(parts).astype(np.float32)
    street += rng.normal(0, 0.02, street.shape).astype(np.float32)
    grid = ck.PointGrid(street)
    scan = street[rng.permutation(len(street))[:5_000]]
    scan += rng.normal(0, 0.1, scan.shape).astype(np.float32)
    for radius in (0.4, 3.0):
        yield f"nearest 5000, {radius} m", ck.nearest, nearest_in_tree, (grid, scan, radius)
    desc = rng.normal(2.0, 1.0, (9_527, 20, 60)).astype(np.float32)
    spectra = ck.column_spectra(desc)
    for q in (1, 8):  # BLAS beside einsum
        yield f"all_shift_distance {q} x 9527", ck.all_shift_distance, einsum_distance, (desc[:q], spectra, 60)


def measured() -> None:
    """Print what the library of this process takes: seconds, MB, and the milliseconds of each kernel, as JSON."""
    begin = time.perf_counter()
    ck.backend()
    started = time.perf_counter()
    ck.warm_up()
    found = {"import and start, s": started - begin, "all kernels loaded, s": time.perf_counter() - started}
    lines = (line.split() for line in Path("/proc/self/smaps_rollup").read_text().splitlines()[1:])
    kilobytes = {line[0]: float(line[1]) for line in lines}
    found["resident, MB"] = kilobytes["Rss:"] / 1024
    found["of which written to, MB"] = kilobytes["Private_Dirty:"] / 1024
    few = np.random.default_rng(1).normal(0.0, 20.0, (50, 3)).astype(np.float32)
    small = ("transform_unique 50", ck.transform_unique, None, (few, np.eye(4), 0.5, 1.0, 80.0))
    for name, ours, _, arguments in (*cases(), small):
        seconds = []
        for _ in range(REPEAT + 3):
            begin = time.perf_counter()
            ours(*arguments)
            seconds.append(time.perf_counter() - begin)
        found[f"{name}, ms"] = 1e3 * float(np.median(seconds[3:]))
    sys.stdout.write(json.dumps(found))


def _in_process(library: str, cache: Path) -> dict[str, float]:
    folders = {"TI_OFFLINE_CACHE_FILE_PATH": str(cache / "ti"), "QD_OFFLINE_CACHE_FILE_PATH": str(cache / "qd")}
    command = [sys.executable, "-c", "from bench.speed.kernels import measured; measured()"]
    out = subprocess.check_output(command, env=environment() | folders | {"COVIEW_KERNELS": library}, text=True)
    return dict(json.loads(out.splitlines()[-1]))


def libraries(repeat: int) -> Iterator[Row]:
    """Compare quadrants with Taichi; the first process of each compiles everything."""
    names = ("quadrants", "taichi")
    if missing := [name for name in names if importlib.util.find_spec(name) is None]:
        yield Row("kernels/quadrants beside taichi", text=f"{missing[0]} is not installed")
        return
    with tempfile.TemporaryDirectory(prefix="coview-cache.") as cache:
        turns = [{name: _in_process(name, Path(cache)) for name in names} for _ in range(repeat + 1)]
    key = "all kernels loaded, s"
    yield against("kernels/library: all kernels compiled, s", *(turns[0][name][key] for name in names), "s", None)
    for key in turns[0][names[0]]:
        ours, theirs = (float(np.median([turn[name][key] for turn in turns[1:]])) for name in names)
        yield against(f"kernels/library: {key}", ours, theirs, key.rpartition(" ")[2], None)


def rows(asked: Namespace) -> Iterator[Row]:
    """Compare every kernel with its twin."""
    ck.warm_up()
    for name, ours, numpy, arguments in cases():
        sides = partial(ours, *arguments), partial(numpy, *arguments)
        yield against(f"kernels/{name}", *medians(*sides, repeat=5 if asked.quick else REPEAT), "ms", 1.0)
    yield from libraries(1 if asked.quick else 5)
