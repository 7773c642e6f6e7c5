"""Station index: the descriptors of all stations in two tiers of 512 bytes each, and z-scores of a query by them.

The first tier, of what varies most, screens all stations; the second is added where single scores are asked for.

It is made when a map is built, and kept in its file; a map without it makes it when it is first searched. Neither the
query nor the memory of a search then needs the descriptors, which take five times as much.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_kernels import CodedQuery, StationCodes
from coview_kernels.station_codes import COARSE_ROWS
from coview_stream.basemap.stored_rows import stored_rows
from coview_stream.config import Channel
from coview_stream.errors import MapError
from coview_stream.geometry.arrays import Complexes, Floats32, Ints
from coview_stream.geometry.selection import argsmallest

Descriptors = Mapping[Channel, npt.NDArray[Any]]
"""(M, R, S) of each channel."""

_SAMPLE = 128  # stations at all whose shifts medians are taken; set by hand
_TIERS, _SAMPLED = ("station_codes", "station_codes.rest"), "station_codes.sample"
_COARSE, _COARSE_NORM = "station_codes.coarse", "station_codes.coarse.norm"
_COARSE_FROM = 50_000
"""Stations from which coarse codes are made, and all stations screened by them first; set by hand: 25 MB."""
_WIDER = 2  # times as many stations as are asked for are taken from the coarse screening; `bench scale` tells the loss
_PART = 8192  # stations that are screened at a time, of those that the coarse codes leave: 4 MB


@dataclass(frozen=True)
class ScoredQuery:
    """A query of :class:`StationIndex`.

    Attributes:
        coded: the query, its channels weighted by how far they spread.
        rest: the same, for the second tier.
        coarse: the same, for coarse codes; None where there are none.
        screen_zero: z-score of no correlation at all by the first tier alone.
        zero: that by both.
    """

    coded: CodedQuery
    rest: CodedQuery
    coarse: CodedQuery | None
    screen_zero: float
    zero: float


class StationIndex:
    """The stations' descriptors as :class:`coview_kernels.StationCodes`, and a sample of them as they are.

    A z-score says by how many robust standard deviations (of all stations and shifts, from the sample) a distance
    (eqs 7-9) exceeds the median; negative is better. It is the mean of the channels'.
    """

    def __init__(
        self, codes: StationCodes, rest: StationCodes, sample: Descriptors, coarse: StationCodes | None = None
    ) -> None:
        self.codes = codes
        self.rest = rest
        if coarse is None and len(codes) >= _COARSE_FROM:
            coarse = codes.coarse()
        self.coarse = coarse
        self._readers: dict[int, _SomeCodes] = {}
        self._descriptors = sample

    @classmethod
    def of(cls, descriptors: Descriptors) -> StationIndex:
        """Make the index of stations by their descriptors.

        Raises:
            MapError: they are too many.
        """
        stations = len(next(iter(descriptors.values())))
        if stations > StationCodes.MAX_STATIONS:
            limit = StationCodes.MAX_STATIONS
            raise MapError(f"{stations} stations, {limit} at most: build the map in parts, or with a larger block size")
        chosen = sampled_stations(stations)
        sample = {name: np.array(values[chosen]) for name, values in descriptors.items()}
        codes, rest = StationCodes.tiers(list(descriptors.values()), 2)
        return cls(codes, rest, sample)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]], channels: Collection[Channel]) -> StationIndex | None:
        """Return the index of these channels that a map's file holds, None if it holds none that can be used."""
        if any(name not in arrays for tier in _TIERS for name in _names(tier)) or _SAMPLED not in arrays:
            return None
        sample, stations = arrays[_SAMPLED], len(arrays[_TIERS[0]])
        if sample.ndim != 4 or sample.shape[:2] != (len(channels), len(sampled_stations(stations))):
            return None
        count, _, rings, sectors = sample.shape
        # kernels look up what the shapes promise
        shapes = (stations, 16, 16), (16, 16, rings * count, 2), (16, 2, 16), (33,)
        tiers = []
        for tier in _TIERS:
            codes, basis, step, norm = (arrays[name] for name in _names(tier))
            if codes.dtype != np.int16 or (codes.shape, basis.shape, step.shape, norm.shape) != shapes:
                return None
            vectors = (basis[..., 0] + 1j * basis[..., 1]).astype(np.complex64)
            tiers.append(StationCodes(codes, vectors, np.array(step), np.array(norm), sectors))
        coarse = None
        if _COARSE in arrays and _COARSE_NORM in arrays:
            codes, norm = arrays[_COARSE], arrays[_COARSE_NORM]
            if codes.dtype != np.int16 or codes.shape != (stations, COARSE_ROWS, 16) or norm.shape != (33,):
                return None
            coarse = tiers[0].coarse(codes, np.array(norm))
        return cls(tiers[0], tiers[1], dict(zip(channels, np.array(sample), strict=True)), coarse)

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return what a map's file holds of it."""
        found = {_SAMPLED: np.stack(list(self._descriptors.values()))}
        for tier, codes in zip(_TIERS, (self.codes, self.rest), strict=True):
            basis = np.stack([codes.basis.real, codes.basis.imag], axis=-1)
            found |= dict(zip(_names(tier), (codes.codes, basis, codes.step, codes.norm), strict=True))
        if self.coarse is not None:
            found |= {_COARSE: self.coarse.codes, _COARSE_NORM: self.coarse.norm}
        return found

    def __len__(self) -> int:
        """Return the number of stations M."""
        return len(self.codes)

    @property
    def sectors(self) -> int:
        """Number of shifts S."""
        return self.codes.sectors

    @cached_property
    def _sample(self) -> tuple[Ints, dict[Channel, Complexes]]:
        """Every so many stations (K,), and the spectra of their descriptors by channel."""
        known = self._descriptors.items()
        return sampled_stations(len(self)), {
            name: kernels.column_spectra(each.astype(np.float32)) for name, each in known
        }

    def prepare(self) -> None:
        """Make what the first query would, and compile its kernels, of which the number of stations chooses."""
        if len(self):
            query = self.query({name: values[0].astype(np.float32) for name, values in self._descriptors.items()})
            _ = self.screen(query, 1), self.at(query, [0], [0])

    def query(self, descriptors: Mapping[Channel, Floats32]) -> ScoredQuery:
        """Prepare to score a query's descriptors (R, S) by channel, the index's own channels."""
        chosen, spectra = self._sample
        mean = np.zeros((len(chosen), self.sectors), dtype=np.float32)
        columns = []
        for name, sample in spectra.items():
            distance = kernels.all_shift_distance(descriptors[name], sample, self.sectors)
            median = np.median(distance)
            weight = np.float32(1.0 / (len(spectra) * (1.4826 * np.median(np.abs(distance - median)) + 1e-6)))
            mean += (distance - median) * weight
            columns.append(kernels.unit_columns(descriptors[name]) * weight)
        stacked = np.concatenate(columns)
        coded, rest = self.codes.query(stacked), self.rest.query(stacked)
        coarse = None if self.coarse is None else self.coarse.query(stacked)
        # the codes leave parts out that no query lacks: what that adds on the mean is made up for here
        mean += self.codes.all_shifts(coded, chosen)
        screen_zero = float(np.median(mean))
        mean += self.rest.all_shifts(rest, chosen)
        return ScoredQuery(coded, rest, coarse, screen_zero, float(np.median(mean)))

    def best(self, query: ScoredQuery) -> Floats32:
        """Return the best z-score (M,) of each station at any heading, by the first tier."""
        return np.float32(query.screen_zero) - self.codes.best(query.coded)

    def screen(self, query: ScoredQuery, count: int) -> tuple[Ints, Floats32]:
        """Return the ``count`` stations that are best at any heading, best first, and z-scores (K, S) at all shifts.

        By the first tier. On large maps coarse codes choose twice as many, of which the first tier chooses: of what is
        not coarse hardly anything is read.
        """
        if self.coarse is None or query.coarse is None or _WIDER * count >= len(self):
            stations = argsmallest(self.best(query), count)
            return stations, self.all_shifts(query, stations)
        likely = np.sort(argsmallest(-self.coarse.best(query.coarse), _WIDER * count))
        some = self._some(0)
        rows = some.rows(likely)
        best = np.concatenate([part.best(query.coded)[:length] for part, length in some.parts(rows)])
        chosen = argsmallest(-best, count)
        turned = [part.all_shifts(query.coded, np.arange(length)) for part, length in some.parts(rows[chosen])]
        return likely[chosen], np.float32(query.screen_zero) - np.concatenate(turned)

    def _some(self, tier: int) -> _SomeCodes:
        """Return what reads some stations of a tier."""
        if tier not in self._readers:
            self._readers[tier] = _SomeCodes(self.rest if tier else self.codes)
        return self._readers[tier]

    def all_shifts(self, query: ScoredQuery, stations: Ints) -> Floats32:
        """Return z-scores (K, S) of stations (K,) at all shifts, by the first tier."""
        return np.float32(query.screen_zero) - self.codes.all_shifts(query.coded, stations)

    def at(self, query: ScoredQuery, stations: npt.ArrayLike, shifts: npt.ArrayLike) -> Floats32:
        """Return z-scores (K,) of stations (K,) at shifts (K,), by both tiers; 0 for station -1."""
        index = np.asarray(stations)
        found = np.full(len(index), query.zero, dtype=np.float32)
        for tier, (codes, coded) in enumerate(((self.codes, query.coded), (self.rest, query.rest))):
            found -= (
                codes.at(coded, index, shifts) if self.coarse is None else self._some(tier).at(coded, index, shifts)
            )
        found[index < 0] = 0.0
        return found


