"""Rasters: points by cell, window minima and maxima, and filled gaps.

SciPy has such filters too, but its import takes a quarter of a second of a node's start. So only :func:`filled`, which
builds maps, imports it when called.
"""

from __future__ import annotations

import numpy as np

from coview_stream.errors import ConfigError
from coview_stream.geometry.arrays import Floats, Floats32, Indices, Ints, Reals
from coview_stream.geometry.transforms import Points

_MAX_CELLS = 200_000_000  # set by hand: a larger raster (0.8 GB) means stray coordinates, not a map


def min_filter(raster: Floats32, size: int) -> Floats32:
    """Return the minimum around each cell of (H, W), in a square of ``size`` cells, an odd number."""
    return -max_filter(-raster, size)


def max_filter(raster: Floats32, size: int) -> Floats32:
    """Return the maximum around each cell of (H, W), in a square of ``size`` cells, an odd number.

    It filters one axis after the other: the maximum of a square is the maximum of its rows' maxima.
    """
    if size < 1 or size % 2 == 0:
        raise ValueError(f"size must be odd, so that a window has a middle, got {size}")
    out = raster.astype(np.float32, copy=False)
    for axis in range(2):
        reach = [(0, 0), (0, 0)]
        reach[axis] = (size // 2, size // 2)
        padded = np.pad(out, reach, constant_values=-np.inf)
        length = raster.shape[axis]
        views = [padded[k : k + length] if axis == 0 else padded[:, k : k + length] for k in range(size)]
        out = views[0].copy()
        for view in views[1:]:
            np.maximum(out, view, out=out)
    return out


def cells(points: Points, cell: float) -> tuple[Floats, tuple[int, int], Ints]:
    """Assign points to square cells of ``cell`` metres.

    Returns:
        The lower corner (2,) in metres, the shape (rows, columns), and the flat cell index (N,) of each point.

    Raises:
        ConfigError: the raster is too large for a map.
    """
    corner = np.floor(points[:, :2].min(axis=0).astype(np.float64) / cell) * cell
    index = [np.floor((points[:, axis] - corner[axis]) / cell).astype(np.int64) for axis in (0, 1)]
    width, height = int(index[0].max()) + 1, int(index[1].max()) + 1
    if width * height > _MAX_CELLS:
        raise ConfigError(
            f"a raster of {width} x {height} cells of {cell} m: remove stray points or raise the cell size"
        )
    return corner, (height, width), index[1] * width + index[0]


def by_square(points: Reals, edge: float) -> tuple[Ints, Ints, Ints]:
    """Sort points (N, 2 or more) into squares with edge ``edge``, by column and row.

    Returns:
        order: (N,) indices of the points, square by square.
        squares: (T, 2) column and row: a square covers ``[column, column + 1) * edge`` in x, likewise in y.
        begin: (T + 1,) index in ``order`` at which the points of each square begin; last, the number of all points.
    """
    cells = np.floor(points[:, :2].astype(np.float64) / edge).astype(np.int64)
    order = np.lexsort((cells[:, 1], cells[:, 0]))
    cells = cells[order]
    begin = np.flatnonzero(np.append(len(cells) > 0, (np.diff(cells, axis=0) != 0).any(axis=1)))
    return order, cells[begin], np.append(begin, len(cells))


def lowest_per_cell(points: Points, flat: Ints) -> Indices:
    """Return the index of the lowest point of each occupied cell, in the order of the cells."""
    order = np.lexsort((points[:, 2], flat))
    ordered = flat[order]
    return np.asarray(order[np.append(True, ordered[1:] != ordered[:-1])])


def filled(z: Floats32) -> Floats32:
    """Return ``z`` (H, W) with every NaN filled from ever coarser averages of its surroundings (push-pull)."""
    unknown = np.isnan(z)
    if not unknown.any() or unknown.all():
        return z
    height, width = z.shape
    padded = np.pad(z, ((0, height % 2), (0, width % 2)), constant_values=np.nan)
    blocks = padded.reshape(padded.shape[0] // 2, 2, padded.shape[1] // 2, 2)
    count = np.isfinite(blocks).sum(axis=(1, 3))
    coarse = np.full(count.shape, np.nan, dtype=np.float32)
    np.divide(np.nansum(blocks, axis=(1, 3)), count, out=coarse, where=count > 0)
    from scipy import ndimage

    coarse = filled(coarse)
    rows = (np.arange(height) + 0.5) / 2 - 0.5
    columns = (np.arange(width) + 0.5) / 2 - 0.5
    grid = np.meshgrid(rows, columns, indexing="ij", sparse=False)
    smooth = ndimage.map_coordinates(coarse, grid, order=1, mode="nearest", output=np.float32)
    return np.where(unknown, smooth, z).astype(np.float32)


_SAMPLE = 100_000  # values sampled for a bound


def argsmallest(values: Floats32, count: int) -> Ints:
    """Return the indices of the ``count`` smallest values of (N,), smallest first; equal ones by index."""
    if count >= len(values):
        return np.asarray(np.argsort(values, kind="stable"))
    # a bound from a sample rules out most; if it leaves fewer than ``count``, all are sorted
    every = max(1, len(values) // _SAMPLE)
    sample = values[::every]
    rank = min(2 * count // every, len(sample) - 1)
    found = np.flatnonzero(values <= np.partition(sample, rank)[rank])
    if len(found) < count:
        found = np.arange(len(values))
    near = values[found]
    bound = np.partition(near, count - 1)[count - 1]
    found = found[near <= bound]
    return np.asarray(found[np.argsort(values[found], kind="stable")[:count]])
