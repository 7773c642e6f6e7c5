"""Frame intake: transform, range filter, voxel de-duplication and polar bins in one pass over a frame."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from coview_kernels import check, reference, runtime
from coview_kernels.arrays import F32, F64, PolarGrid
from coview_kernels.launch import Launch
from coview_kernels.polar import MAX_SECTORS, PolarBins

_HUGE = 1e300  # stands for no limit: a compiler may assume that there is no infinity
_GENERATIONS = 1 << 15  # fit into a key beside its voxel
_MAX_CHUNKS = 4  # a voxel is looked up in the tables of all earlier chunks
_ROWS_PER_CHUNK = 4096  # fewer are done before another thread is awake
_LEAST_BITS = 10  # of a hash table; doubled until no frame fills more than half of it
_FIRST_ROWS = 4096
_POINTS, _ROWS, _CHUNKS, _GENERATION = range(4)  # of the arguments, those that change from frame to frame


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
    grow, by doubling, with a frame that is larger than all before; the hash table is never cleared, its entries
    carry the number of their frame. Without Taichi, and for points more than 32,767 voxels from the sensor, NumPy
    serves, with the same result, and allocates.

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
        self._buffers: _Buffers | None = None

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
        many = self._bins is not None and self._bins[1] > MAX_SECTORS
        native = self._plain if many else self._native
        return runtime.dispatch(native, self._plain, cloud, pose, middle)

    def _plain(self, points: F32, T: F64, centre: F64) -> Intake:
        moved, dropped = reference.transform_unique(points, T, *self._filter)
        grid = reference.polar_bin(moved, centre, *self._bins)[0] if self._bins else None
        return Intake(moved, grid, dropped)

    def _native(self, points: F32, T: F64, centre: F64) -> Intake:
        buffers = self._buffers or _Buffers(_FIRST_ROWS, _LEAST_BITS, self._filter, self._bins)
        if len(points) > buffers.rows:
            rows = 1 << (len(points) - 1).bit_length()
            buffers = _Buffers(rows, buffers.bits, self._filter, self._bins)
        while True:
            self._buffers = buffers
            kept, infinite, far, full = buffers.run(points, T, centre)
            if far:
                return self._plain(points, T, centre)
            if not full:
                grid = None if self._bins is None else buffers.polar.grid
                return Intake(buffers.moved[:kept], grid, infinite)
            buffers = _Buffers(buffers.rows, buffers.bits + 1, self._filter, self._bins)


class _Buffers:
    """The arrays of one size, and the launch over them; for the owner thread only."""

    def __init__(
        self, rows: int, bits: int, limits: tuple[float, float, float], bins: tuple[int, int, float] | None
    ) -> None:
        voxel, r_min, r_max = limits
        self.rows, self.bits = rows, bits
        self._chunks = min(_MAX_CHUNKS, runtime.workers())
        self._generation = 0
        self._move = np.zeros(18)
        self._voxel = voxel
        self._move[12] = 1.0 / voxel if voxel > 0 else 0.0
        self._move[13:15] = min(r_min * r_min, _HUGE), min(r_max * r_max, _HUGE)
        table = np.zeros((self._chunks << bits) + 8, dtype=np.int64)
        self._table = table[-table.__array_interface__["data"][0] % 64 // 8 :][
            : self._chunks << bits
        ]  # to a line
        self._totals = np.zeros(5 * self._chunks + 1, dtype=np.int32)
        self.moved = np.empty((rows, 3), dtype=np.float32)
        self.polar = PolarBins(*(bins or (1, 1, 1.0)), self._chunks)
        polar = self.polar
        arguments: tuple[Any, ...] = (
            *(np.empty(0, dtype=np.float32), 0, 1, 0, bits, self._move, self._table),
            *(np.empty(rows, dtype=np.int64), self.moved.reshape(-1), self._totals),
            *(
                *(bins[:2] if bins else (0, 0)),
                polar.params,
                polar.edges,
                polar.guesses,
                polar.cells,
                polar.bins,
            ),
            *(polar.highest, polar.total, polar.count),
        )
        self._launch = Launch("intake", "intake", *arguments)

    def run(self, points: F32, T: F64, centre: F64) -> tuple[int, int, int, int]:
        """Rows kept, rows not finite, points out of reach, points for which the table was too small."""
        self._generation += 1
        if self._generation == _GENERATIONS:
            self._table.fill(0)
            self._generation = 1
        chunks = min(self._chunks, 1 + len(points) // _ROWS_PER_CHUNK)
        self._move[:12] = T[:3].reshape(-1)
        np.multiply(T[:3, 3], self._move[12], out=self._move[15:])
        np.floor(self._move[15:], out=self._move[15:])
        self.polar.params[:3] = centre
        self._launch.put(_POINTS, points.reshape(-1))
        self._launch.put(_ROWS, len(points))
        self._launch.put(_CHUNKS, chunks)
        self._launch.put(_GENERATION, self._generation)
        self._launch()
        totals = self._totals[: 5 * chunks].reshape(chunks, 5)
        infinite, far, full = (int(totals[:, k].sum()) for k in (2, 3, 4))
        return int(self._totals[5 * chunks]), infinite, far, full
