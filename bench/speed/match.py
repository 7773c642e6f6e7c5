"""The nearest stations to a keyframe, among 9,527 at all 60 shifts, beside the best that NumPy can do.

Both baselines (``Spectral``, ``Turned``) have everything made beforehand that depends on the map; the ratio is against
the faster of the two in the same run, one query at a time. Stations and keyframes are those of a simulated town, where
nothing is pruned easily; ``noise`` are random numbers; ``all alike`` are copies of one station, each with noise of 1 in
1000. The plain C++ loop (``peers/plain_loop.cpp``) has one thread, so that its ratio is judged where we have one too;
its time is the median of three runs, norms included. See docs/performance.md.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import time
from argparse import Namespace
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import fft

import coview_kernels as kernels
from bench.harness.rows import REPEAT, Row, against, bounded, informs, medians
from bench.harness.worlds import WORLDS, opened, places
from coview_kernels.runtime import workers
from coview_stream.descriptors.coview import describe, ground_below
from coview_stream.geometry.arrays import Floats32

STATIONS, MANY = 9_527, 100_000
BEST = 10

F16 = npt.NDArray[np.float16]
Found = tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]]  # stations, shifts and distances of the nearest


class Spectral:
    """Baseline: the product of the spectra, frequency by frequency, then all shifts by one real product."""

    def __init__(self, stations: F16) -> None:
        spectra = kernels.column_spectra(stations.astype(np.float32))
        self._spectra = np.ascontiguousarray(spectra.transpose(0, 2, 1))  # BLAS reads along the stations
        sectors = stations.shape[2]
        f, n = np.arange(len(spectra)), np.arange(sectors)
        weight = np.where((f == 0) | (2 * f == sectors), 1.0, 2.0) / sectors**2
        angle = 2.0 * np.pi / sectors * np.outer(n, f)
        self._turn = np.hstack([np.cos(angle) * weight, -np.sin(angle) * weight]).astype(np.float32)

    def __call__(self, query: Floats32, k: int) -> Found:
        """Return the ``k`` nearest."""
        wave = fft.rfft(kernels.unit_columns(query), axis=-1).T.conj()
        product = np.matmul(wave[:, None], self._spectra)[:, 0]  # conjugate, for the want of a copy
        return _best(self._turn @ np.concatenate([product.real, -product.imag]), k)


class Turned:
    """Baseline: 60 turned queries times all unit columns."""

    def __init__(self, stations: F16) -> None:
        self._columns = np.ascontiguousarray(kernels.unit_columns(stations).reshape(len(stations), -1).T)

    def __call__(self, query: Floats32, k: int) -> Found:
        """Return the ``k`` nearest."""
        sectors = query.shape[1]
        unit = kernels.unit_columns(query) / np.float32(sectors)
        windows = np.lib.stride_tricks.sliding_window_view(np.concatenate([unit, unit], axis=1), sectors, axis=1)
        return _best(windows[:, :sectors].transpose(1, 0, 2).reshape(sectors, -1) @ self._columns, k)


def _best(correlation: Floats32, k: int) -> Found:
    top = correlation.max(axis=0)
    chosen = np.argpartition(top, -k)[-k:]
    chosen = chosen[np.argsort(-top[chosen], kind="stable")]
    return chosen, correlation[:, chosen].argmax(axis=0), 1.0 - top[chosen]


def rows(asked: Namespace) -> Iterator[Row]:
    """Top-K beside the best of NumPy, then sizes and limits."""
    repeat = 5 if asked.quick else REPEAT
    known, queries = town()
    array = np.ones(64_000_000, dtype=np.float32)  # 256 MB
    read = min(medians(array.sum, array.view(np.int8).max, repeat=7))
    bandwidth = array.nbytes / read / 1e6
    yield informs("match/memory bandwidth, a large array summed by one thread", bandwidth, "GB/s")
    for name, stations in known.items():
        query, some = queries[name], stations[:STATIONS]
        start = time.perf_counter()
        index = kernels.MatchIndex(some)
        build = (time.perf_counter() - start) * 1e3
        spectral, turned = Spectral(some), Turned(some)
        for k in (BEST, 1, 100):
            for other in (spectral, turned):
                np.testing.assert_allclose(index.top_k(query, k).distance, other(query, k)[2], atol=2e-5)
            sides = (partial(side, query, k) for side in (index.top_k, spectral, turned))
            ours, *others = medians(*sides, repeat=repeat)
            target = 3.0 if k == BEST else None
            yield against(f"match/top {k} of {len(some)} stations, {name}", ours, min(others), "ms", target)
        yield bounded(f"match/making the index, {name}", build, "ms", 300.0)
    kilobytes = index.nbytes / len(index) / 1e3
    yield bounded("match/memory of the index per station", kilobytes, "kB", 3.0)
    whole = kilobytes + index.descriptors.nbytes / len(index) / 1e3
    yield informs("match/the same with the map's own descriptors, float16", whole, "kB")
    (ours,) = medians(partial(index.top_k, query, BEST), repeat=repeat)
    floor = index.nbytes / bandwidth / 1e6
    yield against("match/top 10 beside one reading of the index from memory", ours, floor, "ms", None)
    yield from _hard(query, repeat)
    few, many = (kernels.MatchIndex(multiplied(stations, count)) for count in (STATIONS, MANY))
    short, long = medians(partial(few.top_k, query, BEST), partial(many.top_k, query, BEST), repeat=repeat)
    yield informs(f"match/top 10 of {MANY} stations", long, "ms")
    yield bounded("match/time per station, many over few", (long / MANY) / (short / STATIONS), "x", 1.0)
    yield _against_loop(index, some, query, repeat)


def _hard(query: Floats32, repeat: int) -> Iterator[Row]:
    """Stations that bounds cannot tell apart, with the spectra at hand for the exhaustive way out."""
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((STATIONS, *query.shape)).astype(np.float16)
    alike = (rng.uniform(1, 9, query.shape) * (1 + 1e-3 * noise)).astype(np.float16)
    another = rng.standard_normal(query.shape).astype(np.float32)
    for name, stations, asked in (("noise", noise, another), ("all alike", alike, query)):
        index, spectral = kernels.MatchIndex(stations), Spectral(stations)
        spectra = kernels.column_spectra(stations.astype(np.float32))
        ours, base = medians(
            partial(index.top_k, asked, BEST, spectra=spectra), partial(spectral, asked, BEST), repeat=repeat
        )
        yield against(f"match/top 10, {name}, with spectra", ours, base, "ms", None)
        (alone,) = medians(partial(index.top_k, asked, BEST), repeat=repeat)
        yield against(f"match/top 10, {name}, without", alone, base, "ms", None)


def _against_loop(index: Any, stations: F16, query: Floats32, repeat: int) -> Row:
    """``peers/plain_loop.cpp`` on the same stations; it prints milliseconds, station, shift and distance."""
    name = "match/top 10 against a plain C++ loop, all shifts"
    (ours,) = medians(partial(index.top_k, query, BEST), repeat=repeat)
    compiler = shutil.which("g++") or shutil.which("c++") or shutil.which("clang++")
    if compiler is None:
        return informs(f"{name}: no C++ compiler here", ours, "ms")
    source = Path(__file__).parents[1] / "peers" / "plain_loop.cpp"
    with tempfile.TemporaryDirectory() as scratch:
        program, kept, asked = (str(Path(scratch) / part) for part in ("plain_loop", "stations", "query"))
        subprocess.run([compiler, "-O3", "-o", program, str(source)], check=True)
        stations.astype(np.float32).tofile(kept)
        query.astype(np.float32).tofile(asked)
        command = [program, kept, asked, *map(str, (*query.shape, len(stations)))]
        said = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    if not abs(index.top_k(query, 1).distance[0] - float(said[3])) < 1e-5:
        raise AssertionError(f"the loop found {said}, ours {index.top_k(query, 1)}")
    return against(name, ours, float(said[0]), "ms", 150.0 if workers() == 1 else None)


def town() -> tuple[dict[str, F16], dict[str, Floats32]]:
    """Descriptors (M, R, S) and a keyframe's (R, S), by channel, of a simulated town."""
    site, _, _ = opened(WORLDS["town"])
    newest = places("town", 2)[1].queries[-1]
    centre = np.array([*newest.position[:2], ground_below(newest.scan, newest.position)])
    queries = describe(newest.scan, centre, site.descriptor_config)
    order = np.random.default_rng(0).permutation(len(site))
    return {name: np.array(site.descriptors(name))[order] for name in queries}, queries


def multiplied(stations: F16, count: int) -> F16:
    """``count`` stations (count, R, S): beyond those there are, halves of two of them, each turned."""
    rng = np.random.default_rng(1)
    parts, half = [stations[:count]], stations.shape[2] // 2
    while sum(map(len, parts)) < count:
        made, other = (stations[rng.permutation(len(stations))] for _ in range(2))
        made = np.roll(made, int(rng.integers(stations.shape[2])), axis=2)
        made[:, :, :half] = other[:, :, :half]
        parts.append(made)
    return np.concatenate(parts)[:count]
