"""Floors: the ground and every storey of a building that a robot can stand on, one station height for each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from coview_stream.errors import ConfigError
from coview_stream.geometry.arrays import Bools, Ints
from coview_stream.geometry.rasters import cells, lowest_per_cell
from coview_stream.geometry.transforms import Points

# set by hand
_SUBCELL = 0.5  # metres: airborne scans of 8 points/m2 still fill two
_STEP = 0.1  # metres: height resolution of the columns
_SAME_LEVEL = 1.0  # metres: closer heights of one cell are one level


@dataclass(frozen=True)
class LevelConfig:
    """Criteria of an upper floor; set by hand.

    Attributes:
        headroom: free height above it, metres.
        cover: something flat must lie above within this height, metres; a roof in the open has nothing.
        area: minimal connected area, square metres.
        flatness: neighbouring half-metre cells differ by less than this, metres.
    """

    headroom: float = 1.8
    cover: float = 6.0
    area: float = 4.0
    flatness: float = 0.2

    def __post_init__(self) -> None:
        if not 0.3 <= self.headroom < self.cover <= 50.0:
            raise ConfigError(f"headroom={self.headroom}, cover={self.cover}: need 0.3 <= headroom < cover <= 50")
        if not (0.25 <= self.area <= 10_000 and 0.01 <= self.flatness <= 1.0):
            raise ConfigError(f"area={self.area}, flatness={self.flatness}: need 0.25-10000 m2 and 0.01-1 m")


def ground_levels(ground: Points, floors: Points, cell: float) -> Points:
    """Find the centres (K, 3) of all walkable ``cell``-sized squares, one for each level, metres.

    The lowest level is the ground itself. A higher one counts only where it is a floor *indoors*: flat, extended, with
    headroom, and covered by something flat. So an upper storey counts, while a roof (nothing above), a bridge deck in
    the open, and a canopy (not flat) do not. The price: an open parking deck or roof terrace is no level. Heights of
    upper levels are good to 0.1 m.

    Args:
        ground: (N, 3) float32 points on the ground, metres.
        floors: (F, 3) of :func:`indoor_floors`; empty for the ground alone.
        cell: edge of the squares, whose centres are (k + 1/2) * cell, metres.
    """
    base = _squares(ground, cell)
    return np.concatenate([base, _upper_squares(floors, base, cell)])


def below_another(stations: Points, cell: float) -> Bools:
    """Mask the stations (M, 3) that have another one above them in their ``cell``-sized square."""
    if not len(stations):
        return np.zeros(0, dtype=bool)
    _, _, flat = cells(stations, cell)
    order = np.lexsort((stations[:, 2], flat))
    below = np.zeros(len(stations), dtype=bool)
    below[order[:-1]] = flat[order[:-1]] == flat[order[1:]]
    return below


def indoor_floors(points: Points, config: LevelConfig) -> Points:
    """Find the half-metre cells (K, 3) of all covered floors, the lowest storey included, metres."""
    corner, shape, flat = cells(points, _SUBCELL)
    level = np.floor(points[:, 2] / np.float32(_STEP)).astype(np.int64)
    base = int(level.min())
    span = int(level.max()) - base + 1
    voxels = np.unique(flat * span + (level - base))
    column, z = np.divmod(voxels, span)
    # the next occupied voxel of the same column, if there is one
    gap = np.where(column[1:] == column[:-1], (z[1:] - z[:-1]) * _STEP, np.inf)
    covered = (gap >= config.headroom) & (gap <= config.cover)
    column, floor = column[:-1][covered], z[:-1][covered]
    ceiling = floor + np.round(gap[covered] / _STEP).astype(np.int64)
    kept = _flat_and_wide(column, floor, ceiling, shape, config)
    row, col = np.divmod(column[kept], shape[1])
    x, y = corner[0] + (col + 0.5) * _SUBCELL, corner[1] + (row + 0.5) * _SUBCELL
    return np.column_stack([x, y, (floor[kept] + base + 0.5) * _STEP]).astype(np.float32)


def _flat_and_wide(column: Ints, floor: Ints, ceiling: Ints, shape: tuple[int, int], config: LevelConfig) -> Bools:
    """Mask the candidates in wide connected pieces, whose floor and ceiling go on in the neighbouring cells."""
    kept = np.zeros(len(column), dtype=bool)
    steps = max(1, round(config.flatness / _STEP))
    # candidates of one column differ by the headroom at least, so each slab holds one of a column
    slab_height = max(steps + 1, int(config.headroom / _STEP))
    # slabs overlap by half, or a floor that lies across a border would be cut
    for shift in (0, slab_height // 2):
        slab = (floor + shift) // slab_height
        for number in np.unique(slab):
            index = np.flatnonzero(slab == number)
            if len(index) * _SUBCELL**2 < config.area:
                continue
            inside = _one_slab(column[index], floor[index], ceiling[index], shape, steps, config.area)
            kept[index[inside]] = True
    return kept


def _one_slab(column: Ints, floor: Ints, ceiling: Ints, shape: tuple[int, int], steps: int, area: float) -> Bools:
    row, col = np.divmod(column, shape[1])
    # crop to where this slab has candidates; one cell of border keeps neighbours inside
    row, col = row - row.min() + 1, col - col.min() + 1
    size = (int(row.max()) + 2, int(col.max()) + 2)
    low, high = np.full(size, np.nan, np.float32), np.full(size, np.nan, np.float32)
    low[row, col], high[row, col] = floor, ceiling
    agreeing = np.zeros(len(row), dtype=np.int64)
    for dr in (-1, 0, 1):
        for dc in (-1, 0, 1):
            near = np.abs(low[row + dr, col + dc] - floor) <= steps
            # a ceiling may slope by 45 degrees
            near &= np.abs(high[row + dr, col + dc] - ceiling) <= _SUBCELL / _STEP
            agreeing += near
    solid = np.zeros(size, dtype=bool)
    solid[row, col] = agreeing >= 6  # of nine: a cell at a wall has six
    labels, _ = ndimage.label(solid, structure=np.ones((3, 3)))
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return np.asarray(sizes[labels[row, col]] * _SUBCELL**2 >= area)


def _squares(ground: Points, cell: float) -> Points:
    """Return the cell centre and median height of the ground in each cell, one height per cell."""
    if not len(ground):
        return ground.reshape(0, 3)
    corner, shape, flat = cells(ground, cell)
    order = np.lexsort((ground[:, 2], flat))
    unique, first, count = np.unique(flat[order], return_index=True, return_counts=True)
    row, column = np.divmod(unique, shape[1])
    z = ground[order[first + count // 2], 2]
    return np.column_stack([corner[0] + (column + 0.5) * cell, corner[1] + (row + 0.5) * cell, z]).astype(np.float32)


def _upper_squares(floors: Points, base: Points, cell: float) -> Points:
    """Find the squares of floors that lie above the base level of their cell and cover a quarter of it."""
    if not len(floors):
        return floors.reshape(0, 3)
    corner, shape, flat = cells(np.concatenate([floors, base]), cell)
    own = flat[: len(floors)]
    base_height = np.full(shape, -np.inf, dtype=np.float32)
    base_height.flat[flat[len(floors) :]] = base[:, 2]
    above = floors[:, 2] > base_height.flat[own] + _SAME_LEVEL
    remaining, own = floors[above], own[above]
    min_cells = max(1, int(0.25 * (cell / _SUBCELL) ** 2))
    found = [np.zeros((0, 3), dtype=np.float32)]
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
        found.append(np.column_stack([xy, z]).astype(np.float32).reshape(-1, 3))
        remaining, own = remaining[~now], own[~now]
    return np.concatenate(found)
