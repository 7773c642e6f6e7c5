"""Stations: places of virtual reference scans, on ground and floors, and their descriptors (paper, eqs 1-4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_stream.basemap.ground import ground_mask
from coview_stream.clouds.progress import Progress
from coview_stream.config import Channel, DescriptorConfig
from coview_stream.descriptors.coview import channel
from coview_stream.errors import MapError
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Indices, Ints, Reals
from coview_stream.geometry.rasters import cells, lowest_per_cell
from coview_stream.geometry.transforms import Points

# floors of buildings
_SUBCELL = 0.5  # metres: an airborne scan of 8 points/m2 has two in each such cell
_STEP = 0.1  # metres: height resolution of the columns
_SAME_LEVEL = 1.0  # metres: closer heights in a cell are one level
_HEADROOM = 1.8  # metres of free height above a floor
_COVER = 6.0  # metres above a floor within which it has a flat cover, unlike a roof in the open
_MIN_AREA = 25.0  # square metres of a connected floor: most smaller ones are overhangs
_FLATNESS = 2  # height steps between neighbouring half-metre cells

Described = dict[Channel, npt.NDArray[np.float16]]
"""(M, R, S) of each channel."""
RASTER_CELL = 0.5  # metres; a tenth of a bin's width at the rim, a fifth of its depth
_PORTION = 512  # stations at a time: 7 MB of bins
_DENSE = 64  # voxels of a raster per point, up to which a table of all voxels is faster than sorting the points
_STOREY = 1.0  # metres: indoor stations whose floors differ less are described together
_BELOW_FLOOR = 1.0  # metres below the floor that still belong to the storey
_MAX_STOREYS = 1024  # a kilometre from the lowest indoor station to the highest
_MAX_LEVELS = 128  # stations above one another: no building has more floors
LEVEL_GAP = 2.5
"""Metres: stations farther apart in height are on different storeys."""


def below_another(stations: Points, cell: float) -> Bools:
    """Mask the stations (M, 3) with another station above them in their ``cell``-sized square."""
    if not len(stations):
        return np.zeros(0, dtype=bool)
    _, _, flat = cells(stations, cell)
    order = np.lexsort((stations[:, 2], flat))
    below = np.zeros(len(stations), dtype=bool)
    below[order[:-1]] = flat[order[:-1]] == flat[order[1:]]
    return below


def indoor_floors(points: Points) -> Points:
    """Return the half-metre cells (K, 3) of all covered floors including the lowest storey, metres."""
    corner, shape, flat = cells(points, _SUBCELL)
    level = np.floor(points[:, 2] / np.float32(_STEP)).astype(np.int64)
    base = int(level.min())
    span = int(level.max()) - base + 1
    voxels = np.unique(flat * span + (level - base))
    column, z = np.divmod(voxels, span)
    # the next occupied voxel of the same column, if there is one
    gap = np.where(column[1:] == column[:-1], (z[1:] - z[:-1]) * _STEP, np.inf)
    covered = (gap >= _HEADROOM) & (gap <= _COVER)
    column, floor = column[:-1][covered], z[:-1][covered]
    ceiling = floor + np.round(gap[covered] / _STEP).astype(np.int64)
    wide = _flat_and_wide(column, floor, ceiling, shape)
    row, col = np.divmod(column[wide], shape[1])
    x, y = corner[0] + (col + 0.5) * _SUBCELL, corner[1] + (row + 0.5) * _SUBCELL
    return np.column_stack([x, y, (floor[wide] + base + 0.5) * _STEP]).astype(np.float32)


def _flat_and_wide(column: Ints, floor: Ints, ceiling: Ints, shape: tuple[int, int]) -> Bools:
    """Mask the candidates in wide connected pieces whose floor and ceiling continue in the neighbouring cells."""
    wide = np.zeros(len(column), dtype=bool)
    # candidates of a column differ by at least the headroom, so each slab holds one per column
    slab_height = int(_HEADROOM / _STEP)
    # slabs overlap by half, so that no border cuts a floor
    for shift in (0, slab_height // 2):
        slab = (floor + shift) // slab_height
        for number in np.unique(slab):
            index = np.flatnonzero(slab == number)
            if len(index) * _SUBCELL**2 >= _MIN_AREA:
                wide[index[_one_slab(column[index], floor[index], ceiling[index], shape)]] = True
    return wide


def _one_slab(column: Ints, floor: Ints, ceiling: Ints, shape: tuple[int, int]) -> Bools:
    from scipy import ndimage  # only for builds: an installation without extras lacks it

    row, col = np.divmod(column, shape[1])
    # crop to this slab's candidates; one cell of border keeps neighbours inside
    row, col = row - row.min() + 1, col - col.min() + 1
    size = (int(row.max()) + 2, int(col.max()) + 2)
    low, high = np.full(size, np.nan, np.float32), np.full(size, np.nan, np.float32)
    low[row, col], high[row, col] = floor, ceiling
    agreeing = np.zeros(len(row), dtype=np.int64)
    for dr in (-1, 0, 1):
        for dc in (-1, 0, 1):
            near = np.abs(low[row + dr, col + dc] - floor) <= _FLATNESS
            # a ceiling may slope by 45 degrees
            near &= np.abs(high[row + dr, col + dc] - ceiling) <= _SUBCELL / _STEP
            agreeing += near
    solid = np.zeros(size, dtype=bool)
    solid[row, col] = agreeing >= 6  # of nine: a cell at a wall has six
    labels, _ = ndimage.label(solid, structure=np.ones((3, 3)))
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return np.asarray(sizes[labels[row, col]] * _SUBCELL**2 >= _MIN_AREA)


def _upper_squares(floors: Points, base: Points, cell: float) -> Points:
    """Find the squares of floors above the base level of their cell that cover a quarter of the cell."""
    from scipy import ndimage  # only for builds: an installation without extras lacks it

    if not len(floors):
        return floors.reshape(0, 3)
    corner, shape, flat = cells(np.concatenate([floors, base]), cell)
    own = flat[: len(floors)]
    base_height = np.full(shape, -np.inf, dtype=np.float32)
    base_height.flat[flat[len(floors) :]] = base[:, 2]
    above = floors[:, 2] > base_height.flat[own] + _SAME_LEVEL
    remaining, own = floors[above], own[above]
    min_cells = max(1, int(0.25 * (cell / _SUBCELL) ** 2))
    levels = [np.zeros((0, 3), dtype=np.float32)]
    while len(remaining):  # one storey per round, from below
        lowest = lowest_per_cell(remaining, own)
        bottom = np.full(shape, np.inf, dtype=np.float32)
        bottom.flat[own[lowest]] = remaining[lowest, 2]
        now = remaining[:, 2] <= bottom.flat[own] + _SAME_LEVEL
        counts = np.bincount(own[now], minlength=shape[0] * shape[1])
        enough = now & (counts[own] >= min_cells)
        unique = np.unique(own[enough])
        row, column = np.divmod(unique, shape[1])
        z = ndimage.median(remaining[enough, 2], own[enough], unique)
        xy = np.column_stack([corner[0] + (column + 0.5) * cell, corner[1] + (row + 0.5) * cell])
        levels.append(np.column_stack([xy, z]).astype(np.float32).reshape(-1, 3))
        remaining, own = remaining[~now], own[~now]
    return np.concatenate(levels)


def find_stations(points: Points, block: float, levels: bool = True) -> Floats32:
    """Put stations (M, 3), one per ``block``-sized cell that has ground, at its centre and median ground height.

    With ``levels``, every *indoor* floor above it adds a station: flat, wide, with headroom and a flat cover. An upper
    storey counts; a roof, a bridge deck or an open parking deck (no cover) and a canopy (not flat) do not. Heights of
    upper levels are accurate to 0.1 m. (The authors' program takes centroids of 3-D voxels, which puts two stations
    into 5 % of the cells.)
    """
    mask = ground_mask(points)
    if not mask.any():
        return np.zeros((0, 3), dtype=np.float32)
    ground = points[mask]
    corner, shape, flat = cells(ground, block)
    order = np.lexsort((ground[:, 2], flat))
    unique, first, count = np.unique(flat[order], return_index=True, return_counts=True)
    row, column = np.divmod(unique, shape[1])
    z = ground[order[first + count // 2], 2]
    xy = [corner[0] + (column + 0.5) * block, corner[1] + (row + 0.5) * block]
    base = np.column_stack([*xy, z]).astype(np.float32)
    return np.concatenate([base, _upper_squares(indoor_floors(points), base, block)]) if levels else base


def describe_storeys(
    points: Points,
    stations: Floats32,
    block: float,
    config: DescriptorConfig,
    progress: Progress | None = None,
    wanted: Ints | None = None,
) -> Described:
    """Describe stations by channels (M, R, S); stations below another storey are described storey by storey.

    A robot below another floor sees that floor, not the roof. Such stations of similar height therefore share a raster
    of the points from a metre below their floor up to the highest possible ceiling.

    Args:
        points: (N, 3), at least all points within the radius plus two blocks of the stations.
        stations: (M, 3), with all stations of their blocks.
        block: metres.
        config: settings of the descriptors.
        progress: called with the numbers of stations done and of all stations.
        wanted: (K,) numbers of the stations to describe, in the order of the result; None takes all.

    Raises:
        MapError: the stations stand on more than 1,024 storeys, or beside all points.
    """
    indoors = below_another(stations, block)
    if wanted is not None:
        stations, indoors = stations[wanted], indoors[wanted]
    corner = aligned_corner(points, block, RASTER_CELL)
    # the centre of a block at the upper edge may lie beyond the last point
    margin = int(np.ceil(block / RASTER_CELL))
    storey = np.where(indoors, np.round(stations[:, 2] / _STOREY), np.inf)
    shape = (len(stations), config.rings, config.sectors)
    described: Described = {name: np.zeros(shape, dtype=np.float16) for name in config.channels}
    done = 0
    floors = np.unique(storey)
    if len(floors) > _MAX_STOREYS:  # each has a raster of its own
        raise MapError(f"the map's stations stand on {len(floors)} storeys, {_MAX_STOREYS} at most; build it again")
    for floor in floors:
        chosen = np.flatnonzero(storey == floor)
        part = points
        if np.isfinite(floor):
            above = points[:, 2] - floor * _STOREY
            part = points[(above > -_BELOW_FLOOR) & (above < _COVER)]
        raster = rasterise(part, corner, RASTER_CELL, config.voxel, margin, points, "paper" in config.channels)
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

    float16 resolves 2 cm at 30 m height, far below the noise of a maximum over a bin. MapError if a station is beside
    the raster.
    """
    shape = (len(stations), config.rings, config.sectors)
    described: Described = {name: np.empty(shape, dtype=np.float16) for name in config.channels}
    rows, columns = raster.cells_of(stations[:, :2])
    inside = (rows >= 0) & (rows < raster.top.shape[0]) & (columns >= 0) & (columns < raster.top.shape[1])
    if not inside.all():
        raise MapError(f"{(~inside).sum()} stations lie beside the map's points; fetch or build it again")
    for start in range(0, len(stations), _PORTION):
        part = slice(start, start + _PORTION)
        grid = kernels.station_bins(
            raster.top,
            raster.count,
            cell=raster.cell,
            rows=rows[part],
            cols=columns[part],
            ground=stations[part, 2],
            rings=config.rings,
            sectors=config.sectors,
            r_max=config.radius,
            raster_mean=raster.mean,
        )
        for name in config.channels:
            described[name][part] = channel(name, grid)
        if progress:
            progress(min(start + _PORTION, len(stations)), len(stations))
    return described


