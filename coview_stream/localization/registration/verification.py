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

The score separates right from wrong, but not by itself. Seen by hand on a few runs, no command prints it: right places
score 0.3 to 0.75 in simulated towns and campuses, and wrong ones mostly below 0.2 but 0.3 to 0.57 at times when the
robot is outside the map; on the road corridor ``riverside`` right places reach 0.8 to 0.95 and wrong ones on the same
road 0.6 to 0.7. Hence the lead over the best rival, the ground share and the evidence of several keyframes that
:class:`coview_stream.config.AcceptanceConfig` asks for as well. The constants below are set by hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import coview_kernels as kernels
from coview_stream.geometry.arrays import Bools, Floats32, Ints, Reals
from coview_stream.geometry.transforms import Points, Pose, inverse, norms, transform
from coview_stream.localization.registration.local_map import LocalMap
from coview_stream.localization.registration.prepare_scan import RegistrationCloud

# structure and ground
_STRUCTURE_HEIGHT = 1.0  # metres above the ground
_STRUCTURE_REACH = 0.5  # metres: two voxels of the map
_GROUND_SEARCH = 1.0  # metres to the next map point of the ground, which a sparse map shows every half metre
_GROUND_REACH = 0.15  # metres off its plane
_MIN_STRUCTURE = 60  # points; fewer cannot tell places apart
_PSEUDO = 20.0  # pseudo-observations at a share of 1/2: a handful of points is little evidence

# free space
_FREE_RANGE = 35.0  # metres, beyond which a degree is wider than most objects
_MIN_RANGE = 1.0  # metres: nearer returns are the robot's own
_FREE_EVERY = 3  # of the map's points: a share needs no more
_FREE_HEIGHT = 0.8  # metres above the ground below the robot: kerbs and slopes graze the rays
_BEAM = np.radians(2.0)  # cell of the range image
_COLUMNS = int(np.ceil(2 * np.pi / _BEAM)) + 1
_CELLS = _COLUMNS * (int(np.ceil(np.pi / _BEAM)) + 1)
_BEAM_HITS = 2  # returns in a cell: fewer say nothing
_MAX_RAYS = 32_768  # of a frame: a dense lidar has tens of them in each cell
_SLACK = 0.5  # metres, plus _SLACK_SLOPE per metre of range, before a ray counts as having passed
_SLACK_SLOPE = 0.03
_FLOOR_RADIUS = 10.0  # metres around the sensor in which its ground is looked for
_FLOOR_PERCENTILE = 5.0  # of the heights there: a few returns lie below the ground
_MIN_FLOOR_POINTS = 20  # fewer do not show the ground


