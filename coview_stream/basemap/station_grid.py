"""The square grid at whose cells' centres the stations stand, one per level: which station is at a position."""

from __future__ import annotations

import numpy as np

from coview_stream.geometry.arrays import Floats32, Indices, Ints, Reals

LEVEL_GAP = 2.5
"""Metres: stations farther apart in height are on different storeys; set by hand."""


class StationGrid:
    """Look-up of stations by position.

    Attributes:
        stations: (M, 3) float32 metres, in the map's frame.
        block: metres, edge of a cell.
    """

    def __init__(self, stations: Floats32, block: float) -> None:
        self.stations = stations
        self.block = block
        cells = self.cells_of(slice(None))
        self._low = cells.min(axis=0)
        cells -= self._low
        self._shape = cells.max(axis=0) + 1
        flat = cells[:, 0] * self._shape[1] + cells[:, 1]
        order = np.lexsort((stations[:, 2], flat))
        unique, first, count = np.unique(flat[order], return_index=True, return_counts=True)
        # (L, cells + 1) station of each level and cell, lowest level first, -1 for none; the last cell is off the grid
        self._levels = np.full((int(count.max()), int(self._shape.prod()) + 1), -1, dtype=np.int32)
        for level in range(len(self._levels)):
            has = count > level
            self._levels[level, unique[has]] = order[first[has] + level]

    def __len__(self) -> int:
        """Return the number of stations M."""
        return len(self.stations)

    def at(self, positions: Reals) -> Indices:
        """Return the station (N,) in whose cell and on whose level each of (N, 3) positions is, -1 for none.

        Where the map has several levels it is the nearest one, less than 2.5 m above or below.
        """
        cell = self.cell(positions)
        if len(self._levels) == 1:
            return np.asarray(self._levels[0].take(cell), dtype=np.intp)
        levels = self._levels[:, cell]
        gap = np.abs(self.stations[levels, 2] - np.asarray(positions[:, 2], dtype=np.float32))
        gap[levels < 0] = np.inf
        best = gap.argmin(axis=0)
        each = np.arange(levels.shape[1])
        return np.where(gap[best, each] < LEVEL_GAP, levels[best, each], -1).astype(np.intp)

    def levels_at(self, positions: Reals) -> Indices:
        """Return the stations (L, N), lowest first, in whose cells (N, 2 or 3) positions are; -1 for none."""
        return np.asarray(self._levels[:, self.cell(positions)], dtype=np.intp)

    def cells_of(self, chosen: Indices | slice) -> Ints:
        """Return column and row (N, 2) of the cells that stations stand in, counted from the map's zero."""
        return np.asarray(np.floor(self.stations[chosen, :2].astype(np.float64) / self.block), dtype=np.int64)

    def storeys(self, station: int) -> list[int]:
        """Return the stations of a station's cell, lowest first, itself among them."""
        if len(self._levels) == 1:
            return [station]
        return [k for k in self._levels[:, self.cell(self.stations[station][None])[0]].tolist() if k >= 0]

    def cell(self, positions: Reals) -> Indices:
        """Return the number of the cell (N,) that holds each of (N, 2 or 3) positions; off the grid, the last."""
        index = np.floor(np.asarray(positions[:, :2], dtype=np.float64) * (1.0 / self.block)).astype(np.int64)
        index -= self._low
        inside = (index >= 0).all(axis=1) & (index < self._shape).all(axis=1)
        return np.where(inside, index[:, 0] * self._shape[1] + index[:, 1], self._levels.shape[1] - 1)
