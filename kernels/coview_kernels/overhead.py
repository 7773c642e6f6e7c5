"""Clouds seen from above: lowest points, ground, and columns of cells, with one pass over the points each."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from coview_kernels import reference, runtime
from coview_kernels.arrays import F32, F64, I64, U8, OverheadGrid, as_float32
from coview_kernels.launch import Launch
from coview_kernels.warm_up import SAMPLE, compiled_by


def lowest_heights(points: npt.ArrayLike, grid: OverheadGrid) -> F32:
    """Return the lowest height (H, W) of the points (N, 3) in each cell, metres; inf in empty cells."""
    return runtime.dispatch(_lowest, reference.lowest_heights, as_float32("points", points, None, 3), grid)


def offsets_near(points: npt.ArrayLike, grid: OverheadGrid, level: F32, band: float) -> tuple[I64, F64]:
    """Count the points (N, 3) less than ``band`` metres from the level (H, W) of their cell.

    Returns the counts (H, W), and the sums (H, W) of these points' heights above the level, metres.
    """
    cloud, levels = as_float32("points", points, None, 3), as_float32("level", level, *grid.shape)
    return runtime.dispatch(_near, reference.offsets_near, cloud, grid, levels, band)


def height_columns(
    points: npt.ArrayLike, grid: OverheadGrid, ground: F32, ratio: int, step: float, bounds: tuple[float, float, float]
) -> tuple[U8, F32, U8]:
    """Sort the points (N, 3) into levels above the ground, cell by cell.

    Args:
        points: (N, 3) float32, metres.
        grid: the cells.
        ground: (h, w) ground height in cells ``ratio`` times as large, metres; bilinear between their centres.
        ratio: cells of the grid along the edge of a ground cell.
        step: height of a level, metres.
        bounds: lowest and highest height of the levels, and the height below which a point belongs to the ground.

    Returns:
        (levels, H * W) uint8, 1 for an occupied level of a cell, from height 0 on; (H * W) greatest height in
        [0, highest], metres; (H * W) uint8, 1 where ground was observed.

    Raises:
        ValueError: an array has a wrong shape or no cells, or the highest height is not a whole number of levels.
    """
    cloud = as_float32("points", points, None, 3)
    level = as_float32("ground", ground, *(n // ratio for n in grid.shape))
    levels = bounds[1] / step
    if not level.size or bounds[0] < 0 or abs(levels - round(levels)) > 1e-6:
        raise ValueError(f"ground of {level.shape} cells and levels of {step} m from {bounds[0]} to {bounds[1]} m")
    return runtime.dispatch(_columns, reference.height_columns, cloud, grid, level, ratio, step, bounds)


def _frame(grid: OverheadGrid, *more: float) -> F32:
    return np.array([grid.x, grid.y, 1.0 / grid.cell, *more], dtype=np.float32)


def _lowest(points: F32, grid: OverheadGrid) -> F32:
    out = np.full(grid.shape, np.inf, dtype=np.float32)
    Launch("overhead", "lowest", points.reshape(-1), _frame(grid), *grid.shape, out.reshape(-1))()
    return out


def _near(points: F32, grid: OverheadGrid, level: F32, band: float) -> tuple[I64, F64]:
    count, total = np.zeros(grid.shape, dtype=np.int64), np.zeros(grid.shape, dtype=np.float64)
    given = points.reshape(-1), _frame(grid), *grid.shape, level.reshape(-1), float(band)
    Launch("overhead", "near", *given, count.reshape(-1), total.reshape(-1))()
    return count, total


def _columns(
    points: F32, grid: OverheadGrid, ground: F32, ratio: int, step: float, bounds: tuple[float, float, float]
) -> tuple[U8, F32, U8]:
    size = grid.shape[0] * grid.shape[1]
    occupied = np.zeros((round(bounds[1] / step), size), dtype=np.uint8)
    top, seen = np.zeros(size, dtype=np.float32), np.zeros(size, dtype=np.uint8)
    frame = _frame(grid, 1.0 / (grid.cell * ratio), 1.0 / step, *bounds)
    given = points.reshape(-1), frame, *grid.shape, ground.reshape(-1), ground.shape[1]
    Launch("overhead", "columns_of", *given, occupied.reshape(-1), top, seen)()
    return occupied, top, seen


def _compile() -> None:
    grid, ground = OverheadGrid(0.0, 0.0, 1.0, (2, 2)), np.zeros((2, 2), dtype=np.float32)
    lowest_heights(SAMPLE, grid)
    offsets_near(SAMPLE, grid, ground, 1.0)
    height_columns(SAMPLE, grid, ground, 1, 1.0, (0.0, 2.0, 1.0))


compiled_by("height_columns", _compile)
