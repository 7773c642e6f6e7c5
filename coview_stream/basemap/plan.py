"""Plan of a map: its points from above, drawn into axes of matplotlib."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from coview_stream.errors import require_library
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.rasters import cells
from coview_stream.geometry.transforms import Points

_DRAWN_POINTS = 2_000_000
_PIXELS = 800  # along the longer side, set by hand as are the others
_DARK, _LIGHT = 0.15, 0.9  # grey of the highest and of the lowest points
_STRAY = 1.0  # per cent of the heights at either end that may be birds or pits


def draw_plan(sampled: Callable[[int], Points], origin: Floats, voxel: float, axes: Any = None) -> Any:
    """Draw a map from above in the frame of its sources, metres, darker where it is higher.

    Args:
        sampled: returns at most so many of the map's points (N, 3).
        origin: (3,) of these points, in the frame of the sources.
        voxel: metres between points.
        axes: of matplotlib, to draw into; None makes a figure of its own.

    Returns:
        The axes.

    Raises:
        DependencyError: matplotlib is missing.
    """
    if axes is None:
        axes = require_library("matplotlib.pyplot", "matplotlib>=3.8", "pictures of maps").figure().add_subplot()
    points = sampled(_DRAWN_POINTS)
    side = float(np.ptp(points[:, :2], axis=0).max())
    # not finer than the pixels, nor than the points lie
    cell = max(side / _PIXELS, 1.5 * voxel)
    corner, (rows, columns), index = cells(points, cell)
    highest = np.full(rows * columns, -np.inf)
    np.maximum.at(highest, index, points[:, 2])
    low, high = np.percentile(points[:, 2], [_STRAY, 100.0 - _STRAY])
    share = np.clip((highest - low) / max(high - low, 1.0), 0.0, 1.0)
    grey = np.where(np.isfinite(highest), _LIGHT - (_LIGHT - _DARK) * share, np.nan)
    left, bottom = (corner + origin[:2]).tolist()
    extent = (left, left + columns * cell, bottom, bottom + rows * cell)
    picture = grey.reshape(rows, columns)
    axes.imshow(picture, cmap="gray", vmin=0.0, vmax=1.0, origin="lower", extent=extent, interpolation="nearest")
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.locator_params(axis="x", nbins=5)  # numbers of UTM are long
    axes.ticklabel_format(useOffset=False, style="plain")
    return axes
