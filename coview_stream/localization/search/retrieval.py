"""Retrieval: the distance of a virtual local scan to every station at every shift (eqs 5-9)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_stream.config import Channel, DescriptorConfig, RetrievalConfig
from coview_stream.descriptors.coview import Descriptor, ring_key
from coview_stream.geometry.arrays import Complexes, Floats32

ScoreVolume = Floats32
"""(M, S): one number for each station and shift."""

_CACHE_BYTES = 400_000_000  # spectra of all stations are kept if they fit, else made anew block by block; set by hand
_BLOCK = 8192  # stations whose spectra are made at a time; set by hand


class Stations(Protocol):
    """The part of a base map that retrieval uses: its stations' descriptors."""

    @property
    def descriptor_config(self) -> DescriptorConfig:
        """Return how the descriptors were made."""
        ...

    def __len__(self) -> int:
        """Return the number of stations M."""
        ...

    def descriptors(self, name: Channel) -> npt.NDArray[np.float16]:
        """Return (M, R, S) of one channel."""
        ...


class Retrieval:
    """Distances of a query to all stations of a map: exact (mode ``exhaustive``), or by the paper's ``ring_key``."""

    def __init__(self, stations: Stations, config: RetrievalConfig) -> None:
        self.stations = stations
        self.config = config
        self._spectra: dict[Channel, Complexes] = {}
        self._keys: dict[Channel, Floats32] = {}
        self._indices: dict[Channel, kernels.MatchIndex] = {}

    def distances(self, query: dict[Channel, Descriptor]) -> dict[Channel, ScoreVolume]:
        """Return the distances (M, S) in [0, 2] of each channel (eqs 7-9); shift n means yaw -2 pi n / S.

        In ``ring_key`` mode stations that are not among the candidates have distance 1 at every shift.
        """
        return {name: self._channel(name, descriptor) for name, descriptor in query.items()}

    def best(self, query: dict[Channel, Descriptor], k: int) -> dict[Channel, kernels.Nearest]:
        """Return the ``k`` nearest stations of each channel (eqs 7-9), each at its best shift, nearest first.

        The same stations as :meth:`distances` would give, at a fraction of its time and memory: bounds rule most of
        the stations out. An index of 1.3 kB per station is made at the first query.
        """
        return {name: self._nearest(name, descriptor, k) for name, descriptor in query.items()}

    def prepare(self) -> None:
        """Make the spectra that are kept, or the first query makes them."""
        if self.config.mode == "exhaustive" and self._cached():
            for name in self.stations.descriptor_config.channels:
                next(self._blocks(name))

    def _cached(self) -> bool:
        """Tell whether the spectra of all stations fit in memory."""
        config = self.stations.descriptor_config
        size = len(self.stations) * (config.sectors // 2 + 1) * config.rings * 8 * len(config.channels)
        return size <= _CACHE_BYTES

    def _channel(self, name: Channel, query: Descriptor) -> ScoreVolume:
        if self.config.mode == "ring_key":
            return self._by_ring_key(name, query)
        sectors = query.shape[-1]
        parts = [kernels.all_shift_distance(query, spectra, sectors) for spectra in self._blocks(name)]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _nearest(self, name: Channel, query: Descriptor, k: int) -> kernels.Nearest:
        bounded = self.config.mode == "exhaustive" and query.shape[-1] <= kernels.MatchIndex.MAX_SECTORS
        if not bounded or kernels.backend() == "numpy":  # the compiled kernel only has the bounds
            volume = self._channel(name, query)
            nearest = volume.min(axis=1)
            station = np.argsort(nearest, kind="stable")[:k]
            return kernels.Nearest(station, volume[station].argmin(axis=1), nearest[station])
        if name not in self._indices:
            self._indices[name] = kernels.MatchIndex(self.stations.descriptors(name))
        return self._indices[name].top_k(query, k, spectra=self._spectra.get(name))

    def _blocks(self, name: Channel) -> Iterator[Complexes]:
        descriptors = self.stations.descriptors(name)
        if not self._cached():
            for start in range(0, len(descriptors), _BLOCK):
                yield kernels.column_spectra(descriptors[start : start + _BLOCK].astype(np.float32))
            return
        if name not in self._spectra:
            self._spectra[name] = kernels.column_spectra(descriptors.astype(np.float32))
        yield self._spectra[name]

    def _by_ring_key(self, name: Channel, query: Descriptor) -> ScoreVolume:
        if name not in self._keys:
            self._keys[name] = ring_key(self.stations.descriptors(name).astype(np.float32))
        gap = np.linalg.norm(self._keys[name] - ring_key(query), axis=1)
        nearest = np.argsort(gap, kind="stable")[: self.config.candidates]
        volume = np.ones((len(self.stations), query.shape[-1]), dtype=np.float32)
        spectra = kernels.column_spectra(self.stations.descriptors(name)[nearest].astype(np.float32))
        volume[nearest] = kernels.all_shift_distance(query, spectra, query.shape[-1])
        return volume