@dataclass(frozen=True)
class HeightRaster:
    """Raster of a cloud in square cells: greatest height, number of occupied voxels, and optionally their mean height.

    Arrays are (H, W), row along y and column along x; the centre of cell (r, c) is
    ``corner + cell * (c + 1/2, r + 1/2)``.

    Attributes:
        top: greatest height, metres, map frame; 0 in empty cells.
        count: number of occupied voxels.
        mean: mean height of one point per voxel, metres, map frame; 0 in empty cells; None if not requested.
        corner: (2,) lower left corner, metres, map frame.
        cell: edge, metres.
    """

    top: Floats32
    count: npt.NDArray[np.int32]
    mean: Floats32 | None
    corner: Floats
    cell: float

    def cells_of(self, xy: Reals) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """Return row and column (M,) of the cells that hold (M, 2) positions."""
        index = np.floor((np.asarray(xy, dtype=np.float64) - self.corner) / self.cell).astype(np.int32)
        return index[:, 1], index[:, 0]


def aligned_corner(points: Points, block: float, cell: float) -> Floats:
    """Return the lower left corner (2,) of a raster with a cell centred on the centre of every ``block``-sized cell.

    Stations stand at ``(k + 1/2) * block``, and ``block`` is a multiple of ``cell``: every station is at a cell's
    centre, so that one table of offsets to bins serves all.
    """
    lowest = np.floor(points[:, :2].min(axis=0).astype(np.float64) / block) * block
    return np.asarray(lowest + 0.5 * block - cell * (np.ceil(0.5 * block / cell) + 0.5))


