"""Observation of the map by a scan at a pose: shares of the scan's points that the likelihood field explains.

A point above the ground is explained (map structure in its cell or within half a metre, or a roof edge above it, as a
survey from above shows no walls), unexplained, or outside the survey. A ground point lies on the map's ground, off it,
or outside the survey. A point that a ray passed through is free in the map, or contradicts it.

The likelihood compares the seven shares of :class:`Share`. :class:`Evidence` summarizes them for people, the causes of
a loss and the protection level. A right pose scores 0.3 to 0.95, a wrong one up to 0.7 on a uniform road: the score
alone decides nothing (docs/integrity.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property, lru_cache

import numpy as np

import coview_kernels as kernels
from coview_kernels import Move
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Ints
from coview_stream.geometry.transforms import Points, Pose, norms
from coview_stream.localization.registration.clouds import RegistrationCloud

_FEW, _MANY = (256, 128, 192), (1024, 512, 768)  # looked-up structure, ground and free points
_PATCH = 4.0  # metres; points are looked up patch by patch, as neighbours share memory
_OFFSET = 1 << 15  # keeps patch numbers positive
_MIN_STRUCTURE = 60  # points; fewer cannot distinguish places
_PSEUDO = 20.0  # pseudo-observations with a share of 1/2, as a handful of points is little evidence

# free space
_RANGE = 35.0  # metres; beyond, a degree is wider than most objects
_MIN_RANGE = 1.0  # metres: nearer returns are the robot's own
_MIN_HEIGHT = 0.8  # metres above the ground below the robot: kerbs and slopes graze the rays
_BEAM = math.radians(2.0)  # cell of the range image
_COLUMNS = math.ceil(2.0 * math.pi / _BEAM) + 1  # one more than a turn, for rounding
_CELLS = _COLUMNS * (math.ceil(math.pi / _BEAM) + 1)
_BEAM_HITS = 2  # least returns in a cell
_MAX_RAYS = 32_768  # of a frame: a dense lidar has tens of them in each cell
_SLACK, _SLACK_SLOPE = 0.5, 0.03  # metres, and metres per metre of range, by which a ray has to end behind a point
_MARGIN = 0.35  # metres from the middle of a cell of the field to its corner
_FLOOR_RADIUS = 10.0  # metres around the body in which its floor is measured
_FLOOR_PERCENTILE = 5.0  # of the heights there: a few returns lie below the ground
_MIN_FLOOR_POINTS = 20  # fewer show no floor
_SAMPLES = 6000  # points sampled in the space around the robot
_DEPTH = (-3.0, 9.0)  # metres, their heights relative to the body
_LAYERS = 2  # cells filled by a surface along a ray
_VOXEL = 0.5  # metres between neighbouring points of a scan
_POINTS_PASSED = np.pi * _RANGE**2 * (_DEPTH[1] - _DEPTH[0]) / _SAMPLES / (_LAYERS * 0.5) / _VOXEL**2
"""Scan points on the surface that one passed sample represents."""


class Share(IntEnum):
    """Columns of an observation: shares of a scan's points of one kind."""

    ON = 0
    """Structure points in a half-metre cell with map structure."""
    NEAR = 1
    """Structure points within about half a metre of map structure; includes ON."""
    EDGE = 2
    """Structure points that are not near, but below a roof edge."""
    COVERED = 3
    """Structure points in the surveyed area."""
    GROUND = 4
    """Ground points on the map's ground."""
    COVERED_GROUND = 5
    """Ground points in the surveyed area."""
    PASSED = 6
    """Free points, passed by rays, that are map structure."""


