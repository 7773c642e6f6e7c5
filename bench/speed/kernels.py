"""Each kernel beside its NumPy twin: ``python -m bench kernels``.

A row per kernel at the sizes of a localizer step and of a map build; a kernel that does not win here is deleted.
``libraries`` compares those that the kernels run on; ``match`` and ``registration`` compare with the best formulation
known. Run it on idle cores: a busy neighbour slows the kernels, which use all threads, more
than NumPy.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

import coview_kernels as ck
from bench.harness.rows import REPEAT, Row, against, medians
from coview_kernels import reference
from coview_stream.geometry.transforms import pose_from


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


def rows(asked: Namespace) -> Iterator[Row]:
    """Compare every kernel with its twin."""
    ck.warm_up()
    for name, ours, numpy, arguments in cases():
        sides = partial(ours, *arguments), partial(numpy, *arguments)
        yield against(f"kernels/{name}", *medians(*sides, repeat=5 if asked.quick else REPEAT), "ms", 1.0)
