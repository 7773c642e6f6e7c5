"""Evidence that a pose is right, independent of the residual of its registration, which falls at wrong places too.

A pose is judged by four shares in [0, 1], which a wrong place fails in different ways:

* near: of the robot's points that stand well above the ground, those that have a map point next to them. At a wrong
  place walls, poles and trunks stand where the map has none.
* covered: of the same points, those that have a map point next to them or stand below an edge of the map. An airborne
  map shows roofs and few of the facades below them, so that near is low even at the right place, where covered is high.
* ground: of the robot's points on the ground, those that lie on the map's ground. A place on another storey, a slope
  or inside a block of houses fails it.
* free space: of the map's points in view of the robot, those that its rays met rather than passed through. The first
  three ask whether the map has what the robot sees; this one asks whether the robot sees what the map has.

The score is sqrt(near * covered * ground * free space): structure, which tells places apart, weighs as much as ground
and free space together. A fifth share, inside, is not in it: how many of the points lie where the map has been surveyed
at all; the others leave out the points that do not.

The score separates right from wrong, but not by itself: right places score 0.3 to 0.95, wrong ones up to 0.7 on a road
that looks the same all along. A search judges places against chance instead (docs/integrity.md); the score is what is
told of a place, and what tracking compares with the usual. The constants below are set by hand.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Int32s, Ints
from coview_stream.geometry.transforms import Points, Pose
from coview_stream.localization.registration.local_map import LocalMap
from coview_stream.localization.registration.prepare_scan import RegistrationCloud

# structure and ground
STRUCTURE_HEIGHT = 1.0  # metres above the ground
_STRUCTURE_REACH = 0.5  # metres: two voxels of the map
_GROUND_SEARCH = 1.0  # metres to the next map point of the ground, which a sparse map shows every half metre
_GROUND_REACH = 0.15  # metres off its plane
_ABOVE_EDGE = 0.5  # metres that structure may rise above the edge that it stands below
MIN_STRUCTURE = 60  # points; fewer cannot tell places apart
PSEUDO = 20.0  # pseudo-observations at a share of 1/2: a handful of points is little evidence

# free space
FREE_RANGE = 35.0  # metres, beyond which a degree is wider than most objects
_MIN_RANGE = 1.0  # metres: nearer returns are the robot's own
FREE_HEIGHT = 0.8  # metres above the ground below the robot: kerbs and slopes graze the rays
_BEAM = math.radians(2.0)  # cell of the range image
_BEAM_HITS = 2  # returns in a cell: fewer say nothing
_MAX_RAYS = 32_768  # of a frame: a dense lidar has tens of them in each cell
_SLACK = 0.5  # metres, plus _SLACK_SLOPE per metre of range, before a ray counts as having passed
_SLACK_SLOPE = 0.03
_FLOOR_RADIUS = 10.0  # metres around the sensor in which its ground is looked for
_FLOOR_PERCENTILE = 5.0  # of the heights there: a few returns lie below the ground
_MIN_FLOOR_POINTS = 20  # fewer do not show the ground

_DISTANCES = kernels.Distances(_STRUCTURE_REACH, _GROUND_SEARCH, _GROUND_REACH, _ABOVE_EDGE)
_SIGHT = kernels.Sight(_BEAM, _MIN_RANGE, FREE_RANGE, _SLACK, _SLACK_SLOPE)


@dataclass(frozen=True)
class Evidence:
    """Shares in [0, 1] of what the robot sees that a pose explains, and of what the map has that the robot sees.

    Attributes:
        near: of the points > 1 m above the ground, those within 0.5 m of a map point; 0 if there are fewer than 60.
        covered: of the same points, those that are near, or below an edge of the map (see
            :mod:`coview_stream.localization.registration.local_map`).
        ground: of the points on the ground, those within 0.15 m of the plane of a map point less than 1 m away.
        free_space: of the map points that rays met or passed through, those that they met.
        inside: of all points, those that lie where the map has been surveyed.
    """

    near: float
    covered: float
    ground: float
    free_space: float
    inside: float

    @property
    def score(self) -> float:
        """Square root of the product of the four shares that can contradict a pose, in [0, 1]."""
        return float(np.sqrt(self.near * self.covered * self.ground * self.free_space))


def verify(
    source: RegistrationCloud,
    T_map_source: Pose,
    seen: RangeImage,
    T_map_body: Pose,
    target: LocalMap,
    survey: kernels.Raster,
) -> Evidence:
    """Return the evidence for a registered pose.

    Args:
        source: local scan that was registered.
        T_map_source: (4, 4) its pose.
        seen: the newest frame: the rays whose way was free.
        T_map_body: (4, 4) pose of that frame.
        target: the map around it.
        survey: where the map has been surveyed; points of ``source`` elsewhere are left out.
    """
    kinds = _kinds(source)
    found = kernels.match_points(
        target.grid, target.normals, source.points, kinds, T_map_source, target.edges, survey, _DISTANCES
    )
    few = found.high < MIN_STRUCTURE
    near, covered = (0.0, 0.0) if few else (found.near / found.high, found.covered / found.high)
    ground = (found.grounded + 0.5 * PSEUDO) / (found.low + PSEUDO)
    met, passed = free_space(seen, T_map_body, target.sample)
    free = (met + 0.5 * PSEUDO) / (met + passed + PSEUDO)
    return Evidence(near, covered, ground, free, found.surveyed / len(kinds) if len(kinds) else 0.0)


@dataclass(frozen=True)
class RangeImage:
    """One frame by direction, in cells of 2 degrees; made once, compared with the map at any number of poses.

    Attributes:
        nearest: (C,) range of the nearest return in each cell, metres; infinite without one.
        farthest: (C,) of the farthest; zero without one.
        hits: (C,) returns.
        floor: height of the ground relative to the sensor, metres, not above it.
    """

    nearest: Floats32
    farthest: Floats32
    hits: Int32s
    floor: float

    @classmethod
    def of(cls, cloud: Points) -> RangeImage:
        """Sort a frame (N, 3), body frame, metres, by direction; returns within a metre are the robot's own."""
        every = _rays_apart(cloud)
        return cls(*kernels.sort_beams(cloud, _SIGHT, every), _floor_below(cloud[::every]))

    @staticmethod
    def rays(cloud: Points) -> Points:
        """Return those of a frame's points (N, 3) that :meth:`of` takes: it makes the same of them alone."""
        return cloud[:: _rays_apart(cloud)]

    @staticmethod
    def cells(points: Floats, ranges: Floats) -> Ints:
        """Return the cells (N,) of direction of points (N, 3), body frame, at ``ranges`` (N,) from the sensor."""
        return kernels.beam_cells(points, ranges, _SIGHT)

    def passed(self, cell: Ints, ranges: Floats) -> Bools:
        """Tell which of N points, in cells of direction and at ``ranges`` (N,), metres, rays have passed through."""
        slack = _SLACK + _SLACK_SLOPE * ranges
        return np.asarray((ranges > _MIN_RANGE) & (ranges < self.limits[0, cell] - slack))

    @cached_property
    def limits(self) -> Floats32:
        """(2, C) nearest and farthest return of each cell; below any range where they are too few to say anything."""
        return np.where(self.hits >= _BEAM_HITS, (self.nearest, self.farthest), np.float32(-np.inf))


