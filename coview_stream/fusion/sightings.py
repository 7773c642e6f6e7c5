"""Sightings: counts of rays that end at points or go through them; voxel tables and look-ups of points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from coview_stream.errors import InputError
from coview_stream.fusion.localized_run import PosedFrame
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Ints
from coview_stream.geometry.rasters import by_square, min_filter
from coview_stream.geometry.transforms import Points

REACH = 25.0
"""Metres within which rays count; farther away, objects fit between neighbouring rays."""

_PIXEL = np.radians(0.5)  # of the range image; 0.2 m at ``REACH``
_COLUMNS, _ROWS = 720, 361
_NEAREST, _STEEPEST = 1.5, np.radians(70.0)  # metres; radians above or below the lidar's horizon
_TILE = 8.0  # metres, for the look-up of points


Counts = npt.NDArray[np.uint32]


class Sightings:
    """Counts of the sightings of fixed points.

    A look goes through a point if its ray and all rays in neighbouring pixels end well behind the point. Rays that
    graze the ground or an edge therefore do not count.

    Attributes:
        points: (N, 3) metres relative to the map's origin, sorted by tile.
        order: (N,) indices of these points among the given points.
        through: (N,) number of looks through the point.
        seen: (N,) number of looks that end at the point.
    """

    def __init__(self, points: Points, margin: float) -> None:
        """Take points (N, 3), map axes; a ray through one ends ``margin`` metres plus 1 % of its range behind it."""
        self.order, self._tiles, self._begin = by_square(points, _TILE)
        self.points = points[self.order]
        self._margin = margin
        self.through = np.zeros(len(points), dtype=np.uint32)
        self.seen = np.zeros(len(points), dtype=np.uint32)

    def look(self, frame: PosedFrame) -> None:
        """Count the looks of one frame at the points around it."""
        pixel, far, valid = _pixels(frame.points - frame.eye.astype(np.float32))
        ranges = np.full((_ROWS, _COLUMNS), np.inf, dtype=np.float32)  # shortest range per pixel
        np.minimum.at(ranges.reshape(-1), pixel[valid], far[valid])
        wide = np.concatenate([ranges[:, -1:], ranges, ranges[:, :1]], axis=1)
        nearest = min_filter(wide, 3)[:, 1:-1]
        R, t = frame.T_map_body[:3, :3], frame.T_map_body[:3, 3]
        centre = t + R @ frame.eye
        middle = (self._tiles + 0.5) * _TILE - centre[:2]
        for k in np.flatnonzero(np.hypot(*middle.T) < REACH + _TILE):
            stretch = slice(int(self._begin[k]), int(self._begin[k + 1]))
            rays = ((self.points[stretch] - centre) @ R).astype(np.float32)
            pixel, far, valid = _pixels(rays)
            valid &= (far < REACH) & (far > _NEAREST)
            met, around = ranges.ravel()[pixel], nearest.ravel()[pixel]
            margin = self._margin + 0.01 * far
            self.through[stretch] += valid & np.isfinite(met) & (around > far + margin)
            self.seen[stretch] += valid & (np.abs(around - far) <= margin)

    def given(self, counts: Counts) -> Counts:
        """Return counts (N,) in the order of the given points."""
        out = np.empty_like(counts)
        out[self.order] = counts
        return out


def _pixels(rays: Points) -> tuple[Ints, Floats32, Bools]:
    far = np.sqrt(np.einsum("ij,ij->i", rays, rays))
    up = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
    column = np.floor(np.arctan2(rays[:, 1], rays[:, 0]) / _PIXEL).astype(np.int64) % _COLUMNS
    row = np.clip(np.floor(up / _PIXEL).astype(np.int64) + _ROWS // 2, 0, _ROWS - 1)
    return row * _COLUMNS + column, far, (far > 0.3) & (np.abs(up) < _STEEPEST)


def looks_at(stamps: Floats, positions: Floats) -> Bools:
    """Mask the frames (K,) to look from, half a metre or a second apart."""
    chosen = np.zeros(len(stamps), dtype=bool)
    last = -1
    for k in range(len(stamps)):
        far = last < 0 or float(np.linalg.norm(positions[k] - positions[last])) >= 0.5
        if far or stamps[k] - stamps[last] >= 1.0:
            chosen[k], last = True, k
    return chosen


_BITS = 21  # of a key, for each axis
_HALF = 1 << (_BITS - 1)
_BUFFER = 2_000_000  # rows that wait until they are merged: 68 MB

ROW = np.dtype([("key", "<i8"), ("hits", "<u4"), ("sum", "<f4", 3), ("stamp", "<f8"), ("source", "<u2")])
"""A voxel: key, number of frames with a point in it, sum of these points from its corner, last stamp, first run."""


class VoxelTable:
    """Table of voxels of edge ``voxel``, metres; counts one point per frame and voxel."""

    def __init__(self, voxel: float) -> None:
        self.voxel = voxel
        self._rows = np.zeros(0, dtype=ROW)
        self._waiting: list[npt.NDArray[np.void]] = []
        self._count = 0

    def __len__(self) -> int:
        """Return the number of voxels."""
        self._merge()
        return len(self._rows)

    def add(self, points: Points, stamp: float, source: int) -> None:
        """Add a frame's points (N, 3), relative to the map's origin, at most one per voxel.

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
        rows = np.concatenate([self._rows, *self._waiting])
        self._waiting, self._count = [], 0
        rows = rows[np.argsort(rows["key"], kind="stable")]
        first = np.flatnonzero(np.append(True, np.diff(rows["key"]) != 0)) if len(rows) else np.zeros(0, np.int64)
        merged = rows[first]
        if len(first):
            merged["hits"] = np.add.reduceat(rows["hits"], first)
            merged["sum"] = np.add.reduceat(rows["sum"], first, axis=0)
            merged["stamp"] = np.maximum.reduceat(rows["stamp"], first)
            merged["source"] = np.minimum.reduceat(rows["source"], first)
        self._rows = merged