def rasterise(
    points: Points, corner: Floats, cell: float, voxel: float, margin: int = 0, extent: Points | None = None,
    means: bool = False,
) -> HeightRaster:  # fmt: skip
    """Raster (N, 3) map-frame points over ``extent`` (default: the points) and ``margin`` cells beyond.

    The density of a cell (eq. 3) counts occupied voxels of edge ``voxel``, as point counts depend on the scan pattern.
    """
    column, row = (np.floor((points[:, k] - corner[k]) / cell).astype(np.int64) for k in (0, 1))
    level = np.floor(points[:, 2] / voxel).astype(np.int64)
    far = (points if extent is None else extent)[:, :2].max(axis=0)
    width, height = (np.floor((far - corner) / cell).astype(int) + 1 + margin).tolist()
    flat = row * width + column
    level -= level.min(initial=np.iinfo(level.dtype).max)  # there may be no points
    size, levels = height * width, int(level.max(initial=0)) + 1
    number = flat * levels + level
    if means or size * levels > _DENSE * len(points):
        # one sort by (cell, level) gives the voxels
        first = np.unique(number, return_index=True)[1]
        count = np.bincount(flat[first], minlength=size)
    else:
        occupied = np.zeros((size, levels), dtype=bool)
        occupied.ravel()[number] = True
        count = occupied.sum(axis=1)
    top = np.full(size, -np.inf, dtype=np.float32)
    np.maximum.at(top, flat, points[:, 2])
    top[count == 0] = 0.0
    shape, mean = (height, width), None
    if means:
        total = np.bincount(flat[first], weights=points[first, 2], minlength=size)
        mean = (total / np.maximum(count, 1)).astype(np.float32).reshape(shape)
    return HeightRaster(top.reshape(shape), count.astype(np.int32).reshape(shape), mean, corner, cell)