def _rays_apart(cloud: Points) -> int:
    """Return how many points of a frame (N, 3) apart those are that are used."""
    return max(1, -(-len(cloud) // _MAX_RAYS))


def free_space(seen: RangeImage, T_map_body: Pose, points: Points) -> tuple[int, int]:
    """Count the map points that the frame's rays met, and those that they passed through.

    A map point is passed through where every return in its 2-degree cell of the frame's range image lies clearly
    behind it; points behind the returns are hidden and do not count.

    Args:
        seen: the frame.
        T_map_body: (4, 4).
        points: (K, 3) map points, map frame.
    """
    lowest = float(T_map_body[2, 3]) + seen.floor + FREE_HEIGHT
    return kernels.match_rays(seen.limits, points, T_map_body, lowest, _SIGHT)


def _kinds(source: RegistrationCloud) -> npt.NDArray[np.uint8]:
    """Kind (N,) of each point of a scan, as :class:`coview_kernels.PointKind`."""
    kind = kernels.PointKind
    low = np.where(source.above, kind.OTHER, kind.LOW)
    return np.where(source.height > STRUCTURE_HEIGHT, kind.HIGH, low).astype(np.uint8)


def _floor_below(cloud: Points) -> float:
    """Height of the ground relative to the sensor: a low percentile of the points near it, never above it."""
    x, y = cloud[:, 0], cloud[:, 1]
    near = cloud[:, 2][x * x + y * y < _FLOOR_RADIUS**2]
    return min(0.0, float(np.percentile(near, _FLOOR_PERCENTILE))) if len(near) >= _MIN_FLOOR_POINTS else 0.0
