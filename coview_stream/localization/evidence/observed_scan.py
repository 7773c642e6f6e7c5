"""Observations: what of a scan the map explains at a pose, counted by looking up in its likelihood field.

Each point that stands above the ground is explained (map structure in its cell, or within half a metre, or it stands
below a roof edge, as walls do that a survey from above does not show), unexplained, or not covered by the map. Each
point on the ground lies on the map's ground or not, or is not covered. Each point that a ray has passed through is
free in the map, or the map is contradicted there. Shares of these are compared, not counts: an observation is a row
(7,) of shares in [0, 1] of all points of its kind, see :class:`Share`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import Literal

import numpy as np

import coview_kernels as kernels
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Ints
from coview_stream.geometry.transforms import Points, norms
from coview_stream.localization.registration.register import ScanInput
from coview_stream.localization.registration.verification import (
    FREE_HEIGHT,
    FREE_RANGE,
    MIN_STRUCTURE,
    PSEUDO,
    STRUCTURE_HEIGHT,
    RangeImage,
)

# set by hand
_FEW, _MANY = (256, 128, 192), (1024, 512, 768)  # structure, ground and free points that are looked up
_PATCH = 4.0  # metres: points of one patch are looked up one after the other, for they lie in the same memory
_OFFSET = 1 << 15  # patches: numbers of them are never negative
_SAMPLES = 6000  # points in the space around the robot, of which those that rays passed through are looked up
_DEPTH = (-3.0, 9.0)  # metres, their heights relative to the sensor
_MARGIN = 0.35  # metres that a cell of the field reaches beyond its middle: a ray has passed only what lies before that
_LAYERS = 2  # cells that a surface fills on the way through it


class Share(IntEnum):
    """Columns of an observation: shares of the scan's points of a kind."""

    ON = 0
    """Of the structure: in a cell of half a metre that has map structure."""
    NEAR = 1
    """Of the structure: within about half a metre of map structure; those that are on it among them."""
    EDGE = 2
    """Of the structure: not near, but below a roof edge."""
    COVERED = 3
    """Of the structure: where the map has been surveyed."""
    GROUND = 4
    """Of the points on the ground: on the map's ground."""
    COVERED_GROUND = 5
    """Of the points on the ground: where the map has been surveyed."""
    PASSED = 6
    """Of the points that rays passed through: on map structure."""


@dataclass(frozen=True)
class ScanPart:
    """Some of a scan's points, which are looked up.

    Attributes:
        points: of each kind, relative to the body, axes of the odometry frame, metres.
        every: how many of the scan's each of its structure, ground and free points stands for.
    """

    points: kernels.FieldScan
    every: tuple[float, float, float]

    @classmethod
    def of(cls, kinds: tuple[Points, Points, Points], counts: tuple[int, int, int]) -> ScanPart:
        """Take at most ``counts`` points of each kind."""
        some = [_evenly(points, count) for points, count in zip(kinds, counts, strict=True)]
        structure, low, free = (len(p) / max(len(s), 1) for p, s in zip(kinds, some, strict=True))
        return cls(kernels.FieldScan(*some), (structure, low, free))

    def look_up(
        self, field: kernels.FieldMap, poses: Floats, move: Literal["far", "near", "no"]
    ) -> tuple[Floats, Floats32, Floats32]:
        """Observe the map from poses (H, 4): x, y, z of the body in the map, metres, heading of the odometry frame.

        Args:
            field: the map's.
            poses: where.
            move: each to the best pose within 3 m and 7 degrees first ("far"), within 0.4 m and 0.8 degrees ("near"),
                which is what odometry drifts by between keyframes, or not.

        Returns:
            Poses (H, 4), observations (H, 7), and the scores (H,) that verification computes exactly, as the field has
            them.
        """
        found = kernels.field_scores(field, self.points, poses, refine=move != "no", near=move == "near")
        return found.pose, self._shares(found), self._scores(found)

    def _shares(self, found: kernels.FieldScores) -> Floats32:
        structure, low, free = (max(len(p), 1) for p in (self.points.structure, self.points.low, self.points.free))
        columns = (
            found.on / structure, found.near / structure, (found.covered - found.near) / structure,
            found.structure / structure, found.grounded / low, found.low / low, found.passed / free,
        )  # fmt: skip
        return np.column_stack(columns).astype(np.float32)

    def _scores(self, found: kernels.FieldScores) -> Floats32:
        each_high, each_low, each_free = self.every
        structure, low, near = found.structure * each_high, found.low * each_low, found.near * each_high
        some = np.maximum(found.structure, 1)
        ground = (found.grounded * each_low + 0.5 * PSEUDO) / (low + PSEUDO)
        passed = found.passed * each_free * _points_passed()
        free = (near + 0.5 * PSEUDO) / (near + passed + PSEUDO)
        score = np.sqrt(found.near / some * (found.covered / some) * ground * free)
        score[structure < MIN_STRUCTURE] = 0.0
        return score.astype(np.float32)


