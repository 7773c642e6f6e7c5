"""The K stations nearest to a query (eqs 7-9), exactly, without computing every distance.

Bounds from one byte per number (:mod:`coview_kernels.matching_bounds`) leave a few stations; those are scored in
float64 from their descriptors. The answer is that of the exhaustive search:

* the distances are those of :func:`coview_kernels.all_shift_distance` within 1e-6 (that is float32);
* distances are compared after rounding to 1e-9; of equal ones the lower station comes first, and of equal
  shifts the lower one.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from coview_kernels import runtime
from coview_kernels.arrays import C64, F32, F64, I32, I64, as_float32
from coview_kernels.launch import Launch
from coview_kernels.matching_bounds import MAX_SECTORS, Bounds, QuantizedStations, aligned_zeros
from coview_kernels.similarity import all_shift_distance

_CHECK_BATCH = 1024
_BATCH = 256  # stations scored at a time, best bounds first: later ones may drop out meanwhile
_ROUNDING = 2e-9
_FLOAT32_ERROR = 2e-5  # of all_shift_distance
_MAX_K = 128  # of the kernel; NumPy scores for a larger k
_MAX_LISTED = 2048  # stations that may be among the best; the kernel looks through all for each that it scores
_MIN_PARALLEL = 4_096  # stations from which other threads are worth waking
_FRESH, _K = 23, 24  # arguments of the kernel that change


class Nearest(NamedTuple):
    """The nearest stations, nearest first.

    Attributes:
        station: (k,) int64 index.
        shift: (k,) int64, the station's best shift n: yaw -2 pi n / S.
        distance: (k,) float32 in [0, 2].
    """

    station: I64
    shift: I64
    distance: F32


class MatchIndex:
    """Index of M stations for :meth:`top_k`: about 1.3 kB each at 20 x 60, beside the descriptors themselves.

    Args:
        descriptors: (M, R, S) float16 or float32, finite; kept, not copied: a memory map stays one. S is at
            most 63.

    Raises:
        ValueError: another shape or type, too many sectors, NaN or inf.
    """

    MAX_SECTORS = MAX_SECTORS

    def __init__(self, descriptors: npt.NDArray[Any]) -> None:
        if descriptors.ndim != 3 or not 1 <= descriptors.shape[2] <= MAX_SECTORS or not descriptors.shape[1]:
            raise ValueError(
                f"descriptors have shape {descriptors.shape}, expected (M, rings, 1 to {MAX_SECTORS} sectors)"
            )
        if descriptors.dtype not in (np.float16, np.float32):
            raise ValueError(f"descriptors are {descriptors.dtype}, expected float16 or float32")
        if not all(
            np.isfinite(descriptors[i : i + _CHECK_BATCH]).all() for i in range(0, len(descriptors), _CHECK_BATCH)
        ):
            raise ValueError("descriptors hold NaN or inf")
        self.descriptors = descriptors
        self._stations = QuantizedStations(descriptors)
        self._kernel: MatchKernel | None = None

    def __len__(self) -> int:
        """Return the number of stations M."""
        return len(self.descriptors)

    @property
    def nbytes(self) -> int:
        """Bytes that the index adds to the descriptors."""
        return self._stations.nbytes

    def top_k(self, query: npt.ArrayLike, k: int, spectra: C64 | None = None) -> Nearest:
        """Find the ``k`` nearest stations (all M, if there are fewer), each at its best shift.

        Args:
            query: (R, S) descriptor, finite.
            k: at least 1.
            spectra: of all stations, from :func:`coview_kernels.column_spectra`, if the caller has them:
                they are quicker where bounds do not tell the stations apart (all alike, or noise).

        Raises:
            ValueError: shapes that do not fit, NaN or inf, or ``k`` below 1.
        """
        rings, sectors = self.descriptors.shape[1:]
        values = as_float32("query", query, rings, sectors)
        if not np.isfinite(values).all():
            raise ValueError("query holds NaN or inf")
        if k < 1:
            raise ValueError(f"k must be at least 1, got {k}")
        k = min(k, len(self))
        if not values.any():  # every distance is 1
            return Nearest(np.arange(k), np.zeros(k, dtype=np.int64), np.ones(k, dtype=np.float32))
        if k == 0:
            return Nearest(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.float32))
        found = runtime.dispatch_here(self._ready, self._native, self._plain, values, k)
        return self._score_exactly(values, found, k, spectra) if isinstance(found, Bounds) else found

    def __getstate__(self) -> dict[str, Any]:
        """Return what may be copied or sent to another process: all but the prepared launch."""
        return self.__dict__ | {"_kernel": None}

    def _ready(self) -> bool:
        return self._kernel is not None and self._kernel.ready()

    def _native(self, query: F32, k: int) -> Nearest | Bounds:
        if self._kernel is None:
            self._kernel = MatchKernel(self._stations, self.descriptors)
        candidates = self._kernel.candidates(query, k)
        return self._kernel.bounds() if candidates is None else _best_of(k, *candidates)

    def _plain(self, query: F32, k: int) -> Nearest | Bounds:
        return self._stations.bounds(query)

    def _score_exactly(self, query: F32, bounds: Bounds, k: int, spectra: C64 | None) -> Nearest:
        """Score every station that may be among the best in float64."""
        shifted = _shifted(query)
        low, high = bounds.estimate - bounds.error, bounds.estimate + bounds.error
        station = np.argpartition(low, -k)[-k:]
        shift, found = self._scores(station, shifted)
        min_correlation = float(found.min()) - _ROUNDING
        left = high >= min_correlation
        left[station] = False
        rest = np.flatnonzero(left)
        if spectra is not None and len(rest) > _BATCH:
            alike = 1.0 - all_shift_distance(query, spectra, query.shape[1]).min(axis=1)
            rest = rest[alike[rest] >= min_correlation - _FLOAT32_ERROR]
            high = np.minimum(high, alike + _FLOAT32_ERROR)
        rest = rest[np.argsort(-high[rest], kind="stable")]
        for start in range(0, len(rest), _BATCH):
            part = rest[start : start + _BATCH]
            part = part[high[part] >= float(np.partition(found, -k)[-k]) - _ROUNDING]
            if not len(part):
                break
            shifts, more = self._scores(part, shifted)
            station, shift = np.concatenate([station, part]), np.concatenate([shift, shifts])
            found = np.concatenate([found, more])
        return _best_of(k, station, shift, found)

    def _scores(self, station: I64, shifted: F64) -> tuple[I64, F64]:
        """Best shifts (n,) and their correlations, rounded to 1e-9, from the descriptors, in float64."""
        rows = _unit64(self.descriptors[station]).reshape(len(station), -1)
        correlation = np.round(rows @ shifted.T, 9)
        shift = correlation.argmax(axis=1)
        return shift, correlation[np.arange(len(shift)), shift]


class MatchKernel:
    """The kernel that bounds all stations for a query and scores the best, and the memory it shares with NumPy.

    It runs on the owner thread, or as :meth:`ready` says.

    Args:
        stations: as bytes.
        descriptors: their (M, R, S); the kernel scores float16, C-contiguous, only.
    """

    def __init__(self, stations: QuantizedStations, descriptors: npt.NDArray[Any]) -> None:
        rings, blocks, lanes = stations.rings, stations.blocks, stations.lanes
        self._can_score = descriptors.dtype == np.float16 and descriptors.flags.c_contiguous
        self._residual = stations.residual
        self.query = aligned_zeros((2, rings, 2, blocks))
        self.turn = aligned_zeros((6 + 2 * blocks, lanes))
        self._raw = np.zeros((rings, stations.sectors), dtype=np.float32)
        # the query's norm, the turn's unit, the error common to all, number of stations listed
        self._found = np.zeros(4)
        self._best = np.empty(len(descriptors), dtype=np.int32)
        self._listed, self._shifts = np.zeros((2, _MAX_LISTED), dtype=np.int32)
        self._scores = np.zeros(_MAX_LISTED)
        arguments = (
            *(
                self._raw,
                stations.fourier,
                stations.step.astype(np.float64),
                stations.block_norm,
                stations.max_query_norm(),
            ),
            *(stations.rotations, stations.max_norm),
            *(np.empty((rings, 2, blocks)), np.empty((rings, 2 * stations.sectors)), np.empty(blocks)),
            *(self.query, self.turn, self._found),
            *(stations.stations, self._residual, self._best, lanes),
            descriptors.view(np.uint16) if self._can_score else np.empty(1, dtype=np.uint16),
            *(np.empty(_MAX_K), self._listed, np.empty(_MAX_LISTED), self._scores, self._shifts, 1, 0),
        )
        self._serial = runtime.workers() == 1 or len(descriptors) < _MIN_PARALLEL
        self._launch = Launch(
            "matching",
            f"match_{rings}_{stations.sectors}_{blocks}_{lanes}_{stations.shifts}_{int(self._serial)}",
            *(np.ascontiguousarray(a).reshape(-1) if isinstance(a, np.ndarray) else a for a in arguments),
        )
        self._k = 0

    def ready(self) -> bool:
        """Tell whether :meth:`candidates` may run on any thread, by :func:`coview_kernels.runtime.dispatch_here`."""
        return self._launch.ready()

    def candidates(self, query: F32, k: int) -> tuple[I64, I64, F64] | None:
        """Stations, shifts and correlations, rounded to 1e-9: the ``k`` best of all and some more, in any order.

        None if too many may be among them: :meth:`bounds` says which.
        """
        if k > _MAX_K or not self._can_score:
            k = 0
        if k != self._k:
            self._launch.put(_K, k)
            self._k = k
        self._raw[:] = query
        self._launch()
        n = int(self._found[3])
        if not 0 < n <= _MAX_LISTED or not k:
            return None
        return self._listed[:n].astype(np.int64), self._shifts[:n].astype(np.int64), self._scores[:n]

    def bounds(self) -> Bounds:
        """Bounds for the query of the last call."""
        size, unit, rest, _ = (float(x) for x in self._found)
        return Bounds(self._best.astype(np.float64) * unit, self._residual.astype(np.float64) * size + rest)

    def best(self, query: npt.NDArray[np.int16], turn: npt.NDArray[np.int16]) -> I32:
        """Greatest correlation over the shifts, (M,), in units of the turn, for a query's integers."""
        self.query[:] = query
        self.turn[:] = turn
        self._launch.put(_FRESH, 0)
        try:
            self._launch()
        finally:
            self._launch.put(_FRESH, 1)
        copied: I32 = self._best.copy()
        return copied


def _best_of(k: int, station: I64, shift: I64, correlation: F64) -> Nearest:
    order = np.lexsort((station, -correlation))[:k]
    return Nearest(station[order], shift[order], (1.0 - correlation[order]).astype(np.float32))


def _unit64(descriptors: npt.NDArray[Any]) -> F64:
    columns = descriptors.astype(np.float64)
    norm = np.sqrt((columns * columns).sum(axis=-2))[..., None, :]
    return columns / np.where(norm > 0, norm, 1.0)


def _shifted(query: F32) -> F64:
    """(S, R S): in row n the query's unit columns, shifted by n sectors, over S."""
    sectors = query.shape[1]
    unit = _unit64(query) / sectors
    windows = np.lib.stride_tricks.sliding_window_view(np.concatenate([unit, unit], axis=1), sectors, axis=1)
    return np.ascontiguousarray(windows[:, :sectors].transpose(1, 0, 2)).reshape(sectors, -1)
