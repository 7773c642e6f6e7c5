"""Co-view descriptors (eqs 1-4), ours and the paper's: the bins that are visible from the ground and from above.

NumPy describes few grids, such as a keyframe's, on every backend, because a launch takes longer.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_kernels import reference, runtime
from coview_kernels.arrays import F32, I32, check_same_shape
from coview_kernels.launch import Launch
from coview_kernels.warm_up import compiled_by

_MIN_BINS = 10_000  # from which a kernel is faster, 8 grids of 20 x 60 (measured)
_NOT_READ: F32 = np.zeros(1, dtype=np.float32)


def paper_context(max_height: npt.ArrayLike, count: npt.ArrayLike, mean_height: npt.ArrayLike) -> F32:
    """Return the paper's co-view context, eqs 1-4 as printed.

    A bin is occupied if its count is positive. It is *horizontally* co-visible (eqs 1 and 2) if no nearer bin of its
    sector hides it: from the centre outwards, rings i = 1..R, the first occupied bin of a sector is visible and becomes
    the horizon; an occupied bin at or above the horizon, h >= i * h_vis / i_vis, is visible and becomes the next. It is
    *vertically* co-visible (eq. 3) if it is occupied and its density, the count, is at least the mean count over all
    R x S bins including empty ones. By eq. 4 a bin has

    * its greatest height if it is horizontally but not vertically co-visible;
    * its mean height if it is both;
    * 0 otherwise.

    Args:
        max_height: (..., R, S) float32, metres above the viewpoint (or the ground below it); ignored in empty bins.
        count: (..., R, S) int32, of points.
        mean_height: (..., R, S) float32, like ``max_height``.

    Returns:
        (..., R, S) float32, metres.

    Raises:
        ValueError: shapes disagree, or there are fewer than two axes.
    """
    height, points = _checked(max_height, count)
    mean: npt.NDArray[Any] = np.ascontiguousarray(mean_height, dtype=np.float32)
    check_same_shape("mean_height", mean, "max_height", height.shape)
    return _described(True, reference.paper_context, height, points, mean)


def coview(max_height: npt.ArrayLike, count: npt.ArrayLike) -> F32:
    """Return our co-view context: bins that are visible from the ground *or* dense, with their greatest heights.

    Unlike :func:`paper_context` it keeps dense bins behind a wall, has no means, and leaves out bins on the line of
    sight itself, such as flat ground.

    Args:
        max_height: (..., R, S) float32, metres above the viewpoint (or the ground below it); ignored in empty bins.
        count: (..., R, S) int32 of voxels, as counts of raw points depend on the scan pattern.

    Returns:
        (..., R, S) float32, metres.

    Raises:
        ValueError: shapes disagree, or there are fewer than two axes.
    """
    height, points = _checked(max_height, count)
    return _described(False, lambda height, points, _: reference.coview(height, points), height, points, _NOT_READ)


def _checked(max_height: npt.ArrayLike, count: npt.ArrayLike) -> tuple[F32, I32]:
    height: npt.NDArray[Any] = np.ascontiguousarray(max_height, dtype=np.float32)
    points: npt.NDArray[Any] = np.ascontiguousarray(count, dtype=np.int32)
    if np.ndim(max_height) < 2:
        raise ValueError(f"max_height has shape {np.shape(max_height)}, expected (..., rings, sectors)")
    check_same_shape("count", points, "max_height", height.shape)
    return height, points


def _described(paper: bool, plain: Callable[[F32, I32, F32], F32], height: F32, count: I32, mean: F32) -> F32:
    """Describe grids by our rule or the paper's, in NumPy if they are few."""
    if count.size < _MIN_BINS:
        return plain(height, count, mean)

    def kernel(height: F32, count: I32, mean: F32) -> F32:
        value = np.empty_like(height)
        rings, sectors = height.shape[-2:]
        grids = math.prod(height.shape[:-2])
        Launch(
            *("covisibility", "coview", grids, min(runtime.workers(), max(1, grids)), rings, sectors),
            int(paper),
            *(a.reshape(-1) for a in (height, count, mean, value)),
        )()
        return value

    return runtime.dispatch(kernel, plain, height, count, mean)


compiled_by("coview", lambda: coview(*np.ones((2, 100, 20, 60))))
