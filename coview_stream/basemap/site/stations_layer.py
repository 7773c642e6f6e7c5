"""Layer ``stations`` of a tile: the blocks that stations stand in, and their heights to the centimetre."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.errors import MapError
from coview_stream.geometry.arrays import Floats32

_MAX_BLOCK = 1 << 26  # blocks from the origin: 100,000 km

Layer = dict[str, npt.NDArray[Any]]


def stations_layer(stations: Floats32, block: float) -> Layer:
    """Return the arrays of stations (M, 3) at the centres of blocks, metres in the site's frame."""
    cells = np.floor(stations[:, :2].astype(np.float64) / block).astype(np.int64)
    order = np.lexsort((stations[:, 2], cells[:, 0], cells[:, 1]))
    height = np.rint(stations[order, 2].astype(np.float64) * 100.0).astype(np.int64)
    rows = np.column_stack([cells[order], height])
    return {"steps": np.ascontiguousarray(np.diff(rows, axis=0, prepend=np.zeros((1, 3), dtype=np.int64)).T, "<i4")}


def read_stations_layer(layer: Layer, block: float) -> Floats32:
    """Return the stations (M, 3), by rows and columns and from low to high.

    Raises:
        MapError: the arrays, which may come from anywhere, are others.
    """
    steps = layer.get("steps")
    if steps is None or steps.dtype.str != "<i4" or steps.ndim != 2 or len(steps) != 3:
        raise MapError("a tile's stations are not what they should be; fetch or build it again")
    rows = np.cumsum(steps.astype(np.int64), axis=1)
    if rows.size and np.abs(rows).max() > _MAX_BLOCK:
        raise MapError("a tile's stations lie beyond any site; fetch or build it again")
    xy, height = (rows[:2] + 0.5) * block, rows[2] / 100.0
    return np.column_stack([*xy, height]).astype(np.float32)
