"""A raster of the base map: what virtual reference scans are gathered from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from coview_stream.geometry import Points


@dataclass(frozen=True)
class HeightRaster:
    """Greatest height, number of voxels and sum of voxel heights of square cells.

    Arrays are (H, W): row along y, column along x; cell (r, c) has its centre at
    ``corner + cell * (c + 1/2, r + 1/2)``. Metres in the map frame. Empty cells have count 0.
    """

    top: npt.NDArray[np.float32]
    count: npt.NDArray[np.int32]
    total: npt.NDArray[np.float32]
    corner: npt.NDArray[np.float64]
    cell: float

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.top.shape[0], self.top.shape[1]

    def cells_of(self, xy: npt.NDArray[np.floating]) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """Row and column (M,) of the cells that hold (M, 2) positions."""
        index = np.floor((np.asarray(xy, dtype=np.float64) - self.corner) / self.cell).astype(np.int32)
        return index[:, 1], index[:, 0]


def aligned_corner(points: Points, block: float, cell: float) -> npt.NDArray[np.float64]:
    """Lower left corner (2,) of a raster in which the centres of ``block``-sized grid cells are cell centres.

    Stations stand at ``(k + 1/2) * block``; a half-cell shift lets one offset table serve them all. Needs
    ``block`` to be a multiple of ``cell``.
    """
    lowest = np.floor(points[:, :2].min(axis=0).astype(np.float64) / block) * block
    return np.asarray(lowest + 0.5 * block - cell * (np.ceil(0.5 * block / cell) + 0.5))


def rasterise(
    points: Points,
    corner: npt.NDArray[np.float64],
    cell: float,
    voxel: float,
    margin: int = 0,
    extent: Points | None = None,
) -> HeightRaster:
    """Raster of (N, 3) map-frame points.

    The density of a cell (eq. 3) counts occupied voxels of edge ``voxel``, not points, lest the scan pattern
    decides; ``total`` sums one height for each of those voxels. The raster reaches to the
    farthest of ``extent`` (by default the points) and ``margin`` empty cells beyond.
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
    total = np.bincount(flat[first], weights=points[first, 2], minlength=size)
    top = np.full(size, -np.inf, dtype=np.float32)
    np.maximum.at(top, flat, points[:, 2])
    top[count == 0] = 0.0
    return HeightRaster(
        top.reshape(height, width),
        count.astype(np.int32).reshape(height, width),
        total.astype(np.float32).reshape(height, width),
        corner,
        cell,
    )