class StationGrid:
    """Grid that finds stations by position.

    Attributes:
        stations: (M, 3) float32 metres, in the map's frame.
        block: metres, edge of a cell; MapError if one has more than 128 stations.
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
        if (levels := int(count.max())) > _MAX_LEVELS:
            raise MapError(f"the map has {levels} stations above one another, {_MAX_LEVELS} at most; build it again")
        self._off = int(self._shape.prod())  # number of all cells off the grid
        # (L, U + 1) stations by level, lowest first, and occupied cell; -1 for none; the last column is for other cells
        self._levels = np.full((levels, len(unique) + 1), -1, dtype=np.int32)
        for level in range(levels):
            has = count > level
            self._levels[level, :-1][has] = order[first[has] + level]
        self._row = np.full(self._off + 1, len(unique), dtype=np.int32)
        self._row[unique] = np.arange(len(unique))
        # with a single level, the station of each cell, which saves a second look-up
        self._single = self._levels[0, self._row] if levels == 1 else None

    def __len__(self) -> int:
        """Return the number of stations M."""
        return len(self.stations)

    def at(self, positions: Reals) -> Indices:
        """Return the station (N,) in the cell of each position (N, 3), -1 for none; of levels the nearest in 2.5 m."""
        cell = self.cell(positions)
        if self._single is not None:
            return np.asarray(self._single.take(cell), dtype=np.intp)
        levels = self._levels[:, self._row[cell]]
        gap = np.abs(self.stations[levels, 2] - np.asarray(positions[:, 2], dtype=np.float32))
        gap[levels < 0] = np.inf
        best = gap.argmin(axis=0)
        column = np.arange(levels.shape[1])
        return np.where(gap[best, column] < LEVEL_GAP, levels[best, column], -1).astype(np.intp)

    def levels_at(self, positions: Reals) -> Indices:
        """Return the stations (L, N) of all levels, lowest first, at (N, 2 or 3) positions; -1 for none."""
        return np.asarray(self._levels[:, self._row[self.cell(positions)]], dtype=np.intp)

    def cells_of(self, chosen: Indices | slice) -> Ints:
        """Return column and row (N, 2) of the cells of stations, counted from the map's zero."""
        return np.asarray(np.floor(self.stations[chosen, :2].astype(np.float64) / self.block), dtype=np.int64)

    def cell(self, positions: Reals) -> Indices:
        """Return the number of the cell (N,) at each of (N, 2 or 3) positions; off the grid, the last number."""
        index = np.floor(np.asarray(positions[:, :2], dtype=np.float64) * (1.0 / self.block)).astype(np.int64)
        index -= self._low
        inside = (index >= 0).all(axis=1) & (index < self._shape).all(axis=1)
        return np.where(inside, index[:, 0] * self._shape[1] + index[:, 1], self._off)