@dataclass(frozen=True)
class Evidence:
    """Shares in [0, 1] of a scan that a pose explains; wrong places fail in different ones.

    Attributes:
        near: structure (> 1 m above the ground) within half a metre of map structure; 0 for fewer than 60 points.
        covered: structure that is near, or below a roof edge of the map; 0 likewise.
        ground: ground points on the map's ground.
        free_space: map structure in sight of the robot that its rays met rather than passed through.
        inside: points in the surveyed area; the other shares ignore the rest.
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


@dataclass(frozen=True)
class Observations:
    """Observations of the map from H poses."""

    scan: ScanPart  # the points that were looked up
    counts: kernels.FieldScores  # of these points

    @property
    def poses(self) -> Floats:
        """(H, 4) x, y, z of the body in the map, metres, and heading of the odometry frame, radians."""
        return self.counts.pose

    @cached_property
    def shares(self) -> Floats32:
        """(H, 7) shares, columns as in :class:`Share`."""
        counts, points, level = self.counts, self.scan.points, self.scan.level
        structure, low, free = (max(len(p), 1) for p in (points.structure, points.low, points.free))
        shares = np.empty((len(counts.pose), len(Share)), dtype=np.float32)
        shares[:, Share.ON] = counts.on / structure
        shares[:, Share.NEAR] = counts.near / structure
        shares[:, Share.EDGE] = (counts.covered - counts.near) / structure
        shares[:, Share.COVERED] = counts.structure / structure
        shares[:, Share.GROUND] = level * counts.grounded / low
        shares[:, Share.COVERED_GROUND] = level * counts.low / low
        shares[:, Share.PASSED] = counts.passed / free
        return shares

    @cached_property
    def parts(self) -> Floats:
        """(H, 5) evidence, columns as the fields of :class:`Evidence`."""
        counts, points = self.counts, self.scan.points
        high, flat, free = self.scan.weights
        structure, low, near = counts.structure * high, counts.low * flat, counts.near * high
        surveyed = np.maximum(counts.structure, 1)
        few = structure < _MIN_STRUCTURE
        passed = counts.passed * free * _POINTS_PASSED
        total = len(points.structure) * high + len(points.low) * flat
        return np.column_stack([
            np.where(few, 0.0, counts.near / surveyed),
            np.where(few, 0.0, counts.covered / surveyed),
            (counts.grounded * flat + 0.5 * _PSEUDO) / (low + _PSEUDO),
            (near + 0.5 * _PSEUDO) / (near + passed + _PSEUDO),
            (structure + low) / max(total, 1.0),
        ])  # fmt: skip

    @property
    def scores(self) -> Floats32:
        """(H,) :attr:`Evidence.score` of each pose."""
        near, covered, ground, free_space, _ = self.parts.T
        return np.asarray(np.sqrt(near * covered * ground * free_space), dtype=np.float32)

    def evidence(self, row: int) -> Evidence:
        """Return the evidence at one of the poses."""
        return Evidence(*self.parts[row].tolist())


@dataclass(frozen=True)
class ScanPart:
    """A sample of a scan's points to look up."""

    points: kernels.FieldScan  # of each kind, relative to the body, axes of the odometry frame, metres
    weights: tuple[float, float, float]  # number of the scan's structure, ground and free points per sampled one
    # share of the scan's ground that is compared with the survey's: the rest was dug or filled since
    level: float = 1.0

    @classmethod
    def of(cls, kinds: tuple[Points, Points, Points], counts: tuple[int, int, int], level: float = 1.0) -> ScanPart:
        """Take at most ``counts`` points of each kind."""
        samples = [
            points[np.linspace(0, len(points) - 1, count).astype(np.int64)] if len(points) > count else points
            for points, count in zip(kinds, counts, strict=True)
        ]
        structure, low, free = (len(p) / max(len(s), 1) for p, s in zip(kinds, samples, strict=True))
        return cls(kernels.FieldScan(*samples), (structure, low, free), level)

    @cached_property
    def structure(self) -> ScanPart:
        """The structure alone."""
        nothing = self.points.structure[:0]
        return replace(self, points=replace(self.points, low=nothing, free=nothing))

    def look_up(self, field: kernels.FieldMap, poses: Floats, move: Move) -> Observations:
        """Observe the map from poses (H, 4), as in :class:`Observations`, each first moved as far as ``move`` allows.

        ``Move.NEAR`` allows odometry's drift between keyframes.
        """
        return Observations(self, kernels.field_scores(field, self.points, poses, move))


@dataclass(frozen=True, eq=False)
class ObservedScan:
    """A scan to register, with two samples for the field: few points for many poses, many points for the best poses."""

    cloud: RegistrationCloud  # the points to register, odometry frame, metres
    T_odom_body: Pose  # (4, 4) odometry of the newest frame
    few: ScanPart  # a sample
    many: ScanPart  # a sample of four times as many points
    # number of four-metre patches with structure, and of cubes with free space: upper limits of the number of
    # independent observations
    patches: tuple[float, float]
    filled: Ints  # (F,) identifiers of those patches, comparable between scans of one odometry frame

    @classmethod
    def of(cls, cloud: RegistrationCloud, frame: Points, T_odom_body: Pose) -> ObservedScan:
        """Sample a scan; ``frame`` (N, 3) is its newest frame, body frame, metres, for the rays."""
        body = T_odom_body[:3, 3]
        points = cloud.points - body.astype(np.float32)
        order = _by_patch(points)
        points, high, above = points[order], cloud.high[order], cloud.above[order]
        free = (RangeImage.of(frame).passed_points(cloud.dug) @ T_odom_body[:3, :3].T).astype(np.float32)
        kinds = points[high], points[~above], free[_by_patch(free)]
        filled = _filled(kinds[0][:, :2] + body[:2])
        patches = float(len(filled)), float(len(_filled(kinds[2])))
        few, many = (ScanPart.of(kinds, counts, 1.0 - cloud.changed) for counts in (_FEW, _MANY))
        return cls(cloud, T_odom_body, few, many, patches, filled)

    @property
    def body(self) -> Floats:
        """(3,) position of the body in the odometry frame, metres."""
        return np.asarray(self.T_odom_body[:3, 3])

    def evidence(self, field: kernels.FieldMap, T_map_odom: Pose) -> Evidence:
        """Return the evidence at a pose (4, 4), without its tilt against gravity."""
        return self.many.look_up(field, self.poses(T_map_odom[None]), Move.NONE).evidence(0)

    def poses(self, T_map_odom: Floats) -> Floats:
        """Return the poses (H, 4), as in :class:`Observations`, of the scan under level transforms (H, 4, 4)."""
        turned = T_map_odom[:, :3, :3] @ self.body + T_map_odom[:, :3, 3]
        return np.column_stack([turned, np.arctan2(T_map_odom[:, 1, 0], T_map_odom[:, 0, 0])])

    def transforms(self, poses: Floats) -> Floats:
        """Return the level ``T_map_odom`` (H, 4, 4) of the scan at poses (H, 4)."""
        T = np.tile(np.eye(4), (len(poses), 1, 1))
        cos, sin = np.cos(poses[:, 3]), np.sin(poses[:, 3])
        T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = cos, -sin, sin, cos
        T[:, :3, 3] = poses[:, :3] - T[:, :3, :3] @ self.body
        return T


