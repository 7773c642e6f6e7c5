"""Station index: the descriptors of all stations in 512 bytes each, and z-scores of a query by them.

It is made when a map is built, and kept in its file; a map without it makes it when it is first searched. Neither the
query nor the memory of a search then needs the descriptors, which take ten times as much.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_kernels import CodedQuery, StationCodes
from coview_stream.config import Channel
from coview_stream.geometry.arrays import Complexes, Floats32, Ints

Descriptors = Mapping[Channel, npt.NDArray[Any]]
"""(M, R, S) of each channel."""

_SAMPLE = 128  # stations at all whose shifts medians are taken; set by hand
_PREFIX = "station_codes"


@dataclass(frozen=True)
class ScoredQuery:
    """A query of :class:`StationIndex`.

    Attributes:
        coded: the query, its channels weighted by how far they spread.
        zero: z-score of no correlation at all.
    """

    coded: CodedQuery
    zero: float


class StationIndex:
    """The stations' descriptors as :class:`coview_kernels.StationCodes`, and a sample of them as they are.

    A z-score says by how many robust standard deviations (of all stations and shifts, from the sample) a distance
    (eqs 7-9) exceeds the median; negative is better. It is the mean of the channels'.
    """

    def __init__(self, codes: StationCodes, sample: Descriptors) -> None:
        self.codes = codes
        self._descriptors = sample

    @classmethod
    def of(cls, descriptors: Descriptors) -> StationIndex:
        """Make the index of stations by their descriptors."""
        chosen = _chosen(len(next(iter(descriptors.values()))))
        sample = {name: np.array(values[chosen]) for name, values in descriptors.items()}
        return cls(StationCodes.of(list(descriptors.values())), sample)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]], channels: Collection[Channel]) -> StationIndex | None:
        """Return the index of these channels that a map's file holds, None if it holds none."""
        if any(name not in arrays for name in _NAMES):
            return None
        codes, basis, step, norm, sample = (arrays[name] for name in _NAMES)
        count, _, rings, sectors = sample.shape
        if count != len(channels) or basis.shape[2] != rings * count:
            return None
        vectors = (basis[..., 0] + 1j * basis[..., 1]).astype(np.complex64)
        by_channel = dict(zip(channels, np.array(sample), strict=True))
        return cls(StationCodes(codes, vectors, np.array(step), np.array(norm), sectors), by_channel)

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return what a map's file holds of it."""
        codes, sample = self.codes, np.stack(list(self._descriptors.values()))
        parts = np.stack([codes.basis.real, codes.basis.imag], axis=-1), codes.step, codes.norm, sample
        return dict(zip(_NAMES, (codes.codes, *parts), strict=True))

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
        return _chosen(len(self)), {name: kernels.column_spectra(each.astype(np.float32)) for name, each in known}

    def prepare(self) -> None:
        """Make what the first query would, and compile its kernels, of which the number of stations chooses."""
        if len(self):
            query = self.query({name: values[0].astype(np.float32) for name, values in self._descriptors.items()})
            _ = self.best(query), self.at(query, [0], [0])

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
        coded = self.codes.query(np.concatenate(columns))
        # the codes leave parts out that no query lacks: what that adds on the mean is made up for here
        zero = float(np.median(mean + self.codes.all_shifts(coded, chosen)))
        return ScoredQuery(coded, zero)

    def best(self, query: ScoredQuery) -> Floats32:
        """Return the best z-score (M,) of each station at any heading."""
        return np.float32(query.zero) - self.codes.best(query.coded)

    def all_shifts(self, query: ScoredQuery, stations: Ints) -> Floats32:
        """Return z-scores (K, S) of stations (K,) at all shifts."""
        return np.float32(query.zero) - self.codes.all_shifts(query.coded, stations)

    def at(self, query: ScoredQuery, stations: npt.ArrayLike, shifts: npt.ArrayLike) -> Floats32:
        """Return z-scores (K,) of stations (K,) at shifts (K,); 0 for station -1."""
        index = np.asarray(stations)
        found = np.float32(query.zero) - self.codes.at(query.coded, index, shifts)
        found[index < 0] = 0.0
        return found


_NAMES = (_PREFIX, f"{_PREFIX}.basis", f"{_PREFIX}.step", f"{_PREFIX}.norm", f"{_PREFIX}.sample")


def _chosen(stations: int) -> Ints:
    """Choose the stations (K,) of the sample, as evenly as they come."""
    return np.arange(0, stations, max(1, -(-stations // _SAMPLE)))