def keys_of(cells: Floats) -> Ints:
    """Return the key (N,) of each voxel (N, 3)."""
    x, y, z = (cells.astype(np.int64) + _HALF).T
    return np.asarray((x << 2 * _BITS) | (y << _BITS) | z)


def cells_of(keys: Ints) -> Floats:
    """Return the voxels (N, 3) of keys (N,)."""
    mask = (1 << _BITS) - 1
    parts = [(keys >> 2 * _BITS) & mask, (keys >> _BITS) & mask, keys & mask]
    return np.stack(parts, axis=1).astype(np.float64) - _HALF


_TREE_TILE = 50.0  # metres: one search tree at a time, of some 100,000 points at most


def distances(points: Points, around: Callable[[Floats, float], Points], reach: float) -> Floats32:
    """Return the distance (N,) of points (N, 3) to the nearest other point, infinity beyond ``reach``.

    ``around`` returns at least the other points within a radius of a position (2,).
    """
    from scipy.spatial import cKDTree

    out = np.full(len(points), np.inf, dtype=np.float32)
    if not len(points):
        return out
    order, tiles, begin = by_square(points, _TREE_TILE)
    for tile, index in zip(tiles, np.split(order, begin[1:-1]), strict=True):
        centre = (tile + 0.5) * _TREE_TILE
        others = around(centre, _TREE_TILE * 0.7072 + reach)
        if len(others):
            out[index] = cKDTree(others).query(points[index], distance_upper_bound=reach)[0]
    return out


def within(points: Points) -> Callable[[Floats, float], Points]:
    """Return a function that finds points (N, 3) in a square around a position, for :func:`distances`."""
    order = np.argsort(points[:, 0], kind="stable")
    x = points[order, 0]

    def around(centre: Floats, radius: float) -> Points:
        begin, end = np.searchsorted(x, [centre[0] - radius, centre[0] + radius])
        near = points[order[begin:end]]
        return np.asarray(near[np.abs(near[:, 1] - centre[1]) <= radius])

    return around