@dataclass(frozen=True)
class Evidence:
    """Shares in [0, 1] of what the robot sees that a pose explains, and of what the map has that the robot sees.

    Attributes:
        near: of the points > 1 m above the ground, those within 0.5 m of a map point; 0 if there are fewer than 60.
        covered: of the same points, those that are near, or below an edge of the map (see
            :class:`coview_stream.localization.registration.local_map.RoofEdges`).
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
    source: RegistrationCloud, T_map_source: Pose, seen: RangeImage, T_map_body: Pose, target: LocalMap, surveyed: Bools
) -> Evidence:
    """Return the evidence for a registered pose.

    Args:
        source: local scan that was registered.
        T_map_source: (4, 4) its pose.
        seen: the newest frame: the rays whose way was free.
        T_map_body: (4, 4) pose of that frame.
        target: the map around it.
        surveyed: (M,) which points of ``source`` lie where the map has been surveyed; the others are left out.
    """
    moved = transform(T_map_source, source.points)
    distance, partner = kernels.nearest(target.grid, moved, _GROUND_SEARCH)
    high = surveyed & (source.height > _STRUCTURE_HEIGHT)
    low = surveyed & ~source.above
    few = int(high.sum()) < _MIN_STRUCTURE
    found = distance[high] < _STRUCTURE_REACH
    near = 0.0 if few else float(found.mean())
    covered = 0.0 if few else float((found | target.edges.covers(moved[high])).mean())
    grounded = float(_on_surface(moved[low], partner[low], target).sum())
    ground = (grounded + 0.5 * _PSEUDO) / (float(low.sum()) + _PSEUDO)
    met, passed = free_space(seen, T_map_body, target.points)
    free = (met + 0.5 * _PSEUDO) / (met + passed + _PSEUDO)
    return Evidence(near, covered, ground, free, float(surveyed.mean()) if len(surveyed) else 0.0)


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
    hits: Ints
    floor: float

    @classmethod
    def of(cls, cloud: Points) -> RangeImage:
        """Sort a frame (N, 3), body frame, metres, by direction; returns within a metre are the robot's own."""
        cloud = cloud[:: max(1, -(-len(cloud) // _MAX_RAYS))]
        ranges = norms(cloud)
        usable = ranges > _MIN_RANGE
        ranges = ranges[usable]
        cell = _beam_cells(cloud.compress(usable, axis=0), ranges)
        nearest = np.full(_CELLS, np.inf, dtype=np.float32)
        farthest = np.zeros(_CELLS, dtype=np.float32)
        np.minimum.at(nearest, cell, ranges)
        np.maximum.at(farthest, cell, ranges)
        return cls(nearest, farthest, np.bincount(cell, minlength=_CELLS), _floor_below(cloud))


def free_space(seen: RangeImage, T_map_body: Pose, points: Points) -> tuple[int, int]:
    """Count the map points that the frame's rays met, and those that they passed through.

    A map point is passed through where every return in its 2-degree cell of the frame's range image lies clearly
    behind it; points behind the returns are hidden and do not count.

    Args:
        seen: the frame.
        T_map_body: (4, 4).
        points: (K, 3) map points, map frame.
    """
    position = T_map_body[:3, 3]
    points = points[::_FREE_EVERY]
    dx, dy = points[:, 0] - position[0], points[:, 1] - position[1]
    wanted = (dx * dx + dy * dy < _FREE_RANGE**2) & (points[:, 2] > position[2] + seen.floor + _FREE_HEIGHT)
    body = transform(inverse(T_map_body), points.compress(wanted, axis=0).astype(np.float64))
    distance = norms(body)
    off = distance > _MIN_RANGE
    body, distance = body.compress(off, axis=0), distance[off]
    cell = _beam_cells(body, distance)
    looked = seen.hits[cell] >= _BEAM_HITS
    slack = _SLACK + _SLACK_SLOPE * distance
    passed = looked & (distance < seen.nearest[cell] - slack)
    met = looked & ~passed & (distance <= seen.farthest[cell] + slack)
    return int(met.sum()), int(passed.sum())


def _on_surface(points: Reals, partner: Ints, target: LocalMap) -> Bools:
    """Tell which of (N, 3) points lie on their partner's plane; partners (N,) index the K map points, K for none."""
    has = partner < len(target.points)
    near = partner[has]
    off = np.abs(np.einsum("ij,ij->i", points[has] - target.points[near], target.normals[near]))
    on = np.zeros(len(points), dtype=bool)
    on[has] = off < _GROUND_REACH
    return on


def _beam_cells(points: Reals, ranges: Reals) -> Ints:
    """Cell (N,) of the range image that each of (N, 3) points at ``ranges`` (N,) lies in."""
    azimuth = np.floor((np.arctan2(points[:, 1], points[:, 0]) + np.pi) / _BEAM).astype(np.int64)
    elevation = np.floor((np.arcsin(np.clip(points[:, 2] / ranges, -1, 1)) + np.pi / 2) / _BEAM).astype(np.int64)
    return np.asarray(elevation * _COLUMNS + azimuth)


def _floor_below(cloud: Points) -> float:
    """Height of the ground relative to the sensor: a low percentile of the points near it, never above it."""
    near = cloud[:, 2][np.hypot(cloud[:, 0], cloud[:, 1]) < _FLOOR_RADIUS]
    return min(0.0, float(np.percentile(near, _FLOOR_PERCENTILE))) if len(near) >= _MIN_FLOOR_POINTS else 0.0
