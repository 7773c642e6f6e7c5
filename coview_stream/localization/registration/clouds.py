"""The two clouds of a registration: the robot's thinned recent points, and a crop of the map around a place."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary

import numpy as np

import coview_kernels as kernels
from coview_kernels.cells import Cells
from coview_stream.basemap.tiles import cut_points
from coview_stream.config import KeyframeConfig, RegistrationConfig
from coview_stream.config.localizer import MIN_PAIRS
from coview_stream.descriptors.coview import EYE, FLOOR_RADIUS, LOWEST_EYE, lies_on_ground
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Ints
from coview_stream.geometry.rasters import min_filter
from coview_stream.geometry.transforms import Points, Pose, norms

if TYPE_CHECKING:
    from coview_stream.basemap.basemap import BaseMap


_CELL = 2.0  # metres: the ground hardly rises within it, and walls are seldom wider
_CLEAR = 0.5  # metres above the lowest point nearby; higher points are not ground
_FLOOR_PERCENTILE = 1.0  # of the heights: a few returns lie below the ground
STRUCTURE_HEIGHT = 1.0  # metres above the lowest ground nearby
_TILT, _VIEWED = math.radians(0.35), 0.12  # radians, metres: sigmas of a registration without ground
_SEED = 20240  # of the random subset of points


@dataclass(frozen=True)
class RegistrationCloud:
    """A local scan to register."""

    points: Points  # (N, 3) float32, gravity-aligned frame, metres
    above: Bools  # (N,) whether a point stands above the ground
    height: Floats32  # (N,) metres above the lowest ground nearby
    ground_offset: float = 0.0  # metres by which the ground points have been lowered
    changed: float = 0.0  # share of the ground that was left out, as it differs from the survey's
    dug: float = 0.0  # metres from the deepest tenth of the ground's patches up to the survey's ground

    @property
    def high(self) -> Bools:
        """(N,) whether a point is structure: more than a metre above the ground."""
        return np.asarray(self.height > STRUCTURE_HEIGHT)

    def lowered(self, metres: float) -> RegistrationCloud:
        """Return the scan with its ground lowered onto the survey's; negative metres raise it."""
        points = self.points.copy()
        points[~self.above, 2] -= np.float32(metres)
        return replace(self, points=points, ground_offset=self.ground_offset + metres)

    def doubted(self, covariance: Floats) -> Floats:
        """Return a registration's covariance (6, 6) over (rx, ry, rz, x, y, z), wider where the ground has changed.

        Without ground, tilt and height have the errors of structure, seen from below now and from above before.
        """
        return np.asarray(covariance + self.groundless * np.diag([_TILT**2, _TILT**2, 0.0, 0.0, 0.0, _VIEWED**2]))

    @property
    def groundless(self) -> float:
        """Probability that no ground constrains height and tilt: three patches do, and all three have changed."""
        return self.changed**3

    def every(self, nth: int) -> RegistrationCloud:
        """Return a thinner scan: every ``nth`` point of each kind."""
        order = np.concatenate((np.flatnonzero(self.above), np.flatnonzero(~self.above)))[::nth]
        return replace(self, points=self.points[order], above=self.above[order], height=self.height[order])


def prepare_scan(points: Points, position: Floats, config: RegistrationConfig) -> RegistrationCloud:
    """Thin a local scan to at most ``source_points`` points within ``source_range`` metres of ``position``.

    Points (N, 3) float32 and the body's ``position`` (3,) are in a gravity-aligned frame, metres. The choice of points
    is random but seeded.
    """
    thin = thinned(points, position, config)
    height, cell = _heights(thin)
    near = thin[((thin[:, :2] - position[:2]) ** 2).sum(axis=1) < FLOOR_RADIUS**2, 2]
    high = len(near) > 0 and np.percentile(near, _FLOOR_PERCENTILE) > position[2] - LOWEST_EYE
    if high and not lies_on_ground(thin, position):
        height = thin[:, 2] - np.float32(position[2] - EYE)  # no ground: the lowest points stand on walls
    chosen = np.arange(len(thin))
    if len(thin) > config.source_points:
        chosen = np.random.default_rng(_SEED).choice(len(thin), config.source_points, replace=False)
        chosen.sort()
    # sort by cell: neighbours are compared with the same part of the map, which is then cached
    chosen = chosen[np.argsort(cell[chosen], kind="stable")]
    thin, height = thin[chosen], height[chosen]
    return RegistrationCloud(thin, height > _CLEAR, height)


def thinned(points: Points, position: Floats, config: RegistrationConfig) -> Points:
    """Return the points (K, 3) of a local scan in range, one per voxel: the first step of :func:`prepare_scan`.

    :func:`prepare_scan`, whose arguments these are, has the same result for these points as for all.
    """
    return kernels.transform_unique(points, np.eye(4), config.source_voxel, 0.0, config.source_range, position)[0]


