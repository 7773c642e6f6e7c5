"""Stations: where virtual reference scans are taken, and their descriptors (paper, sections 3.1 and 3.2)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_stream.basemap.raster import HeightRaster
from coview_stream.config import Channel, DescriptorConfig
from coview_stream.geometry import Points
from coview_stream.place.descriptor import channel

Progress = Callable[[int, int], None]
"""Called with (done, total)."""

_PORTION = 512  # stations at a time: 7 MB of bins


def station_positions(ground: Points, block: float) -> npt.NDArray[np.float32]:
    """Stations (M, 3): one per ``block``-sized cell that has ground, at its centre and its median ground height.

    ``ground`` is (N, 3) ground points in the map frame, metres. The paper takes centroids of 3-D voxels, which
    puts two stations into some cells and none at their centres.
    """
    cells = np.floor(ground[:, :2].astype(np.float64) / block).astype(np.int64)
    low = cells.min(axis=0)
    width = int(cells[:, 1].max() - low[1]) + 1
    flat = (cells[:, 0] - low[0]) * width + cells[:, 1] - low[1]
    order = np.lexsort((ground[:, 2], flat))
    unique, first, count = np.unique(flat[order], return_index=True, return_counts=True)
    # sorted by height within the cell, so the median is the middle one
    z = ground[order[first + count // 2], 2]
    row, column = np.divmod(unique, width)
    xy = (np.column_stack([row, column]) + low + 0.5) * block
    return np.column_stack([xy, z]).astype(np.float32)


def describe_stations(
    raster: HeightRaster,
    stations: npt.NDArray[np.float32],
    config: DescriptorConfig,
    progress: Progress | None = None,
) -> dict[Channel, npt.NDArray[np.float16]]:
    """Descriptor channels (M, R, S) float16 of the virtual reference scans at ``stations`` (M, 3).

    Works through portions of stations: only the descriptors of all stations are ever in memory, never their points.
    float16 keeps 2 cm at 30 m height, far below the noise of a maximum over a bin.
    """
    shape = (len(stations), config.rings, config.sectors)
    described = {name: np.empty(shape, dtype=np.float16) for name in config.channels}
    rows, columns = raster.cells_of(stations[:, :2])
    for start in range(0, len(stations), _PORTION):
        part = slice(start, start + _PORTION)
        grid = kernels.station_bins(
            raster.top,
            raster.count,
            raster.total,
            raster.cell,
            rows[part],
            columns[part],
            stations[part, 2],
            config.rings,
            config.sectors,
            config.radius,
        )
        for name in config.channels:
            described[name][part] = channel(name, grid, config)
        if progress:
            progress(min(start + _PORTION, len(stations)), len(stations))
    return described
