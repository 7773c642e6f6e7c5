"""Retrieval: a virtual local scan compared with the virtual scans of a map's stations at every shift (eqs 5-9).

A search compares with all stations of a map, with those in a circle, or with every third of very many: two metres
beside a station the surroundings look much as they do at it. In the last case one station of each six-metre square is
compared, by the first tier of its code alone, and the places that keyframes agree on are then put on the best station
of their square.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_kernels import StationCodes
from coview_stream.basemap.station_index import StationIndex
from coview_stream.basemap.stations import LEVEL_GAP, StationGrid
from coview_stream.config import Channel, ConsensusConfig
from coview_stream.descriptors.coview import Descriptor
from coview_stream.geometry.arrays import Floats, Floats32, Int32s, Ints
from coview_stream.geometry.rasters import argsmallest
from coview_stream.geometry.transforms import Circle
from coview_stream.localization.search.consensus import Consensus, Hypothesis, Request

# a vote's candidates
_MIN_STATIONS = 2048  # best stations whose shifts are looked at one by one
_SHARE = 32  # on large maps it is one in so many
_PER_STATION = 0.5  # candidates for each of them

# the compared stations
_SQUARE = 6.0  # metres: its middle is within 4.3 m of all of it; chosen between 4 and 6 by bench city
_ORDINARY = 65_536  # stations that are all compared: 6 ms for one core

_BLOCK = 8192  # stations whose exact spectra are made at a time


class CoViewVote:
    """Vote of one keyframe by its co-view descriptors: the station index screens all stations for it.

    Attributes:
        centre: (3,) zero of the descriptors, z on the ground; odometry frame, metres.
    """

    def __init__(self, centre: Floats, index: StationIndex, query: Mapping[Channel, Floats32]) -> None:
        self.centre = centre
        self._index = index
        self._query = index.query(query)

    @property
    def sectors(self) -> int:
        """Number of shifts S."""
        return self._index.sectors

    def candidates(self) -> tuple[Ints, Ints]:
        """Return stations and shifts (K,): the best peaks over the heading at the best stations."""
        count = max(_MIN_STATIONS, len(self._index) // _SHARE)
        stations = argsmallest(self._index.best(self._query), count)
        scores = self._index.all_shifts(self._query, stations)
        # every station has a heading that is no worse than the best one of the last
        station, shift = np.divmod(np.flatnonzero(scores <= scores[-1].min()), self.sectors)
        here = scores[station, shift]
        previous, following = scores[station, shift - 1], scores[station, (shift + 1) % self.sectors]
        peaks = np.flatnonzero((here < previous) & (here <= following))
        chosen = peaks[argsmallest(here[peaks], int(count * _PER_STATION))]
        return stations[station[chosen]], shift[chosen]

    def at(self, stations: Ints, shifts: Ints) -> Floats32:
        """Return z-scores (K,) of stations at shifts, negative is better; 0 for station -1."""
        return self._index.at(self._query, stations, shifts)

    def screened(self, codes: StationCodes, stations: Ints, shifts: Ints) -> Floats32:
        """Return z-scores (K,) of stations at shifts by the first tier of all stations' codes."""
        return np.float32(self._query.screen_zero) - codes.at(self._query.coded, stations, shifts)

    def at_all(self, requests: Sequence[Request[CoViewVote]]) -> list[Floats32]:
        """Return :meth:`at` of each."""
        return self._index.at_all([(vote._query, stations, shifts) for vote, stations, shifts in requests])


