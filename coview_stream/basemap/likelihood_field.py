"""Likelihood field of a map: rasters whose cells are looked up to score a pose.

Square cells of half a metre, in tiles of 16 m that are stored only where the map has been surveyed:

* occupied: one bit per half metre of height. Bit ``floor(2 z) mod 64`` covers height z in the map's frame, and heights
  that differ by multiples of 32 m.
* ground: height of the lowest surface at the cell's centre.
* edge: height of the roof edges below which walls must stand (:func:`roof_edges`).

The field takes 48 MB per km2 of a map file. Opening a map derives the rasters for the look-ups, its layers
(:class:`~coview_kernels.reference.field.FieldLayers`), 88 MB per km2 of memory. A node memory-maps the layers, from the
working file of a site or from the cache.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from coview_kernels import FieldMap
from coview_kernels.field import Zeros
from coview_kernels.reference.field import CELL, EDGE_STEP, NO_GROUND, NOT_SURVEYED, TILE, FieldLayers
from coview_stream.basemap.file_format import Arrays
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Ints
from coview_stream.geometry.rasters import max_filter, min_filter
from coview_stream.geometry.transforms import Points

_BASE = 8  # metres: a tile's heights count from a multiple of this
_GROUND_BAND = 0.4  # metres above the lowest point nearby that are still ground
_STEEPEST = 0.7  # least vertical part of a ground normal
_GROUND_GROWTH = 2  # cells by which the ground is extended into cells without points
_DROP = 2.0  # metres: smaller drops are not walls
_REACH = 5  # cells, odd: at an edge the lowest top in this window is lower by more than the drop
_OVERHANG = 3  # cells, odd: a wall stands in this window around the edge
_NOTHING = np.float32(-1e6)  # metres: height of an empty cell
FIELD_ARRAYS = ("field.tiles", "field.occupied", "field.ground", "field.edge")
LAYERS = "field.layers."
"""Names of a field's arrays in a map file, and prefix of the names of its layers."""

_Number = TypeVar("_Number", bound=np.generic)