@dataclass(frozen=True)
class ObservedScan:
    """A scan as it is compared with the field: few points for many poses, many for the best.

    Attributes:
        body: (3,) position of the body in the odometry frame, metres.
        few: some points.
        many: four times as many.
        patches: patches of four metres that its structure fills, and cubes that its free space does: no more
            observations than these are independent.
        filled: (F,) numbers of those patches, the same for all scans of one odometry.
    """

    body: Floats
    few: ScanPart
    many: ScanPart
    patches: tuple[float, float]
    filled: Ints

    @classmethod
    def of(cls, scan: ScanInput) -> ObservedScan:
        """Choose the points of a scan."""
        cloud, T = scan.cloud, scan.T_odom_body
        points = cloud.points - T[:3, 3].astype(np.float32)
        order = _by_patch(points)
        points, height, above = points[order], cloud.height[order], cloud.above[order]
        free = (_seen_through(scan.range_image) @ T[:3, :3].T).astype(np.float32)
        kinds = points[height > STRUCTURE_HEIGHT], points[~above], free[_by_patch(free)]
        filled = _filled(kinds[0][:, :2] + T[:2, 3])
        patches = float(len(filled)), float(len(_filled(kinds[2])))
        return cls(np.asarray(T[:3, 3]), ScanPart.of(kinds, _FEW), ScanPart.of(kinds, _MANY), patches, filled)

    def poses(self, T_map_odom: Floats) -> Floats:
        """Return the poses (H, 4) at which level transforms (H, 4, 4) put the scan, as :meth:`ScanPart.look_up`."""
        turned = T_map_odom[:, :3, :3] @ self.body + T_map_odom[:, :3, 3]
        return np.column_stack([turned, np.arctan2(T_map_odom[:, 1, 0], T_map_odom[:, 0, 0])])

    def transforms(self, poses: Floats) -> Floats:
        """Return the level ``T_map_odom`` (H, 4, 4) that put the scan at poses (H, 4)."""
        T = np.tile(np.eye(4), (len(poses), 1, 1))
        cos, sin = np.cos(poses[:, 3]), np.sin(poses[:, 3])
        T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = cos, -sin, sin, cos
        T[:, :3, 3] = poses[:, :3] - T[:, :3, :3] @ self.body
        return T


def _evenly(points: Points, count: int) -> Points:
    """Return at most ``count`` points, spread evenly over all in their order."""
    return points[np.linspace(0, len(points) - 1, count).astype(np.int64)] if len(points) > count else points


def surroundings(scans: Sequence[ObservedScan]) -> float:
    """Return how many times the surroundings of one of some scans all of them together have seen; 1 if all the same."""
    each = float(np.mean([len(scan.filled) for scan in scans]))
    return max(1.0, len(np.unique(np.concatenate([scan.filled for scan in scans]))) / max(each, 1.0))


def _filled(points: Points | Floats) -> Ints:
    """Return the numbers of the patches, or cubes, that points (N, 2) or (N, 3) lie in, each once."""
    cell = np.floor(points * (1.0 / _PATCH)).astype(np.int64) + _OFFSET
    return np.unique(cell @ (1 << np.arange(0, 16 * points.shape[1], 16)))


def _by_patch(points: Points) -> Ints:
    x, y = np.floor(points[:, :2] / np.float32(_PATCH)).T
    return np.asarray(np.lexsort((x, y)))


def _seen_through(seen: RangeImage) -> Floats:
    """Return points (F, 3), body frame, metres, that the frame's rays passed through well above the ground."""
    points, ranges, cell = _samples()
    passed: Bools = seen.passed(cell, ranges + _MARGIN) & (points[:, 2] > seen.floor + FREE_HEIGHT)
    return points[passed]


@lru_cache(maxsize=1)
def _samples() -> tuple[Floats, Floats, Ints]:
    """Return points (N, 3), evenly in the space around the sensor, their ranges and cells of direction."""
    rng = np.random.default_rng(20240)
    radius, turn = FREE_RANGE * np.sqrt(rng.random(_SAMPLES)), 2.0 * np.pi * rng.random(_SAMPLES)
    height = rng.uniform(*_DEPTH, _SAMPLES)
    points = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), height])
    ranges = norms(points)
    return points, ranges, RangeImage.cells(points, ranges)


def _points_passed(voxel: float = 0.5) -> float:
    """Return how many points of a scan, one for each ``voxel``, the surface would have that a passed sample is on."""
    volume = np.pi * FREE_RANGE**2 * (_DEPTH[1] - _DEPTH[0]) / _SAMPLES
    return float(volume / (_LAYERS * 0.5) / voxel**2)
