"""Tiles of the map's cloud, which is sorted by tile so that a crop touches only the pages of its tiles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Int8s, Ints
from coview_stream.geometry.rasters import by_square
from coview_stream.geometry.transforms import Points

Key = tuple[int, int]
"""Column and row of a tile."""

_NORMAL_SCALE = 127.0
_SHORTEST = 0.0625  # least stored length: as int8, a shorter normal could be off by more than 6 degrees


def scaled_normals(normals: Points, planarity: Floats32) -> Points:
    """Scale unit normals (N, 3) to the form in a map, by the planarity (N,) in [0, 1] of the points around."""
    return normals * np.maximum(planarity, np.float32(_SHORTEST))[:, None]


def sort_by_tile(points: Points, normals: Points | Int8s, tile: float) -> tuple[Points, Int8s, Ints]:
    """Sort points (N, 3) and normals (N, 3) by tile; return them, normals as int8, and the tile index (T, 4).

    An index row is (column, row, begin, end): the tile covers ``[column, column + 1) * tile`` in x, likewise in y.
    Normals have a length of at most one, or are int8 already. As int8, a unit normal is off by less than 0.5 degrees.
    """
    scale = 1.0 if normals.dtype == np.int8 else _NORMAL_SCALE
    packed: Int8s = np.rint(normals * np.float32(scale)).astype(np.int8)
    order, cells, begin = by_square(points, tile)
    return points[order], packed[order], np.column_stack([cells, begin[:-1], begin[1:]])


def spans(index: Ints, tile: float, centre: Floats, radius: float) -> Ints:
    """Return begin and end (S, 2) of the points on each tile that meets the square ``centre`` +- ``radius`` metres."""
    low = np.floor((centre[:2] - radius) / tile)
    high = np.floor((centre[:2] + radius) / tile)
    return np.asarray(index[((index[:, :2] >= low) & (index[:, :2] <= high)).all(axis=1), 2:])


def crop(
    points: npt.NDArray[Any], normals: npt.NDArray[Any], index: Ints, tile: float, centre: Floats, radius: float
) -> tuple[Points, Points]:
    """Return points and unit normals (K, 3) float32 within ``radius`` metres (horizontal) of ``centre``."""
    near, stretches, inside = points_near(points, index, tile, centre, radius)
    packed = np.concatenate([np.empty((0, 3), np.int8), *(normals[stretch] for stretch in stretches)])
    return near, unit_normals(packed.compress(inside, axis=0))


def points_near(
    points: npt.NDArray[Any], index: Ints, tile: float, centre: Floats, radius: float
) -> tuple[Points, list[slice], Bools]:
    """Return the points of :func:`crop`, the stretches of its tiles, and the mask of these points in them."""
    stretches = [slice(int(begin), int(end)) for begin, end in spans(index, tile, centre, radius)]
    near = np.concatenate([np.empty((0, 3), np.float32), *(points[stretch] for stretch in stretches)])
    dx, dy = near[:, 0] - np.float64(centre[0]), near[:, 1] - np.float64(centre[1])
    inside = dx * dx + dy * dy < radius * radius
    # compress: indexing rows by a mask takes five times as long
    return near.compress(inside, axis=0), stretches, inside


def cut_points(arrays: Mapping[str, npt.NDArray[Any]], tile: float, cut: kernels.Cut) -> kernels.Crop | None:
    """Cut the points around a place out of a map's arrays, sorted for searching; None if there are none."""
    stretches = spans(arrays["tile_index"], tile, np.array([cut.x, cut.y]), cut.radius)
    return kernels.crop_points(arrays["points"], arrays["normals"], stretches, cut)


def unit_normals(packed: npt.NDArray[Any]) -> Points:
    """Return unit normals (N, 3) for the scaled normals (N, 3) of a map; zero stays zero."""
    normals = packed.astype(np.float32)
    length = np.sqrt(np.einsum("ij,ij->i", normals, normals))
    normals /= np.maximum(length, np.float32(1.0))[:, None]
    return normals
