"""A raster of ground heights, and the raster tools that the ground filter needs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from coview_stream.errors import ConfigError
from coview_stream.geometry import Points

Heights = npt.NDArray[np.float32]

_MAX_CELLS = 200_000_000
"""A raster above this many cells (0.8 GB) means stray coordinates, not a map."""


@dataclass(frozen=True)
class GroundRaster:
    """Ground heights of square cells in the frame of the points, metres.

    Attributes:
        z: (H, W) float32, row along y and column along x; NaN where the ground is unknown.
        x0: x of the lower corner of cell (0, 0).
        y0: y of the lower corner of cell (0, 0).
        cell: edge length.
    """

    z: Heights
    x0: float
    y0: float
    cell: float

    def height_at(self, xy: npt.NDArray[np.floating]) -> Heights:
        """Ground height (N,) at (N, 2) positions; NaN in unknown cells and outside.

        Bilinear between cell centres; unknown neighbours carry no weight.
        """
        height, width = self.z.shape
        column = (xy[:, 0].astype(np.float64) - self.x0) / self.cell
        row = (xy[:, 1].astype(np.float64) - self.y0) / self.cell
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        column, row = np.where(inside, column, 0.0), np.where(inside, row, 0.0)
        known = inside & np.isfinite(self.z[row.astype(np.intp), column.astype(np.intp)])
        left, low = np.floor(column - 0.5).astype(np.intp), np.floor(row - 0.5).astype(np.intp)
        total, weight = np.zeros(len(xy)), np.zeros(len(xy))
        for dr, dc in ((0, 0), (0, 1), (1, 0), (1, 1)):
            r, c = np.clip(low + dr, 0, height - 1), np.clip(left + dc, 0, width - 1)
            w = (1 - np.abs(row - 0.5 - (low + dr))) * (1 - np.abs(column - 0.5 - (left + dc)))
            z = self.z[r, c].astype(np.float64)
            usable = np.isfinite(z)
            total += np.where(usable, w * z, 0.0)
            weight += np.where(usable, w, 0.0)
        out = np.full(len(xy), np.nan, dtype=np.float32)
        np.divide(total, weight, out=out, where=known & (weight > 0), casting="unsafe")
        return out


def cells(
    points: Points, cell: float
) -> tuple[npt.NDArray[np.float64], tuple[int, int], npt.NDArray[np.int64]]:
    """Lower corner (2,), shape (rows, columns) and the flat cell index (N,) of each point.

    Raises:
        ConfigError: the raster would be absurdly large for a map.
    """
    corner = np.floor(points[:, :2].min(axis=0).astype(np.float64) / cell) * cell
    index = [np.floor((points[:, axis] - corner[axis]) / cell).astype(np.int64) for axis in (0, 1)]
    width, height = int(index[0].max()) + 1, int(index[1].max()) + 1
    if width * height > _MAX_CELLS:
        raise ConfigError(
            f"a raster of {width} x {height} cells of {cell} m: remove stray points or raise the cell size"
        )
    return corner, (height, width), index[1] * width + index[0]


def lowest_per_cell(points: Points, flat: npt.NDArray[np.int64]) -> npt.NDArray[np.intp]:
    """Index of the lowest point of each occupied cell, in the order of the cells."""
    order = np.lexsort((points[:, 2], flat))
    ordered = flat[order]
    return np.asarray(order[np.append(True, ordered[1:] != ordered[:-1])])


def filled(z: Heights) -> Heights:
    """``z`` (H, W) with every NaN filled from ever coarser averages of its surroundings (push-pull)."""
    unknown = np.isnan(z)
    if not unknown.any() or unknown.all():
        return z
    height, width = z.shape
    padded = np.pad(z, ((0, height % 2), (0, width % 2)), constant_values=np.nan)
    blocks = padded.reshape(padded.shape[0] // 2, 2, padded.shape[1] // 2, 2)
    count = np.isfinite(blocks).sum(axis=(1, 3))
    coarse = np.full(count.shape, np.nan, dtype=np.float32)
    np.divide(np.nansum(blocks, axis=(1, 3)), count, out=coarse, where=count > 0)
    coarse = filled(coarse)
    rows = (np.arange(height) + 0.5) / 2 - 0.5
    columns = (np.arange(width) + 0.5) / 2 - 0.5
    grid = np.meshgrid(rows, columns, indexing="ij", sparse=False)
    smooth = ndimage.map_coordinates(coarse, grid, order=1, mode="nearest", output=np.float32)
    return np.where(unknown, smooth, z).astype(np.float32)
