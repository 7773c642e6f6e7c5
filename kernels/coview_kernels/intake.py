"""Frame intake: transform, range filter, voxel de-duplication and polar bins in one pass over a frame."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy.typing as npt

from coview_kernels import check, reference, runtime
from coview_kernels.arrays import F32, F64, PolarGrid
from coview_kernels.polar import PolarBins, tells_apart
from coview_kernels.sieve import Sieve


class Intake(NamedTuple):
    """What :class:`FrameIntake` makes of a frame."""

    points: F32
    """(K, 3) target-frame coordinates, metres: the first point of each voxel, in input order."""
    grid: PolarGrid | None
    """(R, S) bins of ``points`` around the centre; None unless bins were asked for."""
    dropped: int
    """Rows dropped because they, or their images, are NaN or infinite."""


class FrameIntake:
    """Takes in frames, one after the other, in one pass over the points and without allocating.

    A frame goes through :func:`transform_unique` and, if asked for, :func:`polar_bin`, with the same result to the
    bit, in one kernel.

    **The arrays of a result are views of buffers that the next call overwrites: copy what you keep.** Buffers
    grow, by doubling, with a frame that is larger than all before. Without Taichi, and for points more than 32,767
    voxels from the sensor, NumPy serves, with the same result, and allocates.

    An object belongs to one caller at a time; different objects may be used from different threads.

    Args:
        voxel: edge of the voxels in the target frame, metres; zero or negative: keep every point.
        r_min: least range in the source frame that is kept, metres (inclusive).
        r_max: range in the source frame from which on points are dropped, metres (exclusive).
        bins: (R, S, radius in metres) of the polar bins to make, or None.

    Raises:
        ValueError: a number is out of its range.
    """

    def __init__(
        self,
        voxel: float,
        r_min: float = 0.0,
        r_max: float = math.inf,
        bins: tuple[int, int, float] | None = None,
    ) -> None:
        if not (r_min >= 0 and r_max >= 0):
            raise ValueError(f"r_min and r_max must not be negative, got {r_min} and {r_max}")
        if not math.isfinite(voxel):
            raise ValueError(f"voxel must be finite, got {voxel}")
        if bins is not None:
            check.grid_size(*bins)
        self._filter = float(voxel), float(r_min), float(r_max)
        self._bins = bins
        self._polar: PolarBins | None = None
        self._sieve: Sieve | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return what may be copied or sent to another process: all but buffers and prepared launches."""
        return self.__dict__ | {"_sieve": None, "_polar": None}

    def __call__(
        self, points: npt.ArrayLike, T: npt.ArrayLike, centre: npt.ArrayLike | None = None
    ) -> Intake:
        """Take in a frame.

        Args:
            points: (N, 3) source-frame coordinates, metres, float32.
            T: (4, 4) ``T_target_source``.
            centre: (3,) of the bins in the target frame, metres; None: the sensor, ``T[:3, 3]``.

        Raises:
            ValueError: an array has the wrong shape, or ``T`` or ``centre`` is not finite.
        """
        cloud = check.float32("points", points, None, 3)
        pose = check.finite64("T", T, 4, 4)
        middle = pose[:3, 3] if centre is None else check.finite64("centre", centre, 3)
        many = self._bins is not None and not tells_apart(*self._bins[:2])
        native = self._plain if many else self._native
        return runtime.dispatch(native, self._plain, cloud, pose, middle)

    def _plain(self, points: F32, T: F64, centre: F64) -> Intake:
        moved, dropped = reference.transform_unique(points, T, *self._filter)
        grid = reference.polar_bin(moved, centre, *self._bins)[0] if self._bins else None
        return Intake(moved, grid, dropped)

    def _native(self, points: F32, T: F64, centre: F64) -> Intake:
        if self._sieve is None:
            self._polar = PolarBins(*self._bins, chunks=1) if self._bins else None
            self._sieve = Sieve(self._polar)
        taken = self._sieve(points, T, *self._filter, centre)
        if taken is None:
            return self._plain(points, T, centre)
        moved, dropped = taken
        return Intake(moved, self._polar.grid()[0] if self._polar else None, dropped)
