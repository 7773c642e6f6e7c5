"""Progressive morphological ground filter: the stand-in where the cloth has no wheel."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from coview_stream.basemap.ground_raster import Heights, filled

_LARGEST_WINDOW = 40.0
"""Metres: wider roofs are taken for ground, larger hills survive whole."""

_STEEPEST = 0.3
_FIRST_THRESHOLD = 0.5


def morphological_ground(z: Heights, cell: float) -> npt.NDArray[np.bool_]:
    """Which cells of a raster of lowest heights (H, W; NaN where empty; metres) are ground.

    Openings with growing windows remove what is narrower than the window and stands out of the opened surface
    by more than a slope of 0.3 explains.
    """
    surface = filled(z)
    ground = np.isfinite(z)
    window, previous = 1.0, 0.0
    while window <= _LARGEST_WINDOW:
        size = 2 * max(1, round(window / cell / 2)) + 1
        # separable: a square window costs two passes of one row
        opened = ndimage.grey_opening(surface, size=(size, size), mode="nearest")
        threshold = min(_FIRST_THRESHOLD + _STEEPEST * (window - previous) / 2, 3.0)
        ground &= ~(surface - opened > threshold)
        surface, previous, window = opened, window, window * 1.5
    return ground
