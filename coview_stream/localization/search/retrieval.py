"""Retrieval: a virtual local scan compared with the virtual scans of a map's stations at every shift (eqs 5-9).

A search compares all stations of a map or of a circle. Of very many stations only one per six-metre square is compared,
by the first tier of its code alone, as the surroundings look much the same two metres away. The places that keyframes
agree on are then moved to the best station of their square.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_kernels import CodedQuery, StationCodes
from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.station_index import StationIndex
from coview_stream.basemap.stations import LEVEL_GAP, StationGrid
from coview_stream.config import Channel, ConsensusConfig
from coview_stream.descriptors.coview import Descriptor
from coview_stream.geometry.arrays import Floats, Floats32, Int32s, Ints
from coview_stream.geometry.rasters import argsmallest
from coview_stream.geometry.transforms import Circle, Pose, transform
from coview_stream.localization.search.consensus import Consensus, Hypothesis, yaw_of_shift

_MIN_STATIONS, _SHARE = 2048, 32  # best stations whose shifts are compared: at least 2048, and one in 32
_PER_STATION = 0.5  # candidates per such station
_ALIKE = 16  # places that look most like the leader's surroundings: the map may hold rows of them
_SQUARE = 6.0  # metres, all within 4.3 m of the middle; chosen between 4 and 6 by bench city
_ORDINARY = 65_536  # largest number of stations that are all compared: 6 ms for one core
_BLOCK = 8192  # stations whose exact spectra are computed at a time


class CoViewVote:
    """Vote of one keyframe by its co-view descriptors.

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
        """Return stations and shifts (K,): the best peaks over heading at the best stations."""
        count = max(_MIN_STATIONS, len(self._index) // _SHARE)
        stations = argsmallest(self._index.best(self._query), count)
        scores = self._index.all_shifts(self._query, stations)
        # every station has a score at least as good as the last station's best
        station, shift = np.divmod(np.flatnonzero(scores <= scores[-1].min()), self.sectors)
        here = scores[station, shift]
        previous, following = scores[station, shift - 1], scores[station, (shift + 1) % self.sectors]
        peaks = np.flatnonzero((here < previous) & (here <= following))
        chosen = peaks[argsmallest(here[peaks], int(count * _PER_STATION))]
        return stations[station[chosen]], shift[chosen]

    def at(self, stations: Ints, shifts: Ints) -> Floats32:
        """Return z-scores (K,) of stations at shifts, lower is better; 0 for station -1."""
        return self._index.at(self._query, stations, shifts)

    def screened(self, codes: StationCodes, stations: Ints, shifts: Ints) -> Floats32:
        """Return z-scores (K,) of stations at shifts by the first tier of their codes."""
        return np.float32(self._query.screen_zero) - codes.at(self._query.coded, stations, shifts)

    def at_all(self, requests: Sequence[tuple[CoViewVote, Ints, Ints]]) -> list[Floats32]:
        """Return :meth:`at` of each request."""
        return self._index.at_all([(vote._query, stations, shifts) for vote, stations, shifts in requests])


@dataclass(frozen=True)
class SearchStations:
    """Stations (K,) that keyframes are compared with."""

    index: StationIndex  # of the descriptors
    grid: StationGrid  # look-up by position; its blocks are the squares, if any
    numbers: Ints | None = None  # (K,) of the stations in the map; None if they are all of the map's
    squares: _Squares | None = None  # of stations that share one compared station; None if every station is compared

    @classmethod
    def of(cls, index: StationIndex, grid: StationGrid, chosen: Ints | None = None) -> SearchStations:
        """Choose from the stations of a map, or from its stations ``chosen`` (C,)."""
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

    def alike(self, position: Floats, rule: ConsensusConfig) -> Floats:
        """Return transforms (K, 4, 4) that lead from a position (3,) of the map to places with similar surroundings.

        Codes are compared as vectors by their direction alone, not by their length: near the border half is missing.
        """
        codes, every = self.index.codes, self.grid.stations
        if self.squares is not None:
            codes, every = self.squares.codes, self.squares.stations
        own = int(np.square(every - position.astype(np.float32)).sum(axis=1).argmin())
        query, compared = codes.query_of(own), self.index.codes
        stations = argsmallest(-compared.best(query) / compared.lengths, _MIN_STATIONS)
        scores = compared.all_shifts(query, stations) / compared.lengths[stations, None]
        row, shift = np.divmod(argsmallest(-scores.ravel(), _MIN_STATIONS), self.index.sectors)
        found = stations[row]
        if self.squares is not None:  # the middle of a square may be metres off
            found, scores = self.squares.best(query, found, shift)
            order = np.argsort(-scores / compared.lengths[stations[row]], kind="stable")
            found, shift = found[order], shift[order]
        yaw = yaw_of_shift(shift, self.index.sectors)
        chosen = kernels.distinct_poses(every[found], yaw, 1 + _ALIKE, rule.distinct_distance, rule.distinct_yaw)
        at, yaw = every[found[chosen]].astype(np.float64), yaw[chosen]
        T = np.tile(np.eye(4), (len(chosen), 1, 1))
        T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = np.cos(yaw), -np.sin(yaw), np.sin(yaw), np.cos(yaw)
        T[:, :3, 3] = at - T[:, :3, :3] @ every[own].astype(np.float64)
        return T

    def on_the_map(self, places: Sequence[Hypothesis], vote: CoViewVote, keyframes: int) -> list[Hypothesis]:
        """Return places with their stations' numbers in the map, each on the best station of its square.

        ``places`` are those of :meth:`Consensus.hypotheses`, ``vote`` is the newest keyframe's, and ``keyframes`` the
        number that have voted.
        """
        if self.squares is not None:
            return self.squares.refined(places, vote, keyframes)
        if self.numbers is None:
            return list(places)
        numbers = self.numbers
        return [replace(place, station=int(numbers[place.station])) for place in places if place.station is not None]


@dataclass(frozen=True)
class _Squares:
    """Squares of stations."""

    members: Int32s  # (K, n) station numbers by square, -1 for none
    codes: StationCodes  # of all stations of the map
    stations: Floats32  # (M, 3) of the map

    def best(self, query: CodedQuery, squares: Ints, shifts: Ints) -> tuple[Ints, Floats32]:
        """Return the station (K,) of each square that is most like a query at a shift, and its correlation."""
        members = self.members[squares].astype(np.int64)
        scores = self.codes.at(query, members.ravel(), np.repeat(shifts, members.shape[1])).reshape(members.shape)
        scores[members < 0] = -np.inf
        best = scores.argmax(axis=1)[:, None]
        return np.take_along_axis(members, best, axis=1)[:, 0], np.take_along_axis(scores, best, axis=1)[:, 0]

    def refined(self, places: Sequence[Hypothesis], vote: CoViewVote, keyframes: int) -> list[Hypothesis]:
        """Return the places with the newest keyframe on the best station of each square, best first."""
        if not places:
            return []
        square = np.array([place.station for place in places], dtype=np.int64)
        shift = np.array([place.shift for place in places], dtype=np.int64)
        members = self.members[square]
        shifts = np.repeat(shift, members.shape[1])
        scores = vote.screened(self.codes, members.ravel().astype(np.int64), shifts).reshape(members.shape)
        scores[members < 0] = np.inf
        best = scores.argmin(axis=1)[:, None]
        station = np.take_along_axis(members, best, axis=1)[:, 0]
        # the best station's score replaces the square's in the sum
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
    del cells, squares  # 16 MB each for a million stations
    height = grid.stations[stations, 2]
    order = np.lexsort((height, key))
    # a storey ends at a gap in the heights, as single cells may lack the storey below
    change = (np.diff(key[order]) != 0) | (np.diff(height[order]) >= LEVEL_GAP)
    key[order] = np.cumsum(np.append(0, change))
    order = np.lexsort((off_centre, key))
    begins = np.flatnonzero(np.append(True, np.diff(key[order]) != 0))
    square = np.repeat(np.arange(len(begins), dtype=np.int32), np.diff(np.append(begins, len(order))))
    place = np.arange(len(order)) - begins[square]
    members = np.full((len(begins), int(place.max()) + 1), -1, dtype=np.int32)
    members[square, place] = stations[order]
    return members


class Retrieval:
    """The compared stations of a map, shared by all searches of the map."""

    def __init__(self, base_map: BaseMap) -> None:
        self.base_map = base_map

    def prepare(self) -> None:
        """Compute ahead of the first vote."""
        self._whole.index.prepare()

    def compared(self, area: Circle | None = None) -> SearchStations:
        """Return the compared stations, of the map or within a circle in metres from the map's zero.

        Raises:
            ValueError: a circle without any station.
        """
        if area is None:
            return self._whole
        grid = self.base_map.station_grid
        chosen = np.flatnonzero(area.holds(grid.stations))
        if not len(chosen):
            raise ValueError("no station in the circle")
        return SearchStations.of(self.base_map.station_index, grid, chosen)

    @cached_property
    def _whole(self) -> SearchStations:
        return SearchStations.of(self.base_map.station_index, self.base_map.station_grid)


class StationConsensus:
    """Consensus of keyframes by their co-view descriptors, on the stations of a map or of a circle on it."""

    def __init__(self, retrieval: Retrieval, config: ConsensusConfig) -> None:
        """Start without votes; the compared stations are chosen at the first vote."""
        self.retrieval = retrieval
        self.config = config
        self._area: Circle | None = None
        self._voted: tuple[SearchStations, Consensus, CoViewVote] | None = None  # and the newest vote

    def __len__(self) -> int:
        """Return the number of keyframes that have voted."""
        return 0 if self._voted is None else len(self._voted[1])

    def clear(self) -> None:
        """Forget all votes."""
        self._voted = None

    def vote(self, centre: Floats, query: Mapping[Channel, Descriptor], area: Circle | None = None) -> None:
        """Add one keyframe's vote by descriptors (R, S) of all channels; another ``area`` restarts the consensus.

        ``centre`` (3,) is the zero of the descriptors, z on the ground; odometry frame, metres. ``area`` is the circle
        of compared stations, metres from the map's zero; None for all.
        """
        if self._voted is None or area != self._area:
            self._area = area
            compared = self.retrieval.compared(area)
            consensus = Consensus(compared.grid, self.config)
        else:
            compared, consensus, _ = self._voted
        vote = CoViewVote(centre, compared.index, query)
        self._voted = compared, consensus, vote
        consensus.vote(vote)

    def alike(self, T_map_odom: Pose) -> Floats:
        """Return ``T_map_odom`` (K, 4, 4) of the places that look most like one on the map; none without votes."""
        if self._voted is None:
            return np.empty((0, 4, 4))
        compared, _, newest = self._voted
        return compared.alike(transform(T_map_odom, newest.centre[None])[0], self.config) @ T_map_odom

    def hypotheses(self) -> list[Hypothesis]:
        """Return the best spatially distinct hypotheses, best first; none before the first vote."""
        if self._voted is None:
            return []
        compared, consensus, newest = self._voted
        return compared.on_the_map(consensus.hypotheses(), newest, len(consensus))


def exact_distances(descriptors: npt.NDArray[np.float16], query: Descriptor) -> Floats32:
    """Return the distances (M, S) in [0, 2] of descriptors (M, R, S) to a query (R, S) at every shift (eqs 7-9).

    Shift n means yaw -2 pi n / S. Takes seconds and gigabytes on large maps; used to check the index.
    """
    volume = np.empty((len(descriptors), query.shape[-1]), dtype=np.float32)
    for start in range(0, len(descriptors), _BLOCK):
        part = slice(start, start + _BLOCK)
        spectra = kernels.column_spectra(descriptors[part].astype(np.float32))
        volume[part] = kernels.all_shift_distance(query, spectra, query.shape[-1])
    return volume
