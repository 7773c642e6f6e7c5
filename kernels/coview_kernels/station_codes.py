r"""Correlation of a query with all stations (eqs 7-9) by 512 bytes per station, for any number of channels and rings.

The correlation at shift n is a sum over the frequencies f of :math:`Re(conj(c_f) . q_f e^{i 2 pi f n / S})`, where c
and q are spectra of unit columns, all rings of all channels together. The codes keep the directions of most variance
of the lowest 32 frequencies: c_f is projected on the first 12 eigenvectors of its second moments over a sample of the
stations, 4 from frequency 16 on (Karhunen-Loeve transform), and stored as int8 with a step for each number. The query
is transformed likewise, at higher precision; its channels may be weighted.

The loss is the same at every shift: right places keep nine tenths of their lead, and ``python -m bench city`` counts
the right places that the search loses by it.

A station is (16, 16) int16, rows by lanes. Rows 0 to 11 hold frequencies 0 to 15, rows 12 to 15 the higher frequencies.
The first 8 lanes hold even frequencies, the others odd frequencies, which change sign after half a turn, so that one
sum serves two angles. The lower byte is the real part, and the whole number in units of 256 is the imaginary part, so
that a product takes one shift at most, and no unpacking.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from coview_kernels import reference, runtime
from coview_kernels.arrays import C64, F32, I16, I32, I64, as_float32
from coview_kernels.launch import Launch
from coview_kernels.mapped import Windows, take_rows
from coview_kernels.similarity import unit_columns
from coview_kernels.warm_up import compiled_by

ANGLES = 60
"""Number of angles that :meth:`StationCodes.best` tries."""

_LANES, _LOW, _HIGH = 16, 12, 4  # as in _ti_station_codes.py
_ROWS = _LOW + _HIGH
_GROUP = np.repeat([0, 1], [_LOW, _HIGH])  # of each row
_LANE = np.concatenate([np.arange(0, 16, 2), np.arange(1, 16, 2)])  # frequency of each lane in the first group
_FREQUENCIES = 32
_BATCH = 512  # stations transformed at a time
_SAMPLE = 2048  # stations from which transform and steps are learned
_INT8_RANGE = 6.0  # standard deviations that int8 spans: 5 to 8 differ by a tenth in error on simulated sites
_MARGIN = 1.1  # range, as a multiple of the greatest number in the sample
_MAX_SUM = 32_500.0  # of int16, with room for rounding errors
_MIN_PARALLEL = 4096  # stations from which waking other threads pays
_BEST, _PRODUCTS, _AT = range(3)  # launches
_CHUNK = 4096  # pairs of station and shift at a time


class Screen(NamedTuple):
    """A query in integers, for :meth:`StationCodes.best`."""

    integers: I16
    """(2, 16, 2, 16) for real and imaginary products."""
    turn: I16
    """(65, 16) zeros, then scaled cosines and minus sines of the 32 frequencies (rows) at 16 angles."""
    unit: float
    """Value of one unit of the turned products."""


@dataclass(frozen=True)
class CodedQuery:
    """A transformed query, with the ``step``, ``norm`` and ``sectors`` of :class:`StationCodes`."""

    numbers: C64
    """(16, 16) transform of the query."""
    step: F32
    norm: F32
    sectors: int

    @cached_property
    def screen(self) -> Screen:
        """The query for :meth:`StationCodes.best`."""
        p, s = self.numbers.real, self.numbers.imag
        pair = np.stack([np.stack([p, s], axis=1), np.stack([s, -p], axis=1)]) * self.step
        size = np.sqrt(np.stack([(pair[:, g == _GROUP] ** 2).sum(axis=(1, 2)).max(axis=0) for g in (0, 1)]))
        limit = np.minimum((_MAX_SUM - 4.0 * _ROWS) * 256.0 / np.maximum(self.norm[:-1].reshape(2, -1), 1.0), 32_000.0)
        gain = limit / np.maximum(size, 1e-30)
        scale = np.where(size > 0, 256.0 / gain, 0.0)  # of one unit of a product
        span = float(self.norm[-1]) * float(np.linalg.norm(self.numbers)) + _ROWS * float(scale.sum())
        unit = max(2.01 * float(scale.max()), span / 31_000.0, 1e-30)
        angle = (2.0 * np.pi / ANGLES) * _frequencies()[:, :, None] * np.arange(_LANES)
        factor = (65_536.0 / unit * scale)[:, :, None]
        turn = np.concatenate([np.cos(angle) * factor, -np.sin(angle) * factor]).reshape(-1, _LANES)
        return Screen(
            np.rint(pair * gain[_GROUP][:, None]).astype(np.int16),
            np.rint(np.concatenate([np.zeros((1, _LANES)), turn])).astype(np.int16),
            unit,
        )

    @cached_property
    def factors(self) -> F32:
        """Factors (16, 4, 16) of a station's numbers, for real and imaginary products without rounding."""
        p, s = self.numbers.real, self.numbers.imag
        real, whole = self.step[:, 0], self.step[:, 1] * np.float32(1.0 / 256.0)
        return np.ascontiguousarray(np.stack([p * real, s * whole, s * real, -p * whole], axis=1), dtype=np.float32)

    @cached_property
    def table(self) -> F32:
        """Factors (S, 16, 2, 16) of a station's numbers, for the correlation at every shift."""
        turned = self.numbers * _turns(self.sectors)
        table = np.empty((self.sectors, _ROWS, 2, _LANES), dtype=np.float32)
        np.multiply(turned.real, self.step[:, 0], out=table[:, :, 0])
        np.multiply(turned.imag, self.step[:, 1] * np.float32(1.0 / 256.0), out=table[:, :, 1])
        return table


