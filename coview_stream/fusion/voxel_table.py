"""Voxel table: a mean point of each voxel that runs have hit, in memory that grows with the surface, not the frames."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.transforms import Points

_BITS = 21
_HALF = 1 << (_BITS - 1)
_BUFFER = 2_000_000  # rows that wait to be merged; set by hand: 100 MB

ROW = np.dtype([("key", "<i8"), ("hits", "<u4"), ("sum", "<f4", 3), ("stamp", "<f8"), ("source", "<u2")])
"""A voxel: its key, frames that hit it, sum of their points from its corner, newest stamp, the first run's number."""


class VoxelTable:
    """Table of voxels; one point of each frame counts in each voxel.

    Attributes:
        voxel: edge, metres.
    """

    def __init__(self, voxel: float) -> None:
        """Begin empty."""
        self.voxel = voxel
        self._rows = np.zeros(0, dtype=ROW)
        self._waiting: list[npt.NDArray[np.void]] = []
        self._count = 0

    def __len__(self) -> int:
        """Return the number of voxels."""
        self._merge()
        return len(self._rows)

    def add(self, points: Points, stamp: float, source: int) -> None:
        """Add a frame's points (N, 3), relative to the map's origin, at most one of each voxel.

        Raises:
            InputError: a point is too far from the map.
        """
        cells = np.floor(points.astype(np.float64) / self.voxel)
        if len(cells) and np.abs(cells).max() >= _HALF:
            raise InputError(f"a frame at {stamp:.3f} s lies {_HALF * self.voxel / 1000:.0f} km from the map")
        rows = np.zeros(len(points), dtype=ROW)
        rows["key"] = keys_of(cells)
        rows["hits"], rows["stamp"], rows["source"] = 1, stamp, source
        rows["sum"] = points - cells * self.voxel
        self._waiting.append(rows)
        self._count += len(rows)
        if self._count > max(_BUFFER, len(self._rows) // 2):
            self._merge()

    def rows(self) -> npt.NDArray[np.void]:
        """Return the voxels (:data:`ROW`), sorted by key."""
        self._merge()
        return self._rows

    def points(self) -> Points:
        """Return the mean points (M, 3) of :meth:`rows`, relative to the map's origin."""
        rows = self.rows()
        corner = cells_of(rows["key"]) * self.voxel
        return np.asarray(corner + rows["sum"] / rows["hits"][:, None], dtype=np.float32)

    def _merge(self) -> None:
        if not self._waiting:
            return
        every = np.concatenate([self._rows, *self._waiting])
        self._waiting, self._count = [], 0
        every = every[np.argsort(every["key"], kind="stable")]
        first = np.flatnonzero(np.append(True, np.diff(every["key"]) != 0)) if len(every) else np.zeros(0, np.int64)
        merged = every[first]
        if len(first):
            merged["hits"] = np.add.reduceat(every["hits"], first)
            merged["sum"] = np.add.reduceat(every["sum"], first, axis=0)
            merged["stamp"] = np.maximum.reduceat(every["stamp"], first)
            merged["source"] = np.minimum.reduceat(every["source"], first)
        self._rows = merged


def keys_of(cells: Floats) -> Ints:
    """Return one number (N,) for each voxel (N, 3)."""
    x, y, z = (cells.astype(np.int64) + _HALF).T
    return np.asarray((x << 2 * _BITS) | (y << _BITS) | z)


def cells_of(keys: Ints) -> Floats:
    """Return the voxels (N, 3) of numbers (N,)."""
    mask = (1 << _BITS) - 1
    parts = [(keys >> 2 * _BITS) & mask, (keys >> _BITS) & mask, keys & mask]
    return np.stack(parts, axis=1).astype(np.float64) - _HALF
