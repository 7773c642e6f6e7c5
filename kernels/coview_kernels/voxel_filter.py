"""Voxel filter: rigid transform, range filter and first point of each voxel, in one pass over a cloud.

The pass runs on one thread. A frame takes 0.7 ms; waking another thread would cost 0.1 ms, and voxels that both threads
found would have to be merged.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from coview_kernels import reference, runtime
from coview_kernels.arrays import F32, F64, as_finite64, as_float32
from coview_kernels.launch import Launch
from coview_kernels.warm_up import SAMPLE, compiled_by

_MAX_KEPT_BYTES = 1 << 23  # of table and results that are kept between calls
_MAX_SENSOR = 1 << 29  # voxels between the sensor and the origin
_MAX_COORDINATE = 1 << 30  # voxels from the origin
_MAX_FLOAT32 = float(np.finfo(np.float32).max)
_NO_LIMIT = 1e300  # replaces infinity, which a compiler may assume does not exist
_MAX_CALLS = 1 << 21  # call numbers that fit into a key of the table beside its cube
_MIN_BITS = 10  # of the hash table, whose size doubles until no cloud fills more than half of it
_MIN_ROWS = 4096  # of the results; doubled as needed
_BLOCK = 64  # points that the kernel takes at once
_EMPTY: F32 = np.empty(0, dtype=np.float32)
_POINTS, _BLOCKS, _CALL, _MERGE = 0, 1, 2, 4  # arguments of the kernel that change


def transform_unique(
    points: npt.ArrayLike,
    T: npt.ArrayLike,
    voxel: float,
    r_min: float = 0.0,
    r_max: float = math.inf,
    centre: npt.ArrayLike = (0.0, 0.0, 0.0),
) -> tuple[F32, int]:
    """Move a cloud into another frame and keep the first point of each voxel there.

    Args:
        points: (N, 3) float32 source-frame coordinates, metres, near their origin, as float32 has 7 digits.
        T: (4, 4) ``T_target_source``; the product is computed in float64 and rounded to float32 once.
        voxel: edge of the voxels in the target frame, metres; a point is in voxel ``floor(p * (1 / voxel))``. Zero or
            negative: keep every point.
        r_min: least range in the source frame that is kept, metres (inclusive).
        r_max: range in the source frame from which points are dropped, metres (exclusive).
        centre: (3,) origin of the ranges, source frame.

    Returns:
        (K, 3) float32 target-frame coordinates, in input order, and the number of rows dropped because they, or their
        images, are NaN or infinite.

    Raises:
        ValueError: an array has the wrong shape, ``T`` or ``centre`` is not finite, or a range is negative or NaN.
    """
    cloud, pose = as_float32("points", points, None, 3), as_finite64("T", T, 4, 4)
    if not (r_min >= 0 and r_max >= 0):
        raise ValueError(f"r_min and r_max must not be negative, got {r_min} and {r_max}")
    if not math.isfinite(voxel):
        raise ValueError(f"voxel must be finite, got {voxel}")
    middle = tuple(as_finite64("centre", centre, 3).tolist())
    return runtime.dispatch_here(
        lambda: _pass is not None and _pass.launch.ready(), _transform_unique, reference.transform_unique,
        cloud, pose, float(voxel), float(r_min), float(r_max), middle,
    )  # fmt: skip


_pass: _KernelPass | None = None  # one for all calls, as only one call of native code runs at a time


def _transform_unique(
    points: F32, T: F64, voxel: float, r_min: float, r_max: float, centre: tuple[float, ...]
) -> tuple[F32, int]:
    global _pass
    current, _pass = _pass or _KernelPass(), None
    result = current(points, T, voxel, r_min, r_max, centre)
    if current.moved.nbytes + current.table.nbytes <= _MAX_KEPT_BYTES:
        _pass = current
    if result is None:
        return reference.transform_unique(points, T, voxel, r_min, r_max, centre)
    moved, dropped = result
    return moved.copy(), dropped


class _KernelPass:
    """One pass of the kernel over a cloud, with its hash table and results; for native code only.

    Both are kept between calls, and double when they are full. The table is cleared only when the call numbers run out,
    as its entries carry the number of their call.
    """

    def __init__(self) -> None:
        self._call = 0
        self._settings = np.zeros(22)
        self._totals = np.zeros(4, dtype=np.int32)
        self._tail = np.empty((_BLOCK, 3), dtype=np.float32)
        self.moved: F32 = np.empty((_MIN_ROWS, 3), dtype=np.float32)
        self._allocate(_MIN_BITS)

    def __call__(
        self, points: F32, T: F64, voxel: float, r_min: float, r_max: float, centre: tuple[float, ...]
    ) -> tuple[F32, int] | None:
        """Return the points kept, in a buffer that the next call overwrites, and the number of rows not finite.

        None if the cloud is out of reach: farther than 2^15 voxels from the sensor, or 2^29 from the origin.
        """
        inverse = 1.0 / voxel if voxel > 0 else 0.0
        sensor = T[:3, 3] * inverse
        if not np.abs(sensor).max() < _MAX_SENSOR:
            return None
        if len(points) > len(self.moved):
            self.moved = np.empty((1 << (len(points) - 1).bit_length(), 3), dtype=np.float32)
            self._allocate(self._bits)
        farthest = min(_MAX_COORDINATE / inverse, _MAX_FLOAT32) if inverse else _MAX_FLOAT32
        self._settings[:12] = T[:3].reshape(-1)
        self._settings[12:16] = (inverse, min(r_min * r_min, _NO_LIMIT), min(r_max * r_max, _NO_LIMIT), farthest)
        np.floor(sensor, out=self._settings[16:19])
        self._settings[19:] = centre
        while True:
            kept, infinite, far, cubes = self._run(points, -1 if inverse else 0)
            if far:
                return None
            if cubes + _BLOCK <= 1 << (self._bits - 1):
                return self.moved[:kept], infinite
            self._allocate(self._bits + 1)

    def _allocate(self, bits: int) -> None:
        self._bits = bits
        size = (2 << bits) + 2
        table = np.zeros(size + 8, dtype=np.int64)
        to_cache_line = -table.__array_interface__["data"][0] // 8 % 8
        self.table = table[to_cache_line : to_cache_line + size]
        self.launch = Launch(
            *("voxel_filter", "voxel_filter", _EMPTY, 0, 1, bits, -1),
            *(self._settings, self.table, self.moved.reshape(-1), self._totals),
        )

    def _run(self, points: F32, merge: int) -> list[int]:
        self._call += 1
        if self._call == _MAX_CALLS:
            self.table.fill(0)
            self._call = 1
        self._totals.fill(0)
        self.launch.put(_CALL, self._call)
        self.launch.put(_MERGE, merge)
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
        self.launch.put(_POINTS, points.reshape(-1))
        self.launch.put(_BLOCKS, blocks)
        self.launch()
        self.launch.put(_POINTS, _EMPTY)  # keeps no cloud alive


compiled_by("transform_unique", lambda: transform_unique(SAMPLE, np.eye(4), 1.0))