def surroundings(scans: Sequence[ObservedScan]) -> float:
    """Return the joint surroundings of scans as a multiple of those of one scan; 1 if all are the same."""
    mean = float(np.mean([len(scan.filled) for scan in scans]))
    return max(1.0, len(np.unique(np.concatenate([scan.filled for scan in scans]))) / max(mean, 1.0))


@dataclass(frozen=True)
class RangeImage:
    """Nearest return of one frame by its direction from the body's origin, in cells of 2 degrees."""

    nearest: Floats32  # (C,) metres; -inf where there are too few returns
    floor: float  # height of the ground relative to the body, metres, at most 0

    @classmethod
    def of(cls, cloud: Points) -> RangeImage:
        """Sort a frame (N, 3), body frame, metres, by direction; returns within a metre are the robot's own."""
        rays = cls.rays(cloud)
        ranges = norms(rays)
        far = ranges > _MIN_RANGE
        cells = _directions(rays[far], ranges[far])
        nearest = np.full(_CELLS, np.inf, dtype=np.float32)
        np.minimum.at(nearest, cells, ranges[far])
        nearest[np.bincount(cells, minlength=_CELLS) < _BEAM_HITS] = -np.inf
        near = rays[:, 2][rays[:, 0] ** 2 + rays[:, 1] ** 2 < _FLOOR_RADIUS**2]
        floor = float(np.percentile(near, _FLOOR_PERCENTILE)) if len(near) >= _MIN_FLOOR_POINTS else 0.0
        return cls(nearest, min(0.0, floor))

    @staticmethod
    def rays(cloud: Points) -> Points:
        """Return the points of a frame (N, 3) that :meth:`of` uses; they alone give the same image."""
        return cloud[:: max(1, -(-len(cloud) // _MAX_RAYS))]

    def passed_points(self, dug: float = 0.0) -> Floats:
        """Return points (F, 3), body frame, metres, that the frame's rays passed through well above the ground.

        The surveyed ground lay ``dug`` metres higher.
        """
        points, ranges, cells = _samples()
        beyond = ranges + _MARGIN
        passed: Bools = (beyond > _MIN_RANGE) & (beyond < self.nearest[cells] - (_SLACK + _SLACK_SLOPE * beyond))
        return points[passed & (points[:, 2] > self.floor + dug + _MIN_HEIGHT)]


def _filled(points: Points | Floats) -> Ints:
    """Return the distinct identifiers of the patches, or cubes, that contain points (N, 2) or (N, 3)."""
    cell = np.floor(points * (1.0 / _PATCH)).astype(np.int64) + _OFFSET
    return np.unique(cell @ (1 << np.arange(0, 16 * points.shape[1], 16)))


def _by_patch(points: Points) -> Ints:
    x, y = np.floor(points[:, :2] / np.float32(_PATCH)).T
    return np.asarray(np.lexsort((x, y)))


def _directions(points: Points | Floats, ranges: Floats32 | Floats) -> Ints:
    """Return the cell (N,) of each point (N, 3), body frame: rows upwards, columns leftwards from straight behind."""
    turn = ((np.arctan2(points[:, 1], points[:, 0]) + np.pi) / _BEAM).astype(np.int64)
    rise = ((np.arcsin(np.clip(points[:, 2] / ranges, -1.0, 1.0)) + 0.5 * np.pi) / _BEAM).astype(np.int64)
    return np.asarray(rise * _COLUMNS + turn)


@lru_cache(maxsize=1)
def _samples() -> tuple[Floats, Floats, Ints]:
    """Return points (N, 3) spread evenly over the space around the body, their ranges and cells of direction."""
    rng = np.random.default_rng(20240)
    radius, turn = _RANGE * np.sqrt(rng.random(_SAMPLES)), 2.0 * np.pi * rng.random(_SAMPLES)
    height = rng.uniform(*_DEPTH, _SAMPLES)
    points = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), height])
    ranges = norms(points)
    return points, ranges, _directions(points, ranges)
