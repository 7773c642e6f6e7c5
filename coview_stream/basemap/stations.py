"""Stations: where virtual reference scans are taken, and their descriptors (paper, sections 3.1 and 3.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_stream.basemap.floors import LevelConfig, below_another, ground_levels, indoor_floors
from coview_stream.basemap.ground import ground_mask
from coview_stream.config import Channel, DescriptorConfig
from coview_stream.descriptors.coview import channel
from coview_stream.geometry.arrays import Floats, Floats32, Ints, Reals
from coview_stream.geometry.transforms import Points

Described = dict[Channel, npt.NDArray[np.float16]]
"""(M, R, S) of each channel."""

Progress = Callable[[int, int], None]
"""Called with (done, total)."""

RASTER_CELL = 0.5  # metres; a tenth of a bin's width at the rim, a fifth of its depth; set by hand
_PORTION = 512  # stations at a time: 7 MB of bins; set by hand
_FLOORS = LevelConfig(area=25.0)  # square metres: smaller floors are overhangs more often than not; set by hand
_STOREY = 1.0  # metres: indoor stations whose floors differ less are described together; set by hand
_BELOW_FLOOR = 1.0  # metres below the floor that still belong to the storey; set by hand
_CEILING = 6.0  # metres: as LevelConfig.cover; set by hand


def find_stations(points: Points, block: float, levels: bool = True) -> Floats32:
    """Put stations (M, 3), one per ``block``-sized cell that has ground, at its centre and median ground height.

    With ``levels`` there is one more for every floor of a building above it. (The paper's centroids of 3-D voxels put
    two stations into some cells.)
    """
    nothing = np.zeros((0, 3), dtype=np.float32)
    mask = ground_mask(points)
    if not mask.any():
        return nothing
    floors = indoor_floors(points, _FLOORS) if levels else nothing
    return ground_levels(points[mask], floors, block)


def describe_storeys(
    points: Points,
    stations: Floats32,
    block: float,
    config: DescriptorConfig,
    progress: Progress | None = None,
    wanted: Ints | None = None,
) -> Described:
    """Describe stations by channels (M, R, S), those with a storey above them storey by storey.

    A robot below another floor sees up to it, not the roof: such stations of similar height share a raster of the
    points from a metre below their floor up to the highest ceiling that counts as one.

    Args:
        points: (N, 3) of the map, or of all that lies within the radius and two blocks of the stations.
        stations: (M, 3) all stations of the blocks that any of them is in.
        block: metres.
        config: of the descriptors.
        progress: called with stations done and all stations.
        wanted: (K,) numbers of those that are to be described, in the order of the answer; None takes all.
    """
    indoors = below_another(stations, block)
    if wanted is not None:
        stations, indoors = stations[wanted], indoors[wanted]
    corner = aligned_corner(points, block, RASTER_CELL)
    # a block at the upper edge may have its centre beyond the last point
    margin = int(np.ceil(block / RASTER_CELL))
    storey = np.where(indoors, np.round(stations[:, 2] / _STOREY), np.inf)
    shape = (len(stations), config.rings, config.sectors)
    described: Described = {name: np.zeros(shape, dtype=np.float16) for name in config.channels}
    done = 0
    for floor in np.unique(storey):
        chosen = np.flatnonzero(storey == floor)
        part = points
        if np.isfinite(floor):
            above = points[:, 2] - floor * _STOREY
            part = points[(above > -_BELOW_FLOOR) & (above < _CEILING)]
        raster = rasterise(part, corner, RASTER_CELL, config.voxel, margin, points)
        before = done

        def step(count: int, _: int, before: int = before) -> None:
            if progress:
                progress(before + count, len(stations))

        for name, values in describe_stations(raster, stations[chosen], config, step).items():
            described[name][chosen] = values
        done += len(chosen)
    return described


def describe_stations(
    raster: HeightRaster, stations: Floats32, config: DescriptorConfig, progress: Progress | None = None
) -> Described:
    """Describe the virtual reference scans at ``stations`` (M, 3) by channels (M, R, S), float16.

    Stations are described in portions: the descriptors of all of them are in memory, their points never. float16 keeps
    2 cm at 30 m height, far below the noise of a maximum over a bin.
    """
    shape = (len(stations), config.rings, config.sectors)
    described: Described = {name: np.empty(shape, dtype=np.float16) for name in config.channels}
    rows, columns = raster.cells_of(stations[:, :2])
    for start in range(0, len(stations), _PORTION):
        part = slice(start, start + _PORTION)
        grid = kernels.station_bins(
            raster.top,
            raster.count,
            raster.cell,
            rows[part],
            columns[part],
            stations[part, 2],
            config.rings,
            config.sectors,
            config.radius,
        )
        for name in config.channels:
            described[name][part] = channel(name, grid)
        if progress:
            progress(min(start + _PORTION, len(stations)), len(stations))
    return described


@dataclass(frozen=True)
class HeightRaster:
    """Raster of a cloud: greatest height and number of occupied voxels of square cells.

    Arrays are (H, W): row along y, column along x; cell (r, c) has its centre at
    ``corner + cell * (c + 1/2, r + 1/2)``.

    Attributes:
        top: greatest height, metres, map frame; 0 in empty cells.
        count: occupied voxels.
        corner: (2,) lower left corner, metres, map frame.
        cell: edge, metres.
    """

    top: Floats32
    count: npt.NDArray[np.int32]
    corner: Floats
    cell: float

    def cells_of(self, xy: Reals) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """Return row and column (M,) of the cells that hold (M, 2) positions."""
        index = np.floor((np.asarray(xy, dtype=np.float64) - self.corner) / self.cell).astype(np.int32)
        return index[:, 1], index[:, 0]


def aligned_corner(points: Points, block: float, cell: float) -> Floats:
    """Return the lower left corner (2,) of a raster whose cells have the centres of ``block``-sized cells among theirs.

    Stations stand at ``(k + 1/2) * block``; a half-cell shift lets one offset table serve them all. Needs
    ``block`` to be a multiple of ``cell``.
    """
    lowest = np.floor(points[:, :2].min(axis=0).astype(np.float64) / block) * block
    return np.asarray(lowest + 0.5 * block - cell * (np.ceil(0.5 * block / cell) + 0.5))


def rasterise(
    points: Points, corner: Floats, cell: float, voxel: float, margin: int = 0, extent: Points | None = None
) -> HeightRaster:
    """Raster (N, 3) map-frame points.

    The density of a cell (eq. 3) counts occupied voxels of edge ``voxel``: counts of raw points depend on the scan
    pattern. The raster reaches to the farthest of ``extent`` (by default the points) and ``margin`` empty cells beyond.
    """
    column, row = np.floor((points[:, :2] - corner) / cell).astype(np.int64).T
    level = np.floor(points[:, 2] / voxel).astype(np.int64)
    far = (points if extent is None else extent)[:, :2].max(axis=0)
    width, height = (np.floor((far - corner) / cell).astype(int) + 1 + margin).tolist()
    flat = row * width + column
    # one sort by (cell, level) gives the voxels; the last point of a sorted cell is not its highest, hence maximum
    level -= level.min()
    _, first = np.unique(flat * (int(level.max()) + 1) + level, return_index=True)
    size = height * width
    count = np.bincount(flat[first], minlength=size)
    top = np.full(size, -np.inf, dtype=np.float32)
    np.maximum.at(top, flat, points[:, 2])
    top[count == 0] = 0.0
    return HeightRaster(top.reshape(height, width), count.astype(np.int32).reshape(height, width), corner, cell)