class _SomeCodes:
    """Some stations of a large map's codes at a time, read from the file where it is one."""

    def __init__(self, codes: StationCodes) -> None:
        self._codes = codes
        self._stored = stored_rows(codes.codes)
        scratch = np.zeros((_PART, *codes.codes.shape[1:]), dtype=np.int16)
        self._part = StationCodes(scratch, codes.basis, codes.step, codes.norm, codes.sectors)

    def __getstate__(self) -> dict[str, Any]:
        """Return what may be sent to another process: all but the open file."""
        return self.__dict__ | {"_stored": None}

    def rows(self, stations: Ints) -> npt.NDArray[np.int16]:
        """Return the codes (K, 16, 16) of stations (K,), whose numbers increase."""
        if self._stored is None:
            return np.array(self._codes.codes[stations])
        return self._stored.take(stations)

    def parts(self, rows: npt.NDArray[np.int16]) -> Iterator[tuple[StationCodes, int]]:
        """Yield codes that begin with the next of the rows (K, 16, 16), and their number; valid until the next."""
        for start in range(0, len(rows), _PART):
            some = rows[start : start + _PART]
            self._part.codes[: len(some)] = some
            yield self._part, len(some)

    def at(self, query: CodedQuery, stations: npt.NDArray[Any], shifts: npt.ArrayLike) -> Floats32:
        """Return the correlations (K,) with stations (K,) at shifts (K,); 0 for station -1."""
        found = np.zeros(len(stations), dtype=np.float32)
        turned = np.broadcast_to(np.asarray(shifts), (len(stations),))
        known = np.flatnonzero(stations >= 0)
        each, number = np.unique(stations[known], return_inverse=True)
        done = 0
        for part, length in self.parts(self.rows(each)):
            own = (number >= done) & (number < done + length)
            found[known[own]] = part.at(query, number[own] - done, turned[known[own]])
            done += length
        return found


def sampled_stations(stations: int) -> Ints:
    """Choose the numbers (K,) of the stations that an index keeps as they are, as evenly as they come."""
    return np.arange(0, stations, max(1, -(-stations // _SAMPLE)))


def _names(tier: str) -> tuple[str, str, str, str]:
    """Return the names of a tier's arrays in a file."""
    return tier, f"{tier}.basis", f"{tier}.step", f"{tier}.norm"
