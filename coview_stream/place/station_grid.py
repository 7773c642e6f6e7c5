"""The stations as the square grid they stand on: whatever has a value for each, looked up a step farther on."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float32]

_MARGIN = 100  # cells around the stations that are looked up; steps of more find nothing there
_LEVEL_GAP = 2.5  # metres: stations farther apart in height are on different storeys
_FILLED = 0.25  # share of the cells that must have a station, or the values are not laid out on them


class StationGrid:
    """Finds the station at a position: stations stand at the centres of a square grid, one per level.

    The values of stations, ``(S, M)``, are added up a step apart in either of two layouts, which agree for steps of
    less than 100 cells. Where most cells have one station they are laid out on the cells, ``(S, H, W)``, and a step is
    a shifted slice; otherwise (a lone road, or storeys) each is looked up, ``(S, M + 1)``, where the last column means
    no station.

    Attributes:
        laid_out: whether the first layout is used.
    """

    def __init__(self, stations: npt.NDArray[np.float32], block: float) -> None:
        self.stations = stations
        self.block = block
        cells = np.floor(stations[:, :2].astype(np.float64) / block).astype(np.int64)
        cells -= cells.min(axis=0)
        rows, columns = (int(n) + 1 for n in cells.max(axis=0))
        self._shape = rows, columns
        self._cell = cells[:, 0] * columns + cells[:, 1]
        single = len(np.unique(self._cell)) == len(stations)
        self.laid_out = bool(single and len(stations) >= _FILLED * rows * columns)
        self._width = columns + 2 * _MARGIN
        self._flat = (cells[:, 0] + _MARGIN) * self._width + cells[:, 1] + _MARGIN

    @cached_property
    def _grid(self) -> npt.NDArray[np.intp]:
        """Station (L, cells) of each level and cell with its margin, lowest level first, -1 for none."""
        order = np.lexsort((self.stations[:, 2], self._flat))
        unique, first, count = np.unique(self._flat[order], return_index=True, return_counts=True)
        size = (self._shape[0] + 2 * _MARGIN) * self._width
        grid = np.full((int(count.max()), size), -1, dtype=np.intp)
        for level in range(len(grid)):
            has = count > level
            grid[level, unique[has]] = order[first[has] + level]
        return grid

    def moved(self, step: npt.NDArray[np.int64], rise: float) -> npt.NDArray[np.intp]:
        """Index (M,) of the station that lies ``step`` (2,) cells from each station, -1 where there is none.

        ``rise`` (metres) is the height gained on the way; it picks the storey.
        """
        if np.abs(step).max() >= _MARGIN:
            return np.full(len(self.stations), -1, dtype=np.intp)
        there = self._flat + (step[0] * self._width + step[1])
        if len(self._grid) == 1:
            return np.asarray(self._grid[0][there])
        levels = self._grid[:, there]
        gap = np.abs(self.stations[levels, 2] - (self.stations[:, 2] + rise))
        gap[levels < 0] = np.inf
        best = gap.argmin(axis=0)
        columns = np.arange(len(self.stations))
        return np.where(gap[best, columns] < _LEVEL_GAP, levels[best, columns], -1)

    def spread(self, values: Values) -> Values:
        """Lay out values (S, M) of the stations for :meth:`add`; a cell without a station has zero."""
        if not self.laid_out:
            return np.concatenate([values, np.zeros((len(values), 1), dtype=np.float32)], axis=1)
        cells = np.zeros((len(values), self._shape[0] * self._shape[1]), dtype=np.float32)
        cells[:, self._cell] = values
        return cells.reshape(len(values), *self._shape)

    def gathered(self, spread: Values) -> Values:
        """Values (S, M) of the stations out of their layout; undoes :meth:`spread`."""
        if not self.laid_out:
            return spread[:, :-1]
        return np.asarray(spread.reshape(len(spread), -1)[:, self._cell])

    def add(self, total: Values, values: Values, step: npt.NDArray[np.int64], rise: float) -> None:
        """Add to each station's ``total`` what ``values`` has ``step`` cells farther on; both one row of a layout."""
        if not self.laid_out:
            total[:-1] += values.take(self.moved(step, rise))  # -1, no station there, finds the zero
            return
        (rows, columns), (down, across) = self._shape, step.tolist()
        if abs(down) < rows and abs(across) < columns:
            to = slice(max(0, -down), rows - max(0, down)), slice(max(0, -across), columns - max(0, across))
            of = slice(max(0, down), rows - max(0, -down)), slice(max(0, across), columns - max(0, -across))
            total[to] += values[of]
