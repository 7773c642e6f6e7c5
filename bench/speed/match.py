"""A keyframe's best score with every station, of 9,527 at all 60 shifts, beside the best that NumPy can do.

Scores are of both channels together, one query at a time, in a simulated town. The baseline is exact and has prepared
all that depends on the map: the product of the spectra, frequency by frequency, then all shifts by one real product.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
import numpy.typing as npt
from scipy import fft

import coview_kernels as kernels
from bench.harness.rows import REPEAT, Row, against, bounded, informs, medians
from bench.harness.worlds import WORLDS, opened, places
from coview_stream.descriptors.coview import describe, ground_below
from coview_stream.geometry.arrays import Floats32

STATIONS, MANY = 9_527, 100_000
F16 = npt.NDArray[np.float16]


class Spectral:
    """The baseline."""

    def __init__(self, stations: Sequence[F16]) -> None:
        spectra = np.concatenate([kernels.column_spectra(channel.astype(np.float32)) for channel in stations], axis=2)
        self._spectra = np.ascontiguousarray(spectra.transpose(0, 2, 1))  # BLAS reads along the stations
        sectors = stations[0].shape[2]
        f, n = np.arange(len(spectra)), np.arange(sectors)
        weight = np.where((f == 0) | (2 * f == sectors), 1.0, 2.0) / sectors**2
        angle = 2.0 * np.pi / sectors * np.outer(n, f)
        self._turn = np.hstack([np.cos(angle) * weight, -np.sin(angle) * weight]).astype(np.float32)

    def __call__(self, columns: Floats32) -> Floats32:
        """Return the best correlation (M,) of each station."""
        wave = fft.rfft(columns, axis=-1).T.conj()
        product = np.matmul(wave[:, None], self._spectra)[:, 0]  # the conjugate, which saves a copy
        return np.asarray((self._turn @ np.concatenate([product.real, -product.imag])).max(axis=0))


def rows(asked: Namespace) -> Iterator[Row]:
    """Time the best score of all stations beside NumPy, its memory, and its growth with the stations."""
    repeat = 5 if asked.quick else REPEAT
    site, _, _ = opened(WORLDS["town"])
    newest = places("town", 2)[1].queries[-1]
    centre = np.array([*newest.position[:2], ground_below(newest.scan, newest.position)])
    queries = describe(newest.scan, centre, site.descriptor_config)
    order = np.random.default_rng(0).permutation(len(site))
    stations = [np.array(site.descriptors(name))[order] for name in queries]
    columns = np.concatenate([kernels.unit_columns(channel) for channel in queries.values()])
    some = [channel[:STATIONS] for channel in stations]
    codes = kernels.StationCodes.of(some)
    sides = partial(codes.best, codes.query(columns)), partial(Spectral(some), columns)
    ours, numpy = medians(*sides, repeat=repeat)
    yield against(f"match/best score of each of {STATIONS} stations", ours, numpy, "ms", 3.0)
    yield bounded("match/memory per station", codes.codes.nbytes / len(codes), "B", 512.0)
    large = kernels.StationCodes.of([multiplied(channel, MANY) for channel in stations])
    short, long = medians(sides[0], partial(large.best, large.query(columns)), repeat=repeat)
    yield informs(f"match/best score of each of {MANY} stations", long, "ms")
    yield bounded("match/time per station, many over few", (long / MANY) / (short / STATIONS), "x", 1.5)


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
