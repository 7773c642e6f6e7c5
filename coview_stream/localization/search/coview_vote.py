"""Vote of one keyframe by its descriptors: the station index screens all stations for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from coview_kernels import StationCodes
from coview_stream.basemap.station_index import StationIndex
from coview_stream.config import Channel
from coview_stream.geometry.arrays import Floats, Floats32, Ints
from coview_stream.geometry.rasters import argsmallest
from coview_stream.localization.search.votes import Request

_MIN_STATIONS = 2048  # whose shifts are looked at one by one: the best; set by hand
_SHARE = 32  # on large maps it is one in so many; set by hand
_PER_STATION = 0.5  # candidates for each station looked at; set by hand


class CoViewVote:
    """Vote by co-view descriptors.

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
        """Return stations and shifts (K,): the best of the headings at which the best stations are most alike."""
        count = max(_MIN_STATIONS, len(self._index) // _SHARE)
        stations = argsmallest(self._index.best(self._query), count)
        scores = self._index.all_shifts(self._query, stations)
        # every one of them has a heading that is no worse than the last one's best
        station, shift = np.divmod(np.flatnonzero(scores <= scores[-1].min()), self.sectors)
        found = scores[station, shift]
        beside = scores[station, shift - 1], scores[station, (shift + 1) % self.sectors]
        peaks = np.flatnonzero((found < beside[0]) & (found <= beside[1]))
        chosen = peaks[argsmallest(found[peaks], int(count * _PER_STATION))]
        return stations[station[chosen]], shift[chosen]

    def at(self, stations: Ints, shifts: Ints) -> Floats32:
        """Return z-scores (K,) of stations at shifts, negative is better; 0 for station -1."""
        return self._index.at(self._query, stations, shifts)

    def screened(self, codes: StationCodes, stations: Ints, shifts: Ints) -> Floats32:
        """Return z-scores (K,) of stations at shifts by the first tier of the codes that the index is taken from."""
        return np.float32(self._query.screen_zero) - codes.at(self._query.coded, stations, shifts)

    def at_all(self, requests: Sequence[Request[CoViewVote]]) -> list[Floats32]:
        """Return what :meth:`at` of each does."""
        return self._index.at_all([(vote._query, stations, shifts) for vote, stations, shifts in requests])