_Request = tuple[CodedQuery, I32, I32]


class StationCodes:
    """Codes of M stations, 512 bytes each, for comparison with queries.

    Attributes:
        codes: (M, 16, 16) int16; a memory map is not copied, and only a window of a large map is in memory.
        basis: (16, 16, D) complex64 eigenvectors; D is rings times channels.
        step: (16, 2, 16) float32 value of one unit of int8, real and imaginary.
        norm: (33,) float32 greatest norm of any station's integers, by frequency block and of all its numbers.
        sectors: number of shifts S.

    Raises:
        ValueError: there are more than ``MAX_STATIONS``.
    """

    LEARNED = _SAMPLE
    """Greatest number of stations from which codes are learned."""

    MAX_STATIONS = 2**31 // (_ROWS * _LANES) - 1
    """Greatest number of stations, as the kernels index codes with 32 bits."""

    def __init__(self, codes: I16, basis: C64, step: F32, norm: F32, sectors: int) -> None:
        if len(codes) > self.MAX_STATIONS:
            raise ValueError(f"{len(codes)} stations, {self.MAX_STATIONS} at most")
        self.codes = codes
        self.basis = basis
        self.step = step
        self.norm = norm
        self.sectors = sectors

    @classmethod
    def of(cls, descriptors: Sequence[npt.NDArray[Any]]) -> StationCodes:
        """Code stations by their descriptors, in the first tier of :meth:`tiers` alone."""
        return cls.tiers(descriptors, 1)[0]

    @classmethod
    def tiers(cls, descriptors: Sequence[npt.NDArray[Any]], count: int) -> list[StationCodes]:
        """Code stations by their descriptors (M, R, S), float16 or float32, one array per channel.

        Each tier codes the remainder of the earlier tiers, so that the correlations add up.

        Raises:
            ValueError: the channels' shapes differ.
        """
        stations = len(descriptors[0])
        made = cls.empty_tiers([channel[cls.learned_from(stations)] for channel in descriptors], count, stations)
        cls.encode_tiers(made, slice(0, stations), descriptors)
        return made

    @staticmethod
    def learned_from(stations: int) -> I64:
        """Return the numbers (K,) of the sample, evenly spaced, of the given number of stations."""
        return np.arange(0, stations, -(-stations // _SAMPLE) or 1)

    @classmethod
    def empty_tiers(
        cls, sample: Sequence[npt.NDArray[Any]], count: int, stations: int, into: Sequence[I16] | None = None
    ) -> list[StationCodes]:
        """Return ``count`` tiers for :meth:`encode_tiers` to fill, learned from the descriptors of a sample.

        Args:
            sample: descriptors (K, R, S) of :meth:`learned_from`, one array per channel.
            count: number of tiers.
            stations: number of stations M to be coded.
            into: arrays (M, 16, 16) for the codes of each tier; None allocates them.

        Raises:
            ValueError: the channels' shapes differ.
        """
        if any(channel.shape != sample[0].shape for channel in sample):
            raise ValueError(f"descriptors have shapes {[c.shape for c in sample]}, expected one for all")
        sectors, spectra = sample[0].shape[2], _spectra(_columns(sample))
        if into is None:
            into = [np.empty(cls.shape_of(stations), dtype=np.int16) for _ in range(count)]
        return [
            cls(codes, basis, _steps(spectra, basis), np.zeros(2 * _LANES + 1, dtype=np.float32), sectors)
            for codes, basis in zip(into, _eigenvectors(spectra, count), strict=True)
        ]

    @staticmethod
    def shape_of(stations: int) -> tuple[int, int, int]:
        """Return the shape of the codes for a number of stations."""
        return stations, _ROWS, _LANES

    @staticmethod
    def encode_tiers(tiers: Sequence[StationCodes], part: slice, descriptors: Sequence[npt.NDArray[Any]]) -> None:
        """Fill in part of the codes from the descriptors (m, R, S) of these stations, one array per channel."""
        for start in range(part.start, part.stop, _BATCH):
            batch = slice(start, min(start + _BATCH, part.stop))
            rows = slice(batch.start - part.start, batch.stop - part.start)
            spectra = _spectra(_columns([channel[rows] for channel in descriptors]))
            for tier in tiers:
                tier._encode(batch, spectra)

    def _encode(self, part: slice, spectra: C64) -> None:
        self.codes[part] = _pack(_parts(_projected(spectra, self.basis)) / self.step)
        whole = _unpack(self.codes[part])
        groups = whole[:, :_LOW], whole[:, _LOW:]
        blocks = np.concatenate([(each * each).sum(axis=(1, 2)) for each in groups], axis=1)
        self.norm[:-1] = np.maximum(self.norm[:-1], np.sqrt(blocks.max(axis=0)))
        self.norm[-1] = max(self.norm[-1], np.sqrt(((whole * self.step) ** 2).sum(axis=(1, 2, 3)).max()))

    def __len__(self) -> int:
        return len(self.codes)

    def subset(self, stations: npt.ArrayLike) -> StationCodes:
        """Copy the codes of stations (K,) into memory; queries of these codes are valid for the copy too."""
        rows = take_rows(self.codes, np.asarray(stations, dtype=np.int64))
        return StationCodes(rows, self.basis, self.step, self.norm, self.sectors)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the prepared launches."""
        return {name: value for name, value in self.__dict__.items() if name != "_kernels"}

    def query(self, columns: npt.ArrayLike) -> CodedQuery:
        """Transform a query's unit columns (D, S), with channels weighted and stacked in the stations' order.

        Raises:
            ValueError: the shape is wrong.
        """
        stacked = as_float32("columns", columns, self.basis.shape[2], self.sectors)
        numbers = _projected(_spectra(stacked[None]), self.basis)[0]
        return CodedQuery(numbers, self.step, self.norm, self.sectors)

    def query_of(self, station: int) -> CodedQuery:
        """Return a station as a query: its surroundings in its own axes."""
        parts = _unpack(self.codes[station]) * self.step
        return CodedQuery((parts[:, 0] + 1j * parts[:, 1]).astype(np.complex64), self.step, self.norm, self.sectors)

    def best(self, query: CodedQuery) -> F32:
        """Return the greatest correlation (M,) with each station over 60 angles, which are all shifts of 60 sectors."""
        numbers, turn, unit = query.screen
        best = runtime.dispatch_here(
            self._ready(_BEST),
            lambda: self._kernels.best(numbers, turn),
            lambda: reference.best_codes(self.codes, numbers, turn),
        )
        return best * np.float32(unit)

    def all_shifts(self, query: CodedQuery, stations: npt.ArrayLike) -> F32:
        """Return the correlations (K, S) with stations (K,) at all shifts."""
        index = np.ascontiguousarray(stations, dtype=np.int32)
        products = runtime.dispatch_here(
            self._ready(_PRODUCTS),
            lambda: self._kernels.products(query.factors, index),
            lambda: reference.code_products(self.codes, query.factors, index),
        )
        return np.asarray(products.reshape(len(index), -1) @ self._rotations)

    def at(self, query: CodedQuery, stations: npt.ArrayLike, shifts: npt.ArrayLike) -> F32:
        """Return the correlations (K,) with stations (K,) at shifts (K,); 0 for station -1."""
        return self.at_all([(query, stations, shifts)])[0]

    def at_all(self, requests: Sequence[tuple[CodedQuery, npt.ArrayLike, npt.ArrayLike]]) -> list[F32]:
        """Return the result of :meth:`at` for each request, in one pass over a large memory map."""
        plain: list[_Request] = []
        for query, stations, shifts in requests:
            index, turned = (np.ascontiguousarray(each, dtype=np.int32) for each in (stations, shifts))
            plain.append((query, index, np.broadcast_to(turned, index.shape)))
        return runtime.dispatch_here(
            self._ready(_AT),
            lambda: self._kernels.at(plain),
            lambda: [reference.codes_at(self.codes, query.table, *pairs) for query, *pairs in plain],
        )

    @cached_property
    def _rotations(self) -> F32:
        """Factors (64, S) of the products at the shifts."""
        angle = (2.0 * np.pi / self.sectors) * _frequencies()[:, :, None] * np.arange(self.sectors)
        return np.stack([np.cos(angle), -np.sin(angle)], axis=1).reshape(4 * _LANES, -1).astype(np.float32)

    @cached_property
    def lengths(self) -> F32:
        """(M,) norms of the stations' numbers."""
        norms = np.empty(len(self), dtype=np.float32)
        for start in range(0, len(self), _BATCH):
            part = slice(start, start + _BATCH)
            norms[part] = np.linalg.norm(
                (_unpack(self.codes[part]) * self.step).reshape(-1, 2 * _ROWS * _LANES), axis=1
            )
        return np.maximum(norms, np.float32(1e-6))

    def _ready(self, launch: int) -> Callable[[], bool]:
        return lambda: "_kernels" in vars(self) and self._kernels.launches[launch].ready()

    @cached_property
    def _kernels(self) -> _Kernels:
        return _Kernels(self.codes)


class _Kernels:
    """Launches and the memory that they share with NumPy, for one call at a time."""

    def __init__(self, codes: I16) -> None:
        self._codes, flat = codes, codes.reshape(-1)
        self._windows = Windows(codes)
        self._query = np.zeros((2, _ROWS, 2, _LANES), dtype=np.int16)
        self._turn = np.zeros((1 + 4 * _LANES, _LANES), dtype=np.int16)
        self._best = np.empty(len(codes), dtype=np.int32)
        self._stations, self._shifts = np.zeros((2, _CHUNK), dtype=np.int32)
        self._factors = np.zeros((_ROWS, 4, _LANES), dtype=np.float32)
        self._products = np.zeros((_CHUNK, 2, 2, _LANES), dtype=np.float32)
        self._values = np.zeros(_CHUNK, dtype=np.float32)
        serial = runtime.workers() == 1 or len(codes) < _MIN_PARALLEL
        name = "best_serial" if serial else "best_parallel"
        common = self._query.reshape(-1), self._turn.reshape(-1), self._best, _LANES
        self.launches = (
            Launch("station_codes", name, flat, *common),
            Launch(
                *("station_codes", "products", flat, self._factors.reshape(-1), self._stations),
                *(self._products.reshape(-1), 0),
            ),
            Launch(
                *("station_codes", "at", flat, self._factors.reshape(-1), self._stations, self._shifts),
                *(self._values, 0),
            ),
        )

    def best(self, query: I16, turn: I16) -> I32:
        self._query[:], self._turn[:] = query, turn
        launch = self.launches[_BEST]
        for part in self._windows:
            launch.put(0, self._codes[part].reshape(-1))
            launch.put(3, self._best[part])
            launch()
        copied: I32 = self._best.copy()
        return copied

    def products(self, factors: F32, stations: I32) -> F32:
        self._factors[:] = factors
        found = np.empty((len(stations), 2, 2, _LANES), dtype=np.float32)
        launch, chosen = self.launches[_PRODUCTS], _ByWindow(stations, self._windows)
        for part in self._windows:
            launch.put(0, self._codes[part].reshape(-1))
            for own in chosen.chunks(part):
                self._stations[: len(own)] = stations[own] - part.start
                launch.put(4, len(own))
                launch()
                found[own] = self._products[: len(own)]
        return found

    def at(self, requests: Sequence[_Request]) -> list[F32]:
        launch = self.launches[_AT]
        found = [np.zeros(len(stations), dtype=np.float32) for _, stations, _ in requests]
        chosen = [_ByWindow(stations, self._windows) for _, stations, _ in requests]
        for part in self._windows:
            launch.put(0, self._codes[part].reshape(-1))
            for (query, stations, shifts), into, each in zip(requests, found, chosen, strict=True):
                launch.put(1, query.table.reshape(-1))
                for own in each.chunks(part):
                    count = len(own)
                    self._stations[:count], self._shifts[:count] = stations[own] - part.start, shifts[own]
                    self._values[:count] = 0.0
                    launch.put(5, count)
                    launch()
                    into[own] = self._values[:count]
        return found


class _ByWindow:
    """Stations (K,) by window; station -1 is in no window, or in the only one."""

    def __init__(self, stations: I32, windows: Windows) -> None:
        self._several = windows.several
        self._order = np.argsort(stations, kind="stable") if windows.several else np.arange(len(stations))
        self._sorted = stations[self._order]

    def chunks(self, part: slice) -> Iterator[I64]:
        """Yield the indices of a window's stations, at most ``_CHUNK`` at a time."""
        begin, end = 0, len(self._order)
        if self._several:
            begin, end = np.searchsorted(self._sorted, [part.start, part.stop]).tolist()
        for start in range(begin, end, _CHUNK):
            yield self._order[start : min(start + _CHUNK, end)]


def _frequencies() -> I64:
    """Return the frequency (2, 16) of each lane, by group."""
    return np.stack([_LANE, _LANE + _LANES])


@lru_cache(maxsize=4)
def _turns(sectors: int) -> C64:
    """Return the factors (S, 16, 16) that turn a query's numbers by each shift."""
    angle = (2.0 * np.pi / sectors) * np.arange(sectors)[:, None, None] * _frequencies()[_GROUP]
    turns: C64 = np.exp(1j * angle).astype(np.complex64)
    return turns


def _columns(descriptors: Sequence[npt.NDArray[Any]]) -> F32:
    """Return the unit columns (m, D, S) of the channels' descriptors (m, R, S)."""
    return np.concatenate([unit_columns(channel) for channel in descriptors], axis=1)


def _spectra(columns: F32) -> C64:
    """Return spectra (32, m, D) of columns (m, D, S), weighted so that correlations are sums; 0 beyond S / 2."""
    sectors = columns.shape[2]
    known = min(_FREQUENCIES, sectors // 2 + 1)
    spectra = np.zeros((_FREQUENCIES, *columns.shape[:2]), dtype=np.complex64)
    frequency = np.arange(known)
    weight = np.where((frequency == 0) | (2 * frequency == sectors), 1.0, np.sqrt(2.0)) / sectors
    whole = np.fft.rfft(columns, axis=-1)[..., :known] * weight.astype(np.float32)
    spectra[:known] = whole.transpose(2, 0, 1)
    return spectra


def _eigenvectors(sample: C64, tiers: int) -> list[C64]:
    """Return by tier eigenvectors (16, 16, D) of spectra's (32, m, D) second moments, greatest first; 0 beyond D."""
    moments = np.matmul(sample.transpose(0, 2, 1).astype(np.complex128), sample.conj())
    vectors = np.linalg.eigh(moments)[1][:, :, ::-1]  # (32, D, D)
    found = np.zeros((tiers, _ROWS, _LANES, sample.shape[2]), dtype=np.complex64)
    for tier in range(tiers):
        for group, (first, rows) in enumerate(((0, _LOW), (_LOW, _HIGH))):
            kept = vectors[_frequencies()[group], :, tier * rows : (tier + 1) * rows].transpose(2, 0, 1)
            found[tier, first : first + len(kept)] = kept
    return list(found)


def _steps(sample: C64, basis: C64) -> F32:
    """Return the values (16, 2, 16) of one unit of int8; numbers beyond its range are clipped."""
    if not sample.shape[1]:
        return np.ones((_ROWS, 2, _LANES), dtype=np.float32)
    parts = _parts(_projected(sample, basis))
    square = (parts * parts).mean(axis=0)
    least = 1e-3 * square.max(initial=0.0) + 1e-12  # for numbers that are zero in the sample
    # a number that stays near its mean, such as a column's sum, uses more of the integers
    reach = np.minimum(_INT8_RANGE * np.sqrt(square), _MARGIN * np.abs(parts).max(axis=0))
    return np.asarray(np.maximum(reach, np.sqrt(least)) * (1.0 / 127.0), dtype=np.float32)


def _projected(spectra: C64, basis: C64) -> C64:
    """Return the numbers (m, 16, 16) of spectra (32, m, D)."""
    numbers = np.empty((spectra.shape[1], _ROWS, _LANES), dtype=np.complex64)
    for group, rows in enumerate((slice(0, _LOW), slice(_LOW, _ROWS))):
        lanes = spectra[_frequencies()[group]]  # (16, m, D)
        numbers[:, rows] = np.matmul(lanes, basis[rows].conj().transpose(1, 2, 0)).transpose(1, 2, 0)
    return numbers


def _parts(numbers: C64) -> F32:
    """Return the real and imaginary parts (m, 16, 2, 16)."""
    return np.stack([numbers.real, numbers.imag], axis=2)


def _pack(numbers: F32) -> I16:
    """Pack (..., 2, L) to int16 (..., L); the second is in the upper byte, rounded to allow for the lower byte."""
    low = np.clip(np.rint(numbers[..., 0, :]), -127, 127).astype(np.int16) & 255
    high = np.clip(np.rint(numbers[..., 1, :] - low * np.float32(1.0 / 256.0)), -127, 127).astype(np.int16)
    packed: I16 = (high << 8) | low
    return packed


def _unpack(pair: I16) -> F32:
    """Unpack int16 (..., L) to numbers (..., 2, L): the lower byte, and the whole number in units of 256."""
    whole = np.empty((*pair.shape[:-1], 2, pair.shape[-1]), dtype=np.float32)
    whole[..., 0, :] = pair.astype(np.int8)
    np.multiply(pair, np.float32(1.0 / 256.0), out=whole[..., 1, :])
    return whole


def _compile() -> None:
    for count in (1,) if runtime.workers() == 1 else (1, _MIN_PARALLEL):
        codes, basis = np.zeros(StationCodes.shape_of(count), dtype=np.int16), np.ones((_ROWS, _LANES, 1), np.complex64)
        step, norm = np.ones((_ROWS, 2, _LANES), dtype=np.float32), np.ones(2 * _LANES + 1, dtype=np.float32)
        stations = StationCodes(codes, basis, step, norm, 2)
        query = stations.query(np.ones((1, 2)))
        _ = stations.best(query), stations.all_shifts(query, [0]), stations.at(query, [0], [0])


compiled_by("StationCodes", _compile)
