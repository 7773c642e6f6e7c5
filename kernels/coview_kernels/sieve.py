"""The pass that :class:`coview_kernels.FrameIntake` and :func:`coview_kernels.transform_unique` share.

It runs on one thread: a frame takes 0.7 ms, of which waking another thread would cost 0.1 ms, and voxels that both
have met would have to be found afterwards.
"""

from __future__ import annotations

import numpy as np

from coview_kernels.arrays import F32, F64
from coview_kernels.launch import Launch
from coview_kernels.polar import PolarBins

_NOTHING: F32 = np.empty(0, dtype=np.float32)
_HUGE = 1e300  # stands for no limit: a compiler may assume that there is no infinity
_LARGEST = float(np.finfo(np.float32).max)
_FARTHEST = 1 << 29  # voxels between the sensor and the origin
_BEYOND = 1 << 30  # voxels from the origin, out of reach
_GENERATIONS = 1 << 21  # fit into a key beside its cube
_LEAST_BITS = 10  # of a hash table; doubled until no cloud fills more than half of it
_FIRST_ROWS = 4096
_BLOCK = 64  # points that the kernels take at once
_POINTS, _BLOCKS, _GENERATION, _BITS, _MERGE = range(5)  # of the arguments, those that change


class Sieve:
    """Transform, range filter, first point of each voxel and, if asked for, polar bins of these, in one pass.

    Table and results stay from call to call and grow, by doubling, when they have to. The table is never cleared: its
    entries carry the number of their call. For the owner thread only.
    """

    def __init__(self, bins: PolarBins | None = None) -> None:
        self._bins = bins
        self._generation = 0
        self._move = np.zeros(19)
        self._totals = np.zeros(4, dtype=np.int32)
        self._tail = np.empty((_BLOCK, 3), dtype=np.float32)
        self._moved: F32 = np.empty((_FIRST_ROWS, 3), dtype=np.float32)
        self._tabulate(_LEAST_BITS)

    @property
    def nbytes(self) -> int:
        """Bytes of table and results."""
        return self._moved.nbytes + (16 << self._bits)

    def __call__(
        self, points: F32, T: F64, voxel: float, r_min: float, r_max: float, centre: F64 | None = None
    ) -> tuple[F32, int] | None:
        """Return the points kept, in a buffer that the next call overwrites, and the number of rows not finite.

        None if the cloud is out of reach, farther than 2^15 voxels from the sensor or 2^29 from the origin. For the
        rest see :func:`coview_kernels.transform_unique`; ``centre`` is that of the bins.
        """
        inverse = 1.0 / voxel if voxel > 0 else 0.0
        sensor = T[:3, 3] * inverse
        if not np.abs(sensor).max() < _FARTHEST:
            return None
        if len(points) > len(self._moved):
            self._moved = np.empty((1 << (len(points) - 1).bit_length(), 3), dtype=np.float32)
            self._tabulate(self._bits)
        beyond = min(_BEYOND / inverse, _LARGEST) if inverse else _LARGEST
        self._move[:12] = T[:3].reshape(-1)
        self._move[12:16] = inverse, min(r_min * r_min, _HUGE), min(r_max * r_max, _HUGE), beyond
        np.floor(sensor, out=self._move[16:])
        while True:
            kept, infinite, far, cubes = self._run(points, centre, -1 if inverse else 0)
            if far:
                return None
            if cubes + _BLOCK <= 1 << (self._bits - 1):
                return self._moved[:kept], infinite
            self._tabulate(self._bits + 1)

    def _tabulate(self, bits: int) -> None:
        self._bits = bits
        size = (2 << bits) + 2
        table = np.zeros(size + 8, dtype=np.int64)
        to_line = -table.__array_interface__["data"][0] // 8 % 8
        self._table = table[to_line : to_line + size]
        arguments = (_NOTHING, 0, 1, bits, -1, self._move, self._table, self._moved.reshape(-1), self._totals)
        if self._bins is None:
            self._launch = Launch("sieve", "sieve", *arguments)
        else:
            self._launch = Launch("intake", "intake", *arguments, *self._bins.arguments)

    def _run(self, points: F32, centre: F64 | None, merge: int) -> list[int]:
        self._generation += 1
        if self._generation == _GENERATIONS:
            self._table.fill(0)
            self._generation = 1
        if self._bins is not None:
            self._bins.clear(centre)
        self._totals.fill(0)
        self._launch.put(_GENERATION, self._generation)
        self._launch.put(_MERGE, merge)
        blocks, rows = divmod(len(points), _BLOCK)
        self._add(points, blocks)
        if rows:
            self._tail[:rows] = points[-rows:]
            self._tail[rows:] = np.nan
            self._add(self._tail, 1)
            self._totals[1] -= _BLOCK - rows
        totals: list[int] = self._totals.tolist()
        return totals

    def _add(self, points: F32, blocks: int) -> None:
        self._launch.put(_POINTS, points.reshape(-1))
        self._launch.put(_BLOCKS, blocks)
        self._launch()
        self._launch.put(_POINTS, _NOTHING)  # keeps no cloud alive
