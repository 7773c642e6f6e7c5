"""Bird's-eye view of a cloud, in layers by height above the ground: the networks' input."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_kernels import OverheadGrid
from coview_stream.geometry.arrays import Floats32, Reals
from coview_stream.geometry.rasters import filled
from coview_stream.geometry.transforms import Points

Image = npt.NDArray[np.uint8]
"""(LAYERS, H, W): row along y, column along x."""

CELL = 0.5
"""Edge of an image's cell, metres."""

SLABS = (0.5, 1.0, 2.0, 4.0, 7.0, 11.0, 16.0, 22.0, 40.0)
"""Bounds of the height layers, metres above the ground."""

LAYERS = len(SLABS) + 2
"""One per pair of bounds, then the greatest height, the cells with ground points, and the relief of the ground."""

BIRDS_EYE_VIEW_VERSION = 1
"""To be raised when a cloud's image changes: features are comparable only between equal versions."""

# the networks are trained with these and SLABS: other values need other weights
_LEVEL = 0.25  # metres; a layer counts occupied levels instead of points, which depend on the density of the scan
_GROUND_CELL = 2.0  # metres
_MAX_GROUND_HEIGHT = 0.4  # metres above the ground up to which a point belongs to it
_GROUND_BAND = 0.8  # metres about the first estimate of the ground, whose points refine it
_MAX_SLOPE = 0.7  # metres per metre: steeper surfaces stand on the ground
_REACH = 10  # ground cells to either side that limit a cell's height: half a large building
_RELIEF_SIGMA = 8.0  # metres, of the Gaussian whose mean of the ground is the zero of relief
_MAX_RELIEF = 1.5  # metres at which the layer saturates
_BOUNDS = SLABS[0], SLABS[-1], _MAX_GROUND_HEIGHT


def birds_eye_view(points: Points, corner: Reals, shape: tuple[int, int]) -> Image:
    """Draw a gravity-aligned cloud from above.

    Args:
        points: (N, 3) metres; those outside the image are ignored.
        corner: (2,) x and y of the lower corner of cell (0, 0), metres.
        shape: rows and columns of the image, each a multiple of four cells (two metres).

    Returns:
        (LAYERS, H, W). A height layer has 255 times the square root of the occupied share of its 0.25 m levels. Three
        layers follow: the greatest height, 255 at the last bound; 255 at cells with ground points; and the height of
        the ground above the mean of its surroundings, 128 for zero or unknown.
    """
    height, width = shape
    cloud = np.ascontiguousarray(points, dtype=np.float32)
    ratio = round(_GROUND_CELL / CELL)
    x, y = (float(coordinate) for coordinate in corner)
    lowest = kernels.lowest_heights(cloud, OverheadGrid(x, y, _GROUND_CELL, (height // ratio, width // ratio)))
    if not np.isfinite(lowest).any():
        nothing = np.zeros((LAYERS, height, width), dtype=np.uint8)
        nothing[-1] = 128
        return nothing
    ground, relief = _ground(cloud, OverheadGrid(x, y, _GROUND_CELL, lowest.shape), lowest)
    image = np.zeros((LAYERS, height * width), dtype=np.float32)
    grid = OverheadGrid(x, y, CELL, shape)
    occupied, top, on_ground = kernels.height_columns(cloud, grid, ground, ratio, _LEVEL, _BOUNDS)
    for k, (low, high) in enumerate(pairwise(SLABS)):
        slab = occupied[int(low / _LEVEL) : int(high / _LEVEL)]  # no more than 255 levels
        image[k] = 255.0 * np.sqrt(slab.sum(axis=0, dtype=np.uint8) * np.float32(1.0 / len(slab)))
    image[-3] = top * (255.0 / SLABS[-1])
    image[-2] = on_ground * np.float32(255.0)
    image[-1] = np.clip(128.0 + _enlarged(relief, ratio) * (127.0 / _MAX_RELIEF), 1.0, 255.0)
    return image.astype(np.uint8).reshape(LAYERS, height, width)


def _ground(points: Points, grid: OverheadGrid, lowest: Floats32) -> tuple[Floats32, Floats32]:
    """Estimate the height of the ground (h, w) by coarse cells, and its relief, 0 for cells without ground points.

    ``lowest`` (h, w) is the lowest height of each cell, inf for none.
    """
    from scipy import ndimage  # takes a quarter of a second, and most users of a map draw no images

    occupied = np.isfinite(lowest)
    # the ground is no steeper than _MAX_SLOPE: under a roof the ground beside the building limits its height
    offsets = np.arange(-_REACH, _REACH + 1) * _GROUND_CELL
    cone = -_MAX_SLOPE * np.hypot(offsets[:, None], offsets[None])
    eroded = ndimage.grey_erosion(lowest, structure=cone, mode="constant", cval=np.inf)
    ground = filled(np.where(np.isfinite(eroded), eroded, np.nan).astype(np.float32))
    ground = ndimage.median_filter(ground, 3)
    # the lowest point of a sloping cell is below its middle: the mean of the points near the ground corrects that
    count, total = kernels.offsets_near(points, grid, ground, _GROUND_BAND)
    ground = ndimage.gaussian_filter((ground + total / np.maximum(count, 1)).astype(np.float32), 0.5)
    level = occupied & (count > 0)
    weight = ndimage.gaussian_filter(level.astype(np.float32), _RELIEF_SIGMA / _GROUND_CELL)
    mean = ndimage.gaussian_filter(np.where(level, ground, 0.0), _RELIEF_SIGMA / _GROUND_CELL) / np.maximum(
        weight, 1e-3
    )
    return ground, np.where(level & (weight > 1e-2), ground - mean, 0.0).astype(np.float32)


def _enlarged(values: Floats32, ratio: int) -> Floats32:
    """Interpolate an image (h, w) bilinearly in cells smaller by ``ratio``, row by row."""
    from scipy import ndimage

    u, v = ((np.arange(n * ratio) + 0.5) / ratio - 0.5 for n in values.shape[::-1])
    at = np.stack([np.repeat(v, len(u)), np.tile(u, len(v))])
    return np.asarray(ndimage.map_coordinates(values, at, order=1, mode="nearest", output=np.float32))
