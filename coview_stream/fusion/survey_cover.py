"""Survey cover: what of a place the base map's survey saw, as far as its points tell."""

from __future__ import annotations

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.geometry.arrays import Bools, Floats32
from coview_stream.geometry.rasters import max_filter
from coview_stream.geometry.transforms import Points

_CELL = 0.5  # metres; set by hand, as are the next two
_AROUND = 5  # cells: eaves and crowns hide what stands a metre beside them
_CHUNK = 1_000_000
_MAX_CELLS = 400_000_000


class SurveyCover:
    """Heights of the highest points of the base map around each place.

    Seen from above, all that stands higher than these was covered, and would be in the map if it had been there; what
    is lower may be hidden below a roof or a crown, or be a facade.
    """

    def __init__(self, base_map: BaseMap, low: Points, high: Points) -> None:
        """Look at a rectangle from ``low`` (2,) to ``high`` (2,), relative to the map's origin."""
        self._low = np.floor(np.asarray(low, dtype=np.float64) - 2.0)
        shape = np.ceil((np.asarray(high, dtype=np.float64) + 2.0 - self._low) / _CELL).astype(int) + 1
        if int(shape[0]) * int(shape[1]) > _MAX_CELLS:
            raise ValueError(f"an area of {shape[0] * _CELL:.0f} x {shape[1] * _CELL:.0f} m")
        top = np.full(tuple(shape), -np.inf, dtype=np.float32)
        for begin in range(0, len(base_map.points), _CHUNK):
            points = np.asarray(base_map.points[begin : begin + _CHUNK])
            cells = np.floor((points[:, :2] - self._low) / _CELL).astype(np.int64)
            inside = ((cells >= 0) & (cells < shape)).all(axis=1)
            np.maximum.at(top, tuple(cells[inside].T), points[inside, 2])
        self._top = max_filter(top, _AROUND)

    def top_around(self, points: Points) -> Floats32:
        """Return the highest height (N,) of the map around points (N, 3); minus infinity where it has no points."""
        cells = np.floor((points[:, :2] - self._low) / _CELL).astype(np.int64)
        inside = ((cells >= 0) & (cells < self._top.shape)).all(axis=1)
        out = np.full(len(points), -np.inf, dtype=np.float32)
        out[inside] = self._top[tuple(cells[inside].T)]
        return out

    def saw(self, points: Points, above: float) -> Bools:
        """Tell of points (N, 3) whether the survey would have seen them: ``above`` metres over all around them."""
        top = self.top_around(points)
        return np.asarray(np.isfinite(top) & (points[:, 2] > top + above))