@dataclass(frozen=True)
class SearchStations:
    """Stations (K,) that keyframes are compared with.

    Attributes:
        index: of them.
        grid: of them; its blocks are squares where each stands for one.
        numbers: (K,) of them among the map's; None if they are all of the map.
        squares: the stations that each represents; None for itself alone.
    """

    index: StationIndex
    grid: StationGrid
    numbers: Ints | None = None
    squares: _Squares | None = None

    @classmethod
    def of(cls, index: StationIndex, grid: StationGrid, chosen: Ints | None = None) -> SearchStations:
        """Choose among the stations of a map, or among those numbered ``chosen`` (C,)."""
        stride, count = int(_SQUARE / grid.block), len(grid) if chosen is None else len(chosen)
        if count > _ORDINARY and stride > 1:
            members = _members(grid, np.arange(count) if chosen is None else chosen, stride)
            middle = members[:, 0].astype(np.int64)
            coarse = StationGrid(grid.stations[middle], stride * grid.block)
            squares = _Squares(members, index.codes, grid.stations)
            return cls(index.subset(middle, second=False), coarse, middle, squares)
        if chosen is None:
            return cls(index, grid)
        return cls(index.subset(chosen), StationGrid(grid.stations[chosen], grid.block), chosen)

    def __len__(self) -> int:
        """Return the number of stations K."""
        return len(self.grid)

    def on_the_map(self, places: Sequence[Hypothesis], vote: CoViewVote, keyframes: int) -> list[Hypothesis]:
        """Return places with the map's numbers of their stations, each on the best one of its square.

        Args:
            places: as :meth:`Consensus.hypotheses` returns them.
            vote: of the newest keyframe, by which the stations of a square are compared.
            keyframes: how many have voted.
        """
        if self.squares is not None:
            return self.squares.refined(places, vote, keyframes)
        if self.numbers is None:
            return list(places)
        numbers = self.numbers
        return [replace(place, station=int(numbers[place.station])) for place in places if place.station is not None]


@dataclass(frozen=True)
class _Squares:
    """Squares of stations.

    Attributes:
        members: (K, n) numbers of each one's stations, -1 for none.
        codes: of all stations of the map.
        stations: (M, 3) of the map.
    """

    members: Int32s
    codes: StationCodes
    stations: Floats32

    def refined(self, places: Sequence[Hypothesis], vote: CoViewVote, keyframes: int) -> list[Hypothesis]:
        """Return the places with the newest keyframe on the best station of each square, best first."""
        if not places:
            return []
        square = np.array([place.station for place in places], dtype=np.int64)
        shift = np.array([place.shift for place in places], dtype=np.int64)
        members = self.members[square]
        scores = vote.screened(
            self.codes, members.ravel().astype(np.int64), np.repeat(shift, members.shape[1])
        ).reshape(members.shape)
        scores[members < 0] = np.inf
        best = scores.argmin(axis=1)[:, None]
        station = np.take_along_axis(members, best, axis=1)[:, 0]
        # the newest keyframe's share of the sum becomes that of the station
        gained = np.take_along_axis(scores, best, axis=1)[:, 0] - vote.at(square, shift)
        votes = np.array([place.votes for place in places]) + gained / np.sqrt(keyframes)
        T = np.array([place.T_map_odom for place in places])
        T[:, :3, 3] = self.stations[station] - T[:, :3, :3] @ vote.centre
        order = np.argsort(votes, kind="stable")
        numbers = (values[order].tolist() for values in (station, shift, votes))
        return [Hypothesis(*row) for row in zip(T[order], *numbers, strict=True)]


