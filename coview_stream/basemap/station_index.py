"""Station index: codes of all stations' descriptors in two tiers of 512 bytes each, and the z-scores of queries.

The first tier, with the largest components, screens all stations; single scores add the second. A map's file holds the
index, which replaces the descriptors in a search and takes a fifth of their memory.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_kernels import CodedQuery, StationCodes
from coview_stream.config import Channel
from coview_stream.errors import MapError
from coview_stream.geometry.arrays import Complexes, Floats32, Ints

Descriptors = Mapping[Channel, npt.NDArray[Any]]
"""(M, R, S) of each channel."""

_SAMPLE = 128  # at most so many stations, whose scores at all shifts give median and spread
CODES = ("station_codes", "station_codes.rest")  # names of the tiers' codes in a map's file
_SAMPLED = "station_codes.sample"


@dataclass(frozen=True)
class ScoredQuery:
    """Query prepared by :meth:`StationIndex.query`.

    Attributes:
        coded, rest: codes in each tier, channels weighted by the inverse of their spread; no ``rest`` without a second
            tier.
        screen_zero: z-score of zero correlation in the first tier alone.
        zero: the same in both tiers.
    """

    coded: CodedQuery
    rest: CodedQuery | None
    screen_zero: float
    zero: float


class StationIndex:
    """Codes of the stations' descriptors (:class:`coview_kernels.StationCodes`), and a sample of the descriptors.

    A z-score is the distance (eqs 7-9) minus the median, in robust standard deviations, averaged over the channels;
    negative is better. The sample at all shifts gives median and deviation.
    """

    def __init__(self, codes: StationCodes, rest: StationCodes | None, sample: Descriptors) -> None:
        # ``rest``: optional second tier; ``sample``: descriptors of the sampled_stations()
        self.codes = codes
        self.rest = rest
        self._descriptors = sample

    @classmethod
    def of(cls, descriptors: Descriptors) -> StationIndex:
        """Build the index from the stations' descriptors; MapError if there are too many stations."""
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
        """Return the index in a map's arrays, None if it has none for these channels."""
        if any(name not in arrays for tier in CODES for name in _names(tier)) or _SAMPLED not in arrays:
            return None
        sample, stations = arrays[_SAMPLED], len(arrays[CODES[0]])
        if sample.ndim != 4 or sample.shape[:2] != (len(channels), len(sampled_stations(stations))):
            return None
        count, _, rings, sectors = sample.shape
        # kernels rely on these shapes
        shapes = (stations, 16, 16), (16, 16, rings * count, 2), (16, 2, 16), (33,)
        tiers = []
        for tier in CODES:
            codes, basis, step, norm = (arrays[name] for name in _names(tier))
            if codes.dtype != np.int16 or (codes.shape, basis.shape, step.shape, norm.shape) != shapes:
                return None
            vectors = (basis[..., 0] + 1j * basis[..., 1]).astype(np.complex64)
            tiers.append(StationCodes(codes, vectors, np.array(step), np.array(norm), sectors))
        return cls(tiers[0], tiers[1], dict(zip(channels, np.array(sample), strict=True)))

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays for a map's file."""
        arrays = {_SAMPLED: np.stack(list(self._descriptors.values()))}
        for tier, codes in zip(CODES, self.tiers, strict=True):
            basis = np.stack([codes.basis.real, codes.basis.imag], axis=-1)
            arrays |= dict(zip(_names(tier), (codes.codes, basis, codes.step, codes.norm), strict=True))
        return arrays

    def subset(self, stations: Ints, second: bool = True) -> StationIndex:
        """Return the index of stations (K,), copied into memory, with or without the second tier.

        Medians and deviations of its queries are those of the whole index.
        """
        rest = self.tiers[1].subset(stations) if second else None
        index = StationIndex(self.codes.subset(stations), rest, self._descriptors)
        index._sample = self._sample
        return index

    @property
    def tiers(self) -> tuple[StationCodes, StationCodes]:
        """Both tiers; ValueError if there is no second."""
        if self.rest is None:
            raise ValueError("an index without its second tier")
        return self.codes, self.rest

    def __len__(self) -> int:
        """Return the number of stations M."""
        return len(self.codes)

    @property
    def sectors(self) -> int:
        """Number of shifts S."""
        return self.codes.sectors

    @cached_property
    def _sample(self) -> tuple[StationCodes, StationCodes, dict[Channel, Complexes]]:
        """Sample that standardises queries: codes by tier, and spectra of the descriptors by channel."""
        codes, rest = (tier.subset(sampled_stations(len(self))) for tier in self.tiers)
        spectra = {name: kernels.column_spectra(d.astype(np.float32)) for name, d in self._descriptors.items()}
        return codes, rest, spectra

    def prepare(self) -> None:
        """Do the one-time work of the first query, and compile its kernels."""
        if len(self):
            query = self.query({name: values[0].astype(np.float32) for name, values in self._descriptors.items()})
            _ = self.best(query), self.at(query, [0], [0])

    def query(self, descriptors: Mapping[Channel, Floats32]) -> ScoredQuery:
        """Prepare a query from its descriptors (R, S) by channel, in the index's channels."""
        sample, sample_rest, all_spectra = self._sample
        stations = np.arange(len(sample))
        mean = np.zeros((len(stations), self.sectors), dtype=np.float32)
        columns = []
        for name, spectra in all_spectra.items():
            distance = kernels.all_shift_distance(descriptors[name], spectra, self.sectors)
            median = np.median(distance)
            weight = np.float32(1.0 / (len(all_spectra) * (1.4826 * np.median(np.abs(distance - median)) + 1e-6)))
            mean += (distance - median) * weight
            columns.append(kernels.unit_columns(descriptors[name]) * weight)
        stacked = np.concatenate(columns)
        coded = self.codes.query(stacked)
        # codes drop components of every query; correct the mean
        mean += sample.all_shifts(coded, stations)
        screen_zero = float(np.median(mean))
        if self.rest is None:
            return ScoredQuery(coded, None, screen_zero, screen_zero)
        rest = self.rest.query(stacked)
        mean += sample_rest.all_shifts(rest, stations)
        return ScoredQuery(coded, rest, screen_zero, float(np.median(mean)))

    def best(self, query: ScoredQuery) -> Floats32:
        """Return each station's best z-score (M,) over all shifts, by the first tier."""
        return np.float32(query.screen_zero) - self.codes.best(query.coded)

    def all_shifts(self, query: ScoredQuery, stations: Ints) -> Floats32:
        """Return z-scores (K, S) of stations (K,) at all shifts, by the first tier."""
        return np.float32(query.screen_zero) - self.codes.all_shifts(query.coded, stations)

    def at(self, query: ScoredQuery, stations: npt.ArrayLike, shifts: npt.ArrayLike) -> Floats32:
        """Return z-scores (K,) of stations (K,) at shifts (K,), by both tiers; 0 for station -1."""
        return self.at_all([(query, stations, shifts)])[0]

    def at_all(self, requests: Sequence[tuple[ScoredQuery, npt.ArrayLike, npt.ArrayLike]]) -> list[Floats32]:
        """Return the result of :meth:`at` for each request."""
        out = self.codes.at_all([(query.coded, stations, shifts) for query, stations, shifts in requests])
        out = [np.float32(query.zero) - one for (query, *_), one in zip(requests, out, strict=True)]
        if self.rest is not None:
            wanted = [(query.rest, stations, shifts) for query, stations, shifts in requests if query.rest is not None]
            for scores, other in zip(out, self.rest.at_all(wanted), strict=True):
                scores -= other
        for scores, (_, stations, _) in zip(out, requests, strict=True):
            scores[np.asarray(stations) < 0] = 0.0
        return out


def sampled_stations(stations: int) -> Ints:
    """Return the numbers (K,), evenly spaced, of the stations whose descriptors an index stores exactly."""
    return np.arange(0, stations, max(1, -(-stations // _SAMPLE)))


def _names(tier: str) -> tuple[str, str, str, str]:
    return tier, f"{tier}.basis", f"{tier}.step", f"{tier}.norm"
