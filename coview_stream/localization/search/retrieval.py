"""Retrieval: a virtual local scan compared with the virtual scans of all stations at every shift (eqs 5-9)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_stream.basemap.station_index import StationIndex
from coview_stream.basemap.stations import StationGrid
from coview_stream.config import Channel, DescriptorConfig, RetrievalConfig
from coview_stream.descriptors.coview import Descriptor, ring_key
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.geometry.transforms import Circle
from coview_stream.localization.search.coview_vote import CoViewVote
from coview_stream.localization.search.search_stations import SearchStations
from coview_stream.localization.search.votes import ScoreVolume, TableVote, Vote

_BLOCK = 8192  # stations whose spectra are made at a time; set by hand


class Stations(Protocol):
    """The part of a base map that retrieval uses: its stations' places, descriptors and index."""

    @property
    def descriptor_config(self) -> DescriptorConfig:
        """Return how the descriptors were made."""
        ...

    @property
    def station_index(self) -> StationIndex:
        """Return the index of the descriptors."""
        ...

    @property
    def station_grid(self) -> StationGrid:
        """Return the look-up of the stations by position."""
        ...

    def __len__(self) -> int:
        """Return the number of stations M."""
        ...

    def descriptors(self, name: Channel) -> npt.NDArray[np.float16]:
        """Return (M, R, S) of one channel."""
        ...


class Retrieval:
    """Comparison of queries with a map's stations: votes, by the station index; distances, by the descriptors.

    Mode ``exhaustive`` compares with all stations, the paper's ``ring_key`` with those of similar ring keys.
    """

    def __init__(self, stations: Stations, config: RetrievalConfig) -> None:
        self.stations = stations
        self.config = config

    def prepare(self) -> None:
        """Make what the first vote would."""
        if self.config.mode == "exhaustive":
            self._whole.index.prepare()

    def compared(self, area: Circle | None = None) -> SearchStations:
        """Return the stations that votes compare: of the map, or within a circle, metres from the map's zero.

        Raises:
            ValueError: a circle without any, or in ``ring_key`` mode.
        """
        if area is None:
            return self._whole
        if self.config.mode != "exhaustive":
            raise ValueError("circles are compared in exhaustive mode only")
        grid = self.stations.station_grid
        chosen = np.flatnonzero(area.holds(grid.stations))
        if not len(chosen):
            raise ValueError("no station in the circle")
        return SearchStations.of(self.stations.station_index, grid, chosen)

    @cached_property
    def _whole(self) -> SearchStations:
        index, grid = self.stations.station_index, self.stations.station_grid
        return SearchStations.of(index, grid) if self.config.mode == "exhaustive" else SearchStations(index, grid)

    def vote(self, centre: Floats, query: Mapping[Channel, Descriptor], compared: SearchStations | None = None) -> Vote:
        """Return a keyframe's vote.

        Args:
            centre: (3,) zero of its descriptors, odometry frame.
            query: descriptors (R, S) by channel.
            compared: as :meth:`compared` returns them; None for those of the map.
        """
        if self.config.mode == "exhaustive":
            return CoViewVote(centre, (self._whole if compared is None else compared).index, query)
        return TableVote.of_distances(centre, self.distances(query).values())

    def distances(self, query: Mapping[Channel, Descriptor]) -> dict[Channel, ScoreVolume]:
        """Return the exact distances (M, S) in [0, 2] of each channel (eqs 7-9); shift n means yaw -2 pi n / S.

        They take seconds and gigabytes on large maps: for comparison. In ``ring_key`` mode stations that are not among
        the candidates have distance 1 at every shift.
        """
        exact = self._exhaustive if self.config.mode == "exhaustive" else self._by_ring_key
        return {name: exact(name, descriptor) for name, descriptor in query.items()}

    def _exhaustive(self, name: Channel, query: Descriptor) -> ScoreVolume:
        descriptors = self.stations.descriptors(name)
        volume = np.empty((len(descriptors), query.shape[-1]), dtype=np.float32)
        for start in range(0, len(descriptors), _BLOCK):
            part = slice(start, start + _BLOCK)
            volume[part] = _distance(query, descriptors[part])
        return volume

    def _by_ring_key(self, name: Channel, query: Descriptor) -> ScoreVolume:
        gap = np.linalg.norm(self._keys[name] - ring_key(query), axis=1)
        nearest = np.argsort(gap, kind="stable")[: self.config.candidates]
        volume = np.ones((len(self.stations), query.shape[-1]), dtype=np.float32)
        volume[nearest] = _distance(query, self.stations.descriptors(name)[nearest])
        return volume

    @cached_property
    def _keys(self) -> dict[Channel, Floats32]:
        """(M, R) ring keys by channel."""
        channels = self.stations.descriptor_config.channels
        return {name: ring_key(self.stations.descriptors(name).astype(np.float32)) for name in channels}


def _distance(query: Descriptor, descriptors: npt.NDArray[np.float16]) -> ScoreVolume:
    spectra = kernels.column_spectra(descriptors.astype(np.float32))
    return kernels.all_shift_distance(query, spectra, query.shape[-1])
