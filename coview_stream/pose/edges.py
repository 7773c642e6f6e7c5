"""Where the map, seen from above, must have a wall: below the edges of what stands high.

An airborne scan shows roofs and few of the facades that a robot sees. But a facade stands under the edge of a roof, so
a point there is explained by the map though no map point is near it. Seen by hand on one simulated campus (no command
prints it) in whose map most facades are missing: at the right place 27-55 % of the structure has a map point within
0.5 m, and 99-100 % has one or stands below an edge; at the best wrong places 6-22 % and 25-44 %.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from coview_stream.geometry import Points
from coview_stream.sliding import highest_around, lowest_around

_CELL = 0.5  # metres
_DROP = 2.0  # metres: what falls less is no wall
_REACH = 5  # cells, odd: an edge is where the lowest top within it lies deeper than the drop
_OVERHANG = 3  # cells, odd: a wall stands this close to the edge
_SLACK = 0.5  # metres that a point may rise above the edge
_NOTHING = -1e6


@dataclass(frozen=True)
class EdgeRaster:
    """Height of the edges (H, W) of a map crop, metres; row along x, column along y from ``corner`` (2,)."""

    height: npt.NDArray[np.float32]
    corner: npt.NDArray[np.float64]

    def above(self, points: npt.NDArray[np.floating]) -> npt.NDArray[np.bool_]:
        """Which of (N, 3) points stand below an edge of the map."""
        cells = np.floor((points[:, :2] - self.corner) / _CELL).astype(np.int64)
        inside = ((cells >= 0) & (cells < self.height.shape)).all(axis=1)
        cells[~inside] = 0
        return np.asarray(inside & (self.height[cells[:, 0], cells[:, 1]] > points[:, 2] - _SLACK))


def edge_raster(points: Points) -> EdgeRaster:
    """Edges of (K, 3) map points. Cells without points count as low: below a roof's edge there often are none."""
    corner = np.array([points[:, d].min() for d in range(2)], dtype=np.float64) - 2 * _CELL
    i, j = (np.floor((points[:, d] - corner[d]) / _CELL).astype(np.int64) for d in range(2))
    rows, columns = int(i.max()) + 3, int(j.max()) + 3
    flat = np.full(rows * columns, _NOTHING, dtype=np.float32)
    np.maximum.at(flat, i * columns + j, np.ascontiguousarray(points[:, 2]))  # quick on flat arrays only
    top = flat.reshape(rows, columns)
    edge = np.where(top - lowest_around(top, _REACH) > _DROP, top, np.float32(_NOTHING))
    return EdgeRaster(highest_around(edge, _OVERHANG), corner)
