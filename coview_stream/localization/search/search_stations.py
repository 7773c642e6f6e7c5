"""Stations that a search compares its keyframes with: all of a map, those in a circle, or every third of many.

Two metres beside a station the surroundings look much as they do at it. Where a search would have very many stations,
it compares one of each square of six metres, by the first tier of its code alone; the places that keyframes agree on
are then put on the best of the square's stations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from coview_kernels import StationCodes
from coview_stream.basemap.station_index import StationIndex
from coview_stream.basemap.stations import LEVEL_GAP, StationGrid
from coview_stream.geometry.arrays import Floats32, Int32s, Ints
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.coview_vote import CoViewVote

# metres: its middle is within 4.3 m of all of it. Chosen among 4 and 6 on the towns of python -m bench city, tried on
# the campus of python -m bench scale
_SQUARE = 6.0
_ORDINARY = 65_536  # stations that are all compared: 6 ms for one core; set by hand


@dataclass(frozen=True)
class SearchStations:
    """Stations (K,) that keyframes are compared with.

    Attributes:
        index: of them.
        grid: of them; its blocks are squares where each stands for one.
        numbers: (K,) of them among the map's; None if they are all of the map.
        squares: what each stands for; None if for itself.
    """

    index: StationIndex
    grid: StationGrid
    numbers: Ints | None = None
    squares: _Squares | None = None

    @classmethod
    def of(cls, index: StationIndex, grid: StationGrid, chosen: Ints | None = None) -> SearchStations:
        """Choose among the stations of a map, or those of them that are named (C,)."""
        stride, count = int(_SQUARE / grid.block), len(grid) if chosen is None else len(chosen)
        if count > _ORDINARY and stride > 1:
            members = _members(grid, np.arange(count) if chosen is None else chosen, stride)
            middle = members[:, 0].astype(np.int64)
            coarse = StationGrid(grid.stations[middle], stride * grid.block)
            return cls(
                index.subset(middle, second=False), coarse, middle, _Squares(members, index.codes, grid.stations)
            )
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
        return [replace(each, station=int(numbers[each.station])) for each in places if each.station is not None]


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
        """Return places that stand for squares with the newest keyframe on the best station of each, best first."""
        if not places:
            return []
        square = np.array([each.station for each in places], dtype=np.int64)
        shift = np.array([each.shift for each in places], dtype=np.int64)
        members = self.members[square]
        scores = vote.screened(
            self.codes, members.ravel().astype(np.int64), np.repeat(shift, members.shape[1])
        ).reshape(members.shape)
        scores[members < 0] = np.inf
        best = scores.argmin(axis=1)[:, None]
        station = np.take_along_axis(members, best, axis=1)[:, 0]
        # the newest keyframe's share of the sum becomes that of the station
        gained = np.take_along_axis(scores, best, axis=1)[:, 0] - vote.at(square, shift)
        total = np.array([each.score for each in places]) + gained / np.sqrt(keyframes)
        T = np.array([each.T_map_odom for each in places])
        T[:, :3, 3] = self.stations[station] - T[:, :3, :3] @ vote.centre
        order = np.argsort(total, kind="stable")
        numbers = (values[order].tolist() for values in (station, shift, total))
        return [Hypothesis(*each) for each in zip(T[order], *numbers, strict=True)]


def _members(grid: StationGrid, stations: Ints, stride: int) -> Int32s:
    """Return the stations (K, n) of each square of ``stride`` blocks and storey, a middle one first; -1 for none."""
    cells = grid.cells_of(stations)
    squares = cells // stride
    beside = np.abs(cells - squares * stride - stride // 2).max(axis=1).astype(np.int8)
    squares -= squares.min(axis=0)
    key = squares[:, 0] * (int(squares[:, 1].max()) + 1) + squares[:, 1]
    del cells, squares  # of a million stations they are 16 MB each
    height = grid.stations[stations, 2]
    order = np.lexsort((height, key))
    # a storey ends where nothing stands for a while; by heights, as cells may lack the one below
    change = (np.diff(key[order]) != 0) | (np.diff(height[order]) >= LEVEL_GAP)
    key[order] = np.cumsum(np.append(0, change))
    order = np.lexsort((beside, key))
    begins = np.flatnonzero(np.append(True, np.diff(key[order]) != 0))
    square = np.repeat(np.arange(len(begins), dtype=np.int32), np.diff(np.append(begins, len(order))))
    place = np.arange(len(order)) - begins[square]
    members = np.full((len(begins), int(place.max()) + 1), -1, dtype=np.int32)
    members[square, place] = stations[order]
    return members
