"""Rigid transform with voxel de-duplication."""

from __future__ import annotations

import math

import numpy.typing as npt

from coview_kernels import check, reference, runtime
from coview_kernels.arrays import F32, F64
from coview_kernels.sieve import Sieve

_MOST_BYTES = 1 << 23  # of table and results that stay from call to call
_sieve: Sieve | None = None  # used on the owner thread only


def transform_unique(
    points: npt.ArrayLike,
    T: npt.ArrayLike,
    voxel: float,
    r_min: float = 0.0,
    r_max: float = math.inf,
) -> tuple[F32, int]:
    """Move a cloud into another frame and keep the first point of each voxel there.

    Args:
        points: (N, 3) source-frame coordinates, metres, float32. Near their own origin: see DESIGN on UTM.
        T: (4, 4) ``T_target_source``; the product is formed in float64 and rounded to float32 once.
        voxel: edge of the voxels in the target frame, metres; a point lies in voxel ``floor(p * (1 /
            voxel))``. Zero or negative: keep every point.
        r_min: least range in the source frame that is kept, metres (inclusive).
        r_max: range in the source frame from which on points are dropped, metres (exclusive).

    Returns:
        (K, 3) float32 target-frame coordinates, in input order, and the number of rows dropped because they,
        or their images, are NaN or infinite.

    Raises:
        ValueError: an array has the wrong shape, ``T`` is not finite, or a range is negative or NaN.
    """
    cloud = check.float32("points", points, None, 3)
    pose = check.finite64("T", T, 4, 4)
    if not (r_min >= 0 and r_max >= 0):
        raise ValueError(f"r_min and r_max must not be negative, got {r_min} and {r_max}")
    if not math.isfinite(voxel):
        raise ValueError(f"voxel must be finite, got {voxel}")
    return runtime.dispatch(
        _transform_unique, reference.transform_unique, cloud, pose, float(voxel), float(r_min), float(r_max)
    )


def _transform_unique(points: F32, T: F64, voxel: float, r_min: float, r_max: float) -> tuple[F32, int]:
    global _sieve
    sieve, _sieve = _sieve or Sieve(), None
    taken = sieve(points, T, voxel, r_min, r_max)
    if sieve.nbytes <= _MOST_BYTES:
        _sieve = sieve
    if taken is None:
        return reference.transform_unique(points, T, voxel, r_min, r_max)
    moved, dropped = taken
    return moved.copy(), dropped
