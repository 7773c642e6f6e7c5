"""The K stations nearest to a query (eqs 7-9), exactly, without computing every distance.

Bounds from one byte per number (:mod:`coview_kernels.screen`) leave a few stations; those are scored in
float64 from their descriptors. The answer is that of the exhaustive search:

* the distances are those of :func:`coview_kernels.all_shift_distance` within 1e-6 (that is float32);
* distances are compared after rounding to 1e-9; of equal ones the lower station comes first, and of equal
  shifts the lower one.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from coview_kernels import check, runtime
from coview_kernels.arrays import C64, F32, F64, I64
from coview_kernels.screen import MAX_SECTORS, Bounds, Screen
from coview_kernels.search import Search
from coview_kernels.similarity import all_shift_distance

_CHECKED = 1024
_PORTION = 256  # stations scored at a time, best bounds first: what follows may drop out meanwhile
_ROUNDED = 2e-9
_FLOAT = 2e-5  # all_shift_distance is float32


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
    """What the search keeps of M stations: about 1.3 kB each at 20 x 60, beside the descriptors themselves.

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
            np.isfinite(descriptors[i : i + _CHECKED]).all() for i in range(0, len(descriptors), _CHECKED)
        ):
            raise ValueError("descriptors hold NaN or inf")
        self.descriptors = descriptors
        self._screen = Screen(descriptors)
        self._search: Search | None = None

    def __len__(self) -> int:
        """Return the number of stations M."""
        return len(self.descriptors)

    @property
    def nbytes(self) -> int:
        """Bytes that the index adds to the descriptors."""
        return self._screen.nbytes

    def top_k(self, query: npt.ArrayLike, k: int, spectra: C64 | None = None) -> Nearest:
        """Find the ``k`` nearest stations (all M, if there are fewer), each at its best shift.

        Args:
            query: (R, S) descriptor, finite.
            k: at least 1.
            spectra: of all stations, from :func:`coview_kernels.column_spectra`, if the caller has them:
                the way out where bounds do not tell the stations apart (all alike, or noise).

        Raises:
            ValueError: shapes that do not fit, NaN or inf, or ``k`` below 1.
        """
        rings, sectors = self.descriptors.shape[1:]
        values = check.float32("query", query, rings, sectors)
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
        return self._nearest(values, found, k, spectra) if isinstance(found, Bounds) else found

    def __getstate__(self) -> dict[str, Any]:
        """Return what may be copied or sent to another process: all but the prepared launch."""
        return self.__dict__ | {"_search": None}

    def _ready(self) -> bool:
        return self._search is not None and self._search.ready()

    def _native(self, query: F32, k: int) -> Nearest | Bounds:
        if self._search is None:
            self._search = Search(self._screen, self.descriptors)
        few = self._search.scored(query, k)
        return self._search.bounds() if few is None else _first(k, *few)

    def _plain(self, query: F32, k: int) -> Nearest | Bounds:
        return self._screen.bounds(query)

    def _nearest(self, query: F32, bounds: Bounds, k: int, spectra: C64 | None) -> Nearest:
        """Score exactly whatever may be among the best."""
        turned = _turned(query)
        low, high = bounds.estimate - bounds.error, bounds.estimate + bounds.error
        station = np.argpartition(low, -k)[-k:]
        shift, found = self._scores(station, turned)
        least = float(found.min()) - _ROUNDED
        left = high >= least
        left[station] = False
        rest = np.flatnonzero(left)
        if spectra is not None and len(rest) > _PORTION:
            alike = 1.0 - all_shift_distance(query, spectra, query.shape[1]).min(axis=1)
            rest = rest[alike[rest] >= least - _FLOAT]
            high = np.minimum(high, alike + _FLOAT)
        rest = rest[np.argsort(-high[rest], kind="stable")]
        for start in range(0, len(rest), _PORTION):
            part = rest[start : start + _PORTION]
            part = part[high[part] >= float(np.partition(found, -k)[-k]) - _ROUNDED]
            if not len(part):
                break
            turns, more = self._scores(part, turned)
            station, shift = np.concatenate([station, part]), np.concatenate([shift, turns])
            found = np.concatenate([found, more])
        return _first(k, station, shift, found)

    def _scores(self, station: I64, turned: F64) -> tuple[I64, F64]:
        """Best shifts (n,) and their correlations, rounded to 1e-9, from the descriptors, in float64."""
        rows = _unit64(self.descriptors[station]).reshape(len(station), -1)
        correlation = np.round(rows @ turned.T, 9)
        shift = correlation.argmax(axis=1)
        return shift, correlation[np.arange(len(shift)), shift]


def _first(k: int, station: I64, shift: I64, correlation: F64) -> Nearest:
    order = np.lexsort((station, -correlation))[:k]
    return Nearest(station[order], shift[order], (1.0 - correlation[order]).astype(np.float32))


def _unit64(descriptors: npt.NDArray[Any]) -> F64:
    columns = descriptors.astype(np.float64)
    norm = np.sqrt((columns * columns).sum(axis=-2))[..., None, :]
    return columns / np.where(norm > 0, norm, 1.0)


def _turned(query: F32) -> F64:
    """(S, R S): in row n the query's unit columns, turned by n sectors, over S."""
    sectors = query.shape[1]
    unit = _unit64(query) / sectors
    windows = np.lib.stride_tricks.sliding_window_view(np.concatenate([unit, unit], axis=1), sectors, axis=1)
    return np.ascontiguousarray(windows[:, :sectors].transpose(1, 0, 2)).reshape(sectors, -1)