def field_arrays(points: Points, normals: Points, surveyed: Bools, corner: Floats, block: float) -> Arrays:
    """Build the field of a cloud (N, 3), map frame, with unit normals (N, 3), as arrays of the map's file.

    ``surveyed`` (H, W) masks the surveyed cells, row along y, of edge ``block``, a multiple of half a metre;
    ``corner`` (2,) is the lower corner of cell (0, 0), metres.
    """
    ratio = round(block / CELL)
    low = np.rint(np.asarray(corner) / CELL).astype(np.int64)[::-1]  # row, column of the first cell
    first = low // TILE * TILE
    shape = -((first - low - np.array(surveyed.shape) * ratio) // TILE) * TILE
    known = np.zeros(shape, dtype=bool)
    top, left = low - first
    fine = surveyed.astype(bool).repeat(ratio, axis=0).repeat(ratio, axis=1)
    known[top : top + fine.shape[0], left : left + fine.shape[1]] = fine
    rows, columns = (np.floor(points[:, d] / CELL).astype(np.int64) - first[1 - d] for d in (1, 0))
    flat = rows * shape[1] + columns
    occupied = np.zeros(shape[0] * shape[1], dtype=np.uint64)
    level = np.floor(points[:, 2] / CELL).astype(np.int64) & 63
    voxels = np.unique(flat * 64 + level)
    np.bitwise_or.at(occupied, voxels >> 6, np.uint64(1) << (voxels & 63).astype(np.uint64))
    ground = _ground_heights(points, normals, flat, (int(shape[0]), int(shape[1])))
    top_height = np.full(shape[0] * shape[1], _NOTHING, dtype=np.float32)
    np.maximum.at(top_height, flat, np.ascontiguousarray(points[:, 2]))
    edge = roof_edges(top_height.reshape(shape))
    down, across = (shape // TILE).tolist()
    used = np.flatnonzero(known.reshape(down, TILE, across, TILE).any(axis=(1, 3)).ravel())
    tiles = np.column_stack(np.divmod(used, across))
    heights = _tiles_of(ground, used)
    base = np.floor(np.nanmin(heights.reshape(len(heights), -1), axis=1, initial=np.inf) / _BASE)
    base = np.where(np.isfinite(base), base, 0.0).astype(np.int32) * _BASE
    lifted = heights - base[:, None, None]
    centimetres = np.where(np.isfinite(lifted), np.clip(np.rint(lifted * 100.0), -32000, 32000), NO_GROUND)
    centimetres[~_tiles_of(known, used)] = NOT_SURVEYED
    over = (_tiles_of(edge, used) - base[:, None, None]) / EDGE_STEP
    return {
        "field.tiles": np.column_stack([tiles + first // TILE, base]).astype(np.int32),
        "field.occupied": _tiles_of(occupied.reshape(shape).view(np.int64), used),
        "field.ground": centimetres.astype(np.int16),
        "field.edge": np.clip(np.floor(over), 0, 255).astype(np.uint8),
    }


def layers_arrays(arrays: Arrays, zeros: Zeros | None = None, done: Callable[[], object] = lambda: None) -> Arrays:
    """Return the layers of a map's field, for a working file.

    ``zeros`` allocates the arrays, by default in memory. With ``zeros``, ``done`` is called after each batch.
    """
    field = field_of(arrays)
    layers = field.layers if zeros is None else field.made_layers(zeros, done)
    return {f"{LAYERS}{name}": values for name, values in layers._asdict().items()}


def field_of(arrays: Arrays) -> FieldMap:
    """Return the field in a map's arrays, with its layers if there are any; KeyError or ValueError if it is invalid."""
    stored = None
    if f"{LAYERS}table" in arrays:
        stored = FieldLayers(*(arrays[f"{LAYERS}{name}"] for name in FieldLayers._fields))
    tiles, occupied, ground, edge = (arrays[name] for name in FIELD_ARRAYS)
    return FieldMap(tiles, occupied, ground, edge, stored)


def without_layers(arrays: Arrays) -> Arrays:
    """Return a map's arrays without the rasters of :func:`layers_arrays`."""
    return {name: values for name, values in arrays.items() if not name.startswith(LAYERS)}


def _tiles_of(raster: npt.NDArray[_Number], used: Ints) -> npt.NDArray[_Number]:
    """Cut a raster into the tiles (T, TILE, TILE) that are used."""
    down, across = raster.shape[0] // TILE, raster.shape[1] // TILE
    return np.ascontiguousarray(
        raster.reshape(down, TILE, across, TILE).transpose(0, 2, 1, 3).reshape(-1, TILE, TILE)[used]
    )


def _ground_heights(points: Points, normals: Points, flat: Ints, shape: tuple[int, int]) -> Floats32:
    """Return the ground height (H, W) at the cells' centres, metres; NaN where there is none."""
    size = shape[0] * shape[1]
    lowest = np.full(size, np.inf, dtype=np.float32)
    np.minimum.at(lowest, flat, points[:, 2])
    around = min_filter(lowest.reshape(shape), 3).ravel()
    upward = np.abs(normals[:, 2])
    low = (points[:, 2] < around[flat] + np.float32(_GROUND_BAND)) & (upward > _STEEPEST)
    chosen = points[low].astype(np.float64)
    across = (np.floor(chosen[:, :2] / CELL) + 0.5) * CELL - chosen[:, :2]
    slope = -normals[low, :2].astype(np.float64) / normals[low, 2:3]
    height = chosen[:, 2] + (across * slope).sum(axis=1)
    count = np.bincount(flat[low], minlength=size)
    total = np.bincount(flat[low], weights=height, minlength=size)
    ground = np.full(size, np.nan)
    np.divide(total, count, out=ground, where=count > 0)
    return _grown(ground.reshape(shape)).astype(np.float32)


def _grown(ground: Floats) -> Floats:
    """Extend the ground (H, W) into the cells around it, each the mean of its known neighbours."""
    for _ in range(_GROUND_GROWTH):
        has = np.isfinite(ground)
        padded, there = np.pad(np.where(has, ground, 0.0), 1), np.pad(has, 1).astype(np.float64)
        total, count = np.zeros_like(ground), np.zeros_like(ground)
        for down in range(3):
            for across in range(3):
                window = np.s_[down : down + ground.shape[0], across : across + ground.shape[1]]
                total += padded[window]
                count += there[window]
        ground = np.where(has | (count == 0), ground, total / np.maximum(count, 1.0))
    return ground


def roof_edges(top: Floats32) -> Floats32:
    """Find the edges of roofs, below which a site surveyed from above must have walls.

    Args:
        top: (H, W) greatest height of half-metre cells, metres; -1e6 in empty cells, which count as low because there
            are often no points below a roof's edge.

    Returns:
        (H, W) height of the edges; -1e6 where there is none.
    """
    edge = np.where(top - min_filter(top, _REACH) > _DROP, top, _NOTHING)
    return max_filter(edge, _OVERHANG)
