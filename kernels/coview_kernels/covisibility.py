"""Eqs 1-4: which bins are visible from the ground, from above, and the co-view descriptor.

``visible`` runs in NumPy on every backend, and so does ``coview`` of a few grids, as a keyframe has them: handing
them to a kernel takes longer than they do.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_kernels import check, reference, runtime
from coview_kernels.arrays import F32, I32, Mask, Mode, Vertical
from coview_kernels.launch import Launch

_LEAST_BINS = 10_000  # for a kernel to be quicker: 8 grids of 20 x 60 (measured)


def visible(max_height: npt.ArrayLike, count: npt.ArrayLike, mode: Mode, eye: float = 1.5) -> Mask:
    """Eq. 2: bins that no nearer bin of the same sector hides. A bin is occupied where its count is positive.

    From the centre outwards, rings i = 1..R, the first occupied bin of a sector is visible and becomes the
    horizon; an occupied bin above the horizon is visible and becomes the next horizon.

    * ``paper``: above means h > i * h_vis / i_vis, strictly. Heights must be measured from the viewpoint.
    * ``eye``: line of sight from ``eye`` metres: slope (h - eye) / (i - 1/2) > that of the horizon.
    * ``off``: every occupied bin is visible.

    Args:
        max_height: (..., R, S) float32 greatest height above the centre, metres; ignored in empty bins.
        count: (..., R, S) int32 points.
        mode: ``paper``, ``eye`` or ``off``.
        eye: height of the eye above the centre, metres; mode ``eye`` only. Rounded to float32.

    Returns:
        (..., R, S) bool.

    Raises:
        ValueError: shapes disagree, there are fewer than two axes, the mode is unknown or ``eye`` is not
            finite.
    """
    height, points = _grids(max_height, count)
    check.visibility("max", mode, eye)
    return reference.visible(height, points, mode, eye)


def coview(
    max_height: npt.ArrayLike,
    sum_height: npt.ArrayLike,
    count: npt.ArrayLike,
    vertical: Vertical = "max",
    mode: Mode = "paper",
    eye: float = 1.5,
) -> F32:
    """Eqs 1-4: the co-view context, one height per bin that both a ground robot and an airborne scanner see.

    Our reading of the paper: a bin is *horizontally* visible by :func:`visible`. It is *vertically* visible
    (seen from above) if it is occupied and its density d_ij, the count, is at least the mean count over all R
    x S bins, empty ones included (eqs 3-4): dense bins hold vertical structure, which both views share. A
    horizontally visible bin has its greatest height as value; a bin that is only vertically visible has its
    greatest height (``vertical="max"``), its mean height (``"mean"``, the letter of eq. 4) or nothing
    (``"off"``); others have 0.

    Args:
        max_height: (..., R, S) float32, metres above the viewpoint (or the ground below it).
        sum_height: (..., R, S) float32, metres.
        count: (..., R, S) int32, of voxels rather than of raw points, lest the scan pattern decides.
        vertical: value of bins that are visible from above only: ``max``, ``mean`` or ``off``.
        mode: horizontal visibility, see :func:`visible`.
        eye: see :func:`visible`.

    Returns:
        (..., R, S) float32, metres.

    Raises:
        ValueError: shapes disagree, an option is unknown or ``eye`` is not finite.
    """
    height, points = _grids(max_height, count)
    total = np.ascontiguousarray(sum_height, dtype=np.float32)
    check.same_shape("sum_height", total, "max_height", height.shape)
    check.visibility(vertical, mode, eye)
    if points.size < _LEAST_BINS:
        return reference.coview(height, total, points, vertical, mode, eye)
    return runtime.dispatch(_coview, reference.coview, height, total, points, vertical, mode, eye)


def _coview(max_height: F32, sum_height: F32, count: I32, vertical: Vertical, mode: Mode, eye: float) -> F32:
    value = np.empty_like(max_height)
    rings, sectors = max_height.shape[-2:]
    grids = math.prod(max_height.shape[:-2])
    Launch(
        *("covisibility", "coview", grids, min(runtime.workers(), max(1, grids)), rings, sectors),
        *encoded(vertical, mode, eye),
        *(a.reshape(-1) for a in (max_height, sum_height, count, value)),
    )()
    return value


def encoded(vertical: Vertical, mode: Mode, eye: float) -> tuple[int, int, int, float]:
    """How the kernels are told: vertical, hide, and the scale and eye of the slopes, see the reference."""
    scale, zero = (2, float(np.float32(eye))) if mode == "eye" else (1, 0.0)
    return ("off", "max", "mean").index(vertical), int(mode != "off"), scale, zero


def _grids(max_height: npt.ArrayLike, count: npt.ArrayLike) -> tuple[F32, I32]:
    height: npt.NDArray[Any] = np.ascontiguousarray(max_height, dtype=np.float32)
    points: npt.NDArray[Any] = np.ascontiguousarray(count, dtype=np.int32)
    if np.ndim(max_height) < 2:
        raise ValueError(f"max_height has shape {np.shape(max_height)}, expected (..., rings, sectors)")
    check.same_shape("count", points, "max_height", height.shape)
    return height, points
