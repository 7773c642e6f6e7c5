"""Each kernel beside its NumPy twin, interleaved: ``python -m bench.kernels [--repeat 31]``.

Times are medians of wall time in milliseconds; the ratio says how many times faster ours is. A kernel that
does not win here is deleted. Run it on idle cores: a busy neighbour slows the kernels, which use all cores,
more than NumPy, and slows NumPy's own threaded products (normal_equations) most.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator

import numpy as np

import coview_kernels as ck
from coview_kernels import reference, runtime

Case = tuple[str, Callable[[], object], Callable[[], object]]


def cases() -> Iterator[Case]:
    """Name, our call and NumPy's call, at the sizes of a localizer step and of a map build."""
    rng = np.random.default_rng(0)
    cloud = rng.normal(0.0, 20.0, (131_072, 3)).astype(np.float32)
    T = np.eye(4)
    T[:2, :2], T[:3, 3] = [[0.6, -0.8], [0.8, 0.6]], [1.0, 2.0, 3.0]
    origin = np.zeros(3)
    for n in (20_000, 131_072):
        move = (cloud[:n], T, 0.3, 1.0, 80.0)
        yield (
            f"transform_unique {n}",
            lambda a=move: ck.transform_unique(*a),
            lambda a=move: reference.transform_unique(*a),
        )
        polar = (cloud[:n], origin, 20, 60, 50.0)
        yield f"polar_bin {n}", lambda a=polar: ck.polar_bin(*a), lambda a=polar: reference.polar_bin(*a)

    top = rng.normal(5.0, 2.0, (600, 600)).astype(np.float32)
    count = rng.integers(0, 3, top.shape).astype(np.int32)
    at = rng.integers(0, 600, (2, 300)).astype(np.int32)
    raster = (top, count, top * count, 0.5, *at, rng.normal(size=300).astype(np.float32), 20, 60, 50.0)
    yield "station_bins 300", lambda: ck.station_bins(*raster), lambda: reference.station_bins(*raster)
    stations = reference.station_bins(*raster)
    for m in (1, 300):
        grids = tuple(np.ascontiguousarray(a[:m]) for a in stations)
        yield f"coview {m}", lambda g=grids: ck.coview(*g), lambda g=grids: reference.coview(*g)

    # a street: ground and two walls, a point every quarter metre; the twin is SciPy's k-d tree, its queries alone
    along, side = np.meshgrid(np.arange(-60, 60, 0.25), np.arange(-15, 15, 0.25))
    flat = np.column_stack([along.ravel(), side.ravel(), np.zeros(along.size)])
    walls = [
        np.column_stack([along.ravel(), np.full(along.size, y), side.ravel() + 15]) for y in (-15.0, 15.0)
    ]
    street = np.concatenate([flat, *walls]).astype(np.float32) + rng.normal(0, 0.02, (3 * along.size, 3))
    grid = ck.PointGrid(street)
    scan = street[rng.permutation(len(street))[:5_000]] + rng.normal(0, 0.1, (5_000, 3))
    for radius in (0.4, 3.0):
        query = (scan.astype(np.float32), radius)
        yield (
            f"nearest 5000, {radius} m",
            lambda a=query: ck.nearest(grid, *a),
            lambda a=query: reference.nearest(grid.tree, *a),
        )

    for n in (2_000, 30_000):
        source = cloud[:n]
        pair = (source, source + np.float32(0.1), np.ones(n, np.float32), T, origin)
        for label, normals in (("plane", source / np.float32(20)), ("point", None)):
            a = (*pair[:2], normals, *pair[2:])
            yield (
                f"normal_equations {label} {n}",
                lambda a=a: ck.normal_equations(*a),
                lambda a=a: reference.normal_equations(*a),
            )


def medians(ours: Callable[[], object], numpy: Callable[[], object], repeat: int) -> tuple[float, float]:
    """Median milliseconds of both, taken in turns so that both meet the same load."""
    times = np.empty((repeat, 2))
    for side in (ours, numpy):
        side()
    for row in times:
        for k, side in enumerate((ours, numpy)):
            start = time.perf_counter()
            side()
            row[k] = time.perf_counter() - start
    first, second = np.median(times, axis=0) * 1e3
    return float(first), float(second)


def main() -> None:
    """Print a row per kernel, then the all-shift search, which is BLAS on every backend."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=int, default=31)
    repeat = parser.parse_args().repeat
    ck.warm_up()
    print(f"backend {ck.backend()}, {runtime.workers()} workers, medians of {repeat}")
    print(f"{'kernel':32}{'ours ms':>10}{'numpy ms':>10}{'ratio':>8}")
    for name, ours, numpy in cases():
        a, b = medians(ours, numpy, repeat)
        print(f"{name:32}{a:10.2f}{b:10.2f}{b / a:8.1f}")

    desc = np.random.default_rng(1).normal(2.0, 1.0, (9_527, 20, 60)).astype(np.float32)
    spectra = ck.column_spectra(desc)
    for q in (1, 8):
        blas = lambda q=q: ck.all_shift_distance(desc[:q], spectra, 60)  # noqa: E731 - the two sides of one comparison
        einsum = lambda q=q: _einsum_distance(desc[:q], spectra, 60)  # noqa: E731 - the two sides of one comparison
        a, b = medians(blas, einsum, max(5, repeat // 3))
        print(f"{f'all_shift_distance {q} x 9527':32}{a:10.2f}{b:10.2f}{b / a:8.1f}   (beside einsum)")


def _einsum_distance(query: np.ndarray, spectra: np.ndarray, sectors: int) -> np.ndarray:
    wave = np.fft.rfft(ck.unit_columns(query), axis=-1)
    product = np.einsum("fmr,qrf->qmf", spectra.conj(), wave)
    return 1.0 - np.fft.irfft(product, n=sectors, axis=-1) / sectors


if __name__ == "__main__":
    main()
