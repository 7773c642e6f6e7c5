"""Greatest or smallest value in a square window around each cell of a raster.

SciPy's filters do the same; importing them takes a quarter of a second, which a node that starts does not have.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Raster = npt.NDArray[np.float32]


def lowest_around(raster: Raster, size: int) -> Raster:
    """Smallest value of each cell of (H, W) and those around it, in a square of ``size`` cells, an odd number."""
    return _sliding(np.minimum, raster, size, np.float32(np.inf))


def highest_around(raster: Raster, size: int) -> Raster:
    """Greatest value of each cell of (H, W) and those around it, in a square of ``size`` cells, an odd number."""
    return _sliding(np.maximum, raster, size, np.float32(-np.inf))


def _sliding(pick: np.ufunc, raster: Raster, size: int, nothing: np.float32) -> Raster:
    """One axis after the other: the extreme of a square is that of its rows' extremes."""
    if size < 1 or size % 2 == 0:
        raise ValueError(f"size must be odd, so that a window has a middle, got {size}")
    out = raster.astype(np.float32, copy=False)
    for axis in range(2):
        reach = [(0, 0), (0, 0)]
        reach[axis] = (size // 2, size // 2)
        padded = np.pad(out, reach, constant_values=nothing)
        length = raster.shape[axis]
        views = [padded[k : k + length] if axis == 0 else padded[:, k : k + length] for k in range(size)]
        out = views[0].copy()
        for view in views[1:]:
            pick(out, view, out=out)
    return out