def _members(grid: StationGrid, stations: Ints, stride: int) -> Int32s:
    """Return the stations (K, n) of each square of ``stride`` blocks and storey, a middle one first; -1 for none."""
    cells = grid.cells_of(stations)
    squares = cells // stride
    off_centre = np.abs(cells - squares * stride - stride // 2).max(axis=1).astype(np.int8)
    squares -= squares.min(axis=0)
    key = squares[:, 0] * (int(squares[:, 1].max()) + 1) + squares[:, 1]
    del cells, squares  # of a million stations they are 16 MB each
    height = grid.stations[stations, 2]
    order = np.lexsort((height, key))
    # a storey ends at a gap in the heights: single cells may lack the storey below
    change = (np.diff(key[order]) != 0) | (np.diff(height[order]) >= LEVEL_GAP)
    key[order] = np.cumsum(np.append(0, change))
    order = np.lexsort((off_centre, key))
    begins = np.flatnonzero(np.append(True, np.diff(key[order]) != 0))
    square = np.repeat(np.arange(len(begins), dtype=np.int32), np.diff(np.append(begins, len(order))))
    place = np.arange(len(order)) - begins[square]
    members = np.full((len(begins), int(place.max()) + 1), -1, dtype=np.int32)
    members[square, place] = stations[order]
    return members


class Stations(Protocol):
    """The part of a base map that retrieval uses."""

    @property
    def station_index(self) -> StationIndex:
        """Return the index of the stations' descriptors."""
        ...

    @property
    def station_grid(self) -> StationGrid:
        """Return the look-up of the stations by position."""
        ...


class Retrieval:
    """The stations of a map that votes are compared with, shared by all searches of the map."""

    def __init__(self, stations: Stations) -> None:
        self.stations = stations

    def prepare(self) -> None:
        """Do the work that the first vote would wait for."""
        self._whole.index.prepare()

    def compared(self, area: Circle | None = None) -> SearchStations:
        """Return the stations that votes compare: of the map, or within a circle, metres from the map's zero.

        Raises:
            ValueError: a circle without any station.
        """
        if area is None:
            return self._whole
        grid = self.stations.station_grid
        chosen = np.flatnonzero(area.holds(grid.stations))
        if not len(chosen):
            raise ValueError("no station in the circle")
        return SearchStations.of(self.stations.station_index, grid, chosen)

    @cached_property
    def _whole(self) -> SearchStations:
        return SearchStations.of(self.stations.station_index, self.stations.station_grid)


class StationConsensus:
    """Consensus of keyframes by their co-view descriptors on the stations of a map, or of a circle on it."""

    def __init__(self, retrieval: Retrieval, config: ConsensusConfig) -> None:
        """Begin without votes; the compared stations are chosen at the first one."""
        self.retrieval = retrieval
        self.config = config
        self._area: Circle | None = None
        self._compared: SearchStations | None = None
        self._consensus: Consensus | None = None
        self._newest: CoViewVote | None = None

    def __len__(self) -> int:
        """Return how many keyframes have voted."""
        return 0 if self._consensus is None else len(self._consensus)

    def clear(self) -> None:
        """Forget all votes, and the stations of a circle."""
        if self._area is not None:
            self._area = self._compared = self._consensus = None
        if self._consensus is not None:
            self._consensus.clear()

    def vote(self, centre: Floats, query: Mapping[Channel, Descriptor], area: Circle | None = None) -> None:
        """Add one keyframe's vote; another area than that of the votes so far starts again.

        Args:
            centre: (3,) zero of the descriptors, z on the ground; odometry frame, metres.
            query: descriptors (R, S) by channel.
            area: of the map, metres from its zero, outside of which no station is compared; None for none.
        """
        if self._compared is None or self._consensus is None or area != self._area:
            self._compared = self.retrieval.compared(area)
            self._consensus = Consensus(self._compared.grid, self.config)
            self._area = area
        self._newest = CoViewVote(centre, self._compared.index, query)
        self._consensus.vote(self._newest)

    def hypotheses(self) -> list[Hypothesis]:
        """Return the best spatially distinct hypotheses, best first; none before the first vote."""
        if self._consensus is None or self._compared is None or self._newest is None:
            return []
        return self._compared.on_the_map(self._consensus.hypotheses(), self._newest, len(self))


def exact_distances(descriptors: npt.NDArray[np.float16], query: Descriptor) -> Floats32:
    """Return the distances (M, S) in [0, 2] of descriptors (M, R, S) to a query (R, S) at every shift (eqs 7-9).

    Shift n means yaw -2 pi n / S. Takes seconds and gigabytes on large maps: for comparison with the index.
    """
    volume = np.empty((len(descriptors), query.shape[-1]), dtype=np.float32)
    for start in range(0, len(descriptors), _BLOCK):
        part = slice(start, start + _BLOCK)
        spectra = kernels.column_spectra(descriptors[part].astype(np.float32))
        volume[part] = kernels.all_shift_distance(query, spectra, query.shape[-1])
    return volume