def height_above_lowest(points: Points) -> Floats32:
    """Height (N,) of each point above the lowest of its 2 m cell and the eight around it, metres.

    The neighbours matter where a sparse sensor sees only a facade in a cell and no ground.
    """
    return _heights(points)[0]


def _heights(points: Points) -> tuple[Floats32, Ints]:
    """Height (N,) of each point above the lowest nearby, and the number (N,) of its cell."""
    if not len(points):
        return np.empty(0, dtype=np.float32), np.empty(0, dtype=np.int64)
    i, j = (np.floor(points[:, d] / _CELL).astype(np.int64) for d in range(2))
    i -= i.min()
    j -= j.min()
    rows, columns = int(i.max()) + 1, int(j.max()) + 1
    cell = i * columns + j
    lowest = np.full(rows * columns, np.inf, dtype=np.float32)
    np.minimum.at(lowest, cell, np.ascontiguousarray(points[:, 2]))  # fast on contiguous arrays only
    around = min_filter(lowest.reshape(rows, columns), 3)
    return points[:, 2] - around.ravel()[cell], cell


def voxelized(cloud: Points, T_odom_body: Pose, config: KeyframeConfig) -> Points:
    """Return points (K, 3) of a frame (N, 3) in the odometry frame, one per voxel, without those near the sensor."""
    return kernels.transform_unique(cloud, T_odom_body, config.voxel, config.range_min)[0]


MAX_CROP_BYTES = 32_000_000
"""Bytes of cached crops beside those in use: three crops of a dense survey, at 10 MB."""
_CROP_STEP = 16.0  # metres between the centres of cached crops


@dataclass(frozen=True, eq=False)
class LocalMap:
    """A crop of the base map; its search structures are built at first use."""

    points: Points  # (K, 3) map frame, metres
    normals: Points  # (K, 3) normals, with the planarity around each point as length: 1 on a surface, 0 in scatter
    cells: Cells | None = None  # the points' order by cell, if they have been sorted

    @cached_property
    def grid(self) -> kernels.PointGrid:
        """The points for :func:`coview_kernels.nearest`."""
        if self.cells is None:
            return kernels.PointGrid(self.points)
        return kernels.PointGrid.sorted(self.points, self.cells)

    def planes(self, rows: Ints) -> tuple[Floats32, Floats32]:
        """Return the unit normals (N, 3) of points by row, and the planarity (N,) in [0, 1] around each."""
        normals = self.normals[rows]
        length = norms(normals)
        unit = np.asarray(normals / np.maximum(length, np.float32(1e-6))[:, None], dtype=np.float32)
        return unit, np.minimum(length, np.float32(1.0))

    @property
    def nbytes(self) -> int:
        """Bytes of the points, their normals and their order by cell."""
        order = self.points.nbytes if self.cells is None else self.cells.starts.nbytes + self.cells.rows.nbytes
        return order + self.normals.nbytes  # sorted points are a view of the rows

    def prepare(self) -> None:
        """Build the search structures now."""
        if "grid" not in vars(self):
            kernels.nearest(self.grid, self.points[:1], 1.0)


class LocalMaps:
    """Crops of a base map by place; those in use and recently used are cached."""

    def __init__(self, base_map: BaseMap, radius: float, max_bytes: int = MAX_CROP_BYTES) -> None:
        self._map = base_map
        self._radius = radius
        self._max_bytes = max_bytes
        self._crops: WeakValueDictionary[tuple[int, int], LocalMap] = WeakValueDictionary()
        self._recent: OrderedDict[LocalMap, None] = OrderedDict()  # newest last
        self._empty: set[tuple[int, int]] = set()  # places without a crop

    def around(self, position: Floats) -> LocalMap | None:
        """Return the map within at least ``radius`` metres of ``position`` (3,); None if it is (nearly) empty there."""
        key = (round(position[0] / _CROP_STEP), round(position[1] / _CROP_STEP))
        if key in self._empty:
            return None
        crop = self._crops.get(key) or self._cut(key)
        if crop is None:
            self._empty.add(key)
            return None
        if crop in self._recent:
            self._recent.move_to_end(crop)
            return crop
        self._crops[key], self._recent[crop] = crop, None
        while len(self._recent) > 1 and sum(kept.nbytes for kept in self._recent) > self._max_bytes:
            self._recent.popitem(last=False)
        return crop

    def clear(self) -> None:
        """Drop the crops that are not in use."""
        self._recent.clear()
        self._empty.clear()

    def _cut(self, key: tuple[int, int]) -> LocalMap | None:
        centre = np.array(key) * _CROP_STEP
        cut = kernels.Cut(float(centre[0]), float(centre[1]), self._radius + 0.75 * _CROP_STEP)
        crop = cut_points(self._map.arrays, self._map.config.tile, cut)
        return None if crop is None or len(crop.points) < MIN_PAIRS else LocalMap(*crop)
