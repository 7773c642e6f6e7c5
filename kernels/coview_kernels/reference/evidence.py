"""Evidence for a pose in plain NumPy, on SciPy's k-d tree."""

from __future__ import annotations

import math
from enum import IntEnum
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from coview_kernels.arrays import F32, F64, I32, I64, U8, Mask
from coview_kernels.reference.nearest import nearest

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


class Raster(NamedTuple):
    """Values (NX, NY) of square cells, C- or Fortran-contiguous."""

    values: npt.NDArray[Any]
    corner: F64
    """(2,) x and y of the first cell's corner, metres."""
    cell: float
    """Edge of a cell, metres."""

    def at(self, points: F64, outside: float) -> npt.NDArray[Any]:
        """Return the values (N,) below points (N, 3); ``outside`` where the raster has none."""
        index = np.floor((points[:, :2] - self.corner) / self.cell).astype(np.int64)
        inside = ((index >= 0) & (index < self.values.shape)).all(axis=1)
        index[~inside] = 0
        return np.where(inside, self.values[index[:, 0], index[:, 1]], outside)


class Distances(NamedTuple):
    """What counts as fitting, metres."""

    reach: float
    """Structure has a map point nearer than this."""
    search: float
    """The map's ground is known where it has a point nearer than this to one of the scan's ground, ..."""
    off: float
    """... and fits where its plane is nearer than this."""
    rise: float
    """Structure may rise above an edge by this."""


class PointKind(IntEnum):
    """What a point of a scan is compared with."""

    OTHER = 0
    """Nothing but where the map has been surveyed."""
    HIGH = 1
    """Structure nearby, or an edge above."""
    LOW = 2
    """The ground."""


class PointCounts(NamedTuple):
    """Points of a scan: all of them where the map has been surveyed."""

    surveyed: int
    high: int
    near: int
    """High ones next to a map point."""
    covered: int
    """High ones next to a map point or below an edge of the map."""
    low: int
    grounded: int
    """Low ones on the map's ground."""


class Sight(NamedTuple):
    """Frames by direction: edge of a cell, radians, and the ranges and slack of what counts, metres."""

    beam: float
    least: float
    farthest: float
    slack: float
    slope: float
    """Metres of slack per metre of range."""

    @property
    def columns(self) -> int:
        """Cells around; one more than a turn, for the very last direction."""
        return math.ceil(2 * math.pi / self.beam) + 1

    @property
    def cells(self) -> int:
        """Cells in all."""
        return self.columns * (math.ceil(math.pi / self.beam) + 1)


class Beams(NamedTuple):
    """Returns of a frame in C cells of direction, row by row upwards, turning left from straight behind."""

    nearest: F32
    """(C,) metres; infinite without one."""
    farthest: F32
    """(C,) metres; zero without one."""
    hits: I32
    """(C,) returns."""


class RayCounts(NamedTuple):
    """Map points that a frame's rays met, and that they passed through."""

    met: int
    passed: int


def match_points(
    tree: cKDTree, normals: F32, points: F32, kinds: U8, T: F64, walls: Raster, survey: Raster, distances: Distances
) -> PointCounts:
    """See :func:`coview_kernels.match_points`; ``tree`` holds the map."""
    moved = points.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    surveyed = survey.at(moved, 0) > 0
    high, low = moved[surveyed & (kinds == PointKind.HIGH)], moved[surveyed & (kinds == PointKind.LOW)]
    near = nearest(tree, high, distances.reach)[0] < distances.reach
    covered = near | (walls.at(high, -np.inf) > high[:, 2] - distances.rise)
    distance, partner = nearest(tree, low, distances.search)
    found = np.isfinite(distance)
    gap = low[found] - tree.data[partner[found]]
    normal = normals[partner[found]].astype(np.float64)
    length = np.sqrt(np.einsum("ij,ij->i", normal, normal))
    grounded = np.abs(np.einsum("ij,ij->i", gap, normal)) < distances.off * length
    return PointCounts(*map(int, (surveyed.sum(), len(high), near.sum(), covered.sum(), len(low), grounded.sum())))


def sort_beams(points: F32, sight: Sight) -> Beams:
    """See :func:`coview_kernels.sort_beams`."""
    wide = points.astype(np.float64)
    ranges = np.sqrt(np.einsum("ij,ij->i", wide, wide))
    usable = ranges > sight.least
    ranges, cell = ranges[usable].astype(np.float32), beam_cells(wide[usable], ranges[usable], sight)
    shortest = np.full(sight.cells, np.inf, dtype=np.float32)
    longest = np.zeros(sight.cells, dtype=np.float32)
    np.minimum.at(shortest, cell, ranges)
    np.maximum.at(longest, cell, ranges)
    return Beams(shortest, longest, np.bincount(cell, minlength=sight.cells).astype(np.int32))


def match_rays(limits: F32, points: F32, T_map_body: F64, lowest: float, sight: Sight) -> RayCounts:
    """See :func:`coview_kernels.match_rays`."""
    wide = points.astype(np.float64)
    off = wide[:, :2] - T_map_body[:2, 3]
    wanted = (np.einsum("ij,ij->i", off, off) < sight.farthest**2) & (wide[:, 2] > lowest)
    body = (wide[wanted] - T_map_body[:3, 3]) @ T_map_body[:3, :3]
    distance = np.sqrt(np.einsum("ij,ij->i", body, body))
    far = distance > sight.least
    body, distance = body[far], distance[far]
    cell, slack = beam_cells(body, distance, sight), sight.slack + sight.slope * distance
    passed: Mask = distance < limits[0, cell] - slack
    met = ~passed & (distance <= limits[1, cell] + slack)
    return RayCounts(int(met.sum()), int(passed.sum()))


def beam_cells(points: F64, ranges: F64, sight: Sight) -> I64:
    """Return the cell of direction (N,) that each of (N, 3) points at ``ranges`` (N,) lies in."""
    turn = np.floor((np.arctan2(points[:, 1], points[:, 0]) + np.pi) / sight.beam).astype(np.int64)
    rise = np.floor((np.arcsin(np.clip(points[:, 2] / ranges, -1, 1)) + np.pi / 2) / sight.beam).astype(np.int64)
    return np.asarray(rise * sight.columns + turn)
