"""Co-view descriptor (eqs 1-4): the bins that are visible from the ground and from above.

A few grids, as a keyframe has them, are described in NumPy on every backend: a launch takes longer.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_kernels import reference, runtime
from coview_kernels.arrays import F32, I32, VERTICALS, Vertical, check_same_shape
from coview_kernels.launch import Launch
from coview_kernels.warm_up import compiled_by

_MIN_BINS = 10_000  # for a kernel to be quicker: 8 grids of 20 x 60 (measured)


def coview(max_height: npt.ArrayLike, count: npt.ArrayLike, vertical: Vertical = "max") -> F32:
    """Eqs 1-4: the co-view context, one height per bin that both a ground robot and an airborne scanner see.

    A bin is occupied where its count is positive. It is *horizontally* visible (eq. 2) if no nearer bin of its sector
    hides it: from the centre outwards, rings i = 1..R, the first occupied bin of a sector is visible and becomes the
    horizon; an occupied bin above the horizon, h > i * h_vis / i_vis, is visible and becomes the next horizon.

    Our reading of the paper: a bin is *vertically* visible (seen from above) if it is occupied and its density d_ij,
    the count, is at least the mean count over all R x S bins, empty ones included (eqs 3-4): dense bins hold vertical
    structure, which both views share. A visible bin has its greatest height as value (the paper takes the mean height
    of bins that are only vertically visible); others have 0. With ``vertical="off"`` so have bins that are only
    vertically visible.

    Args:
        max_height: (..., R, S) float32, metres above the viewpoint (or the ground below it); ignored in empty bins.
        count: (..., R, S) int32, of voxels: counts of raw points depend on the scan pattern.
        vertical: value of bins that are visible from above only: ``max``, their greatest height, or ``off``, 0.

    Returns:
        (..., R, S) float32, metres.

    Raises:
        ValueError: shapes disagree, there are fewer than two axes, or ``vertical`` is unknown.
    """
    height: npt.NDArray[Any] = np.ascontiguousarray(max_height, dtype=np.float32)
    points: npt.NDArray[Any] = np.ascontiguousarray(count, dtype=np.int32)
    if np.ndim(max_height) < 2:
        raise ValueError(f"max_height has shape {np.shape(max_height)}, expected (..., rings, sectors)")
    check_same_shape("count", points, "max_height", height.shape)
    if vertical not in VERTICALS:
        raise ValueError(f"vertical must be one of {', '.join(VERTICALS)}, got {vertical!r}")
    if points.size < _MIN_BINS:
        return reference.coview(height, points, vertical)
    return runtime.dispatch(_coview, reference.coview, height, points, vertical)


def _coview(max_height: F32, count: I32, vertical: Vertical) -> F32:
    value = np.empty_like(max_height)
    rings, sectors = max_height.shape[-2:]
    grids = math.prod(max_height.shape[:-2])
    Launch(
        *("covisibility", "coview", grids, min(runtime.workers(), max(1, grids)), rings, sectors),
        VERTICALS.index(vertical),
        *(a.reshape(-1) for a in (max_height, count, value)),
    )()
    return value


compiled_by("coview", lambda: coview(*np.ones((2, 100, 20, 60))))
