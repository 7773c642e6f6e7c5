"""Scores of hypotheses by the map's likelihood field: hundreds of one keyframe at once, before any is registered.

Each hypothesis is moved to the best pose around it, up to three metres and seven degrees away, by looking up what the
map has there (:func:`coview_kernels.field_scores`), and scored by the shares that verification computes exactly
(:mod:`coview_stream.localization.registration.verification`). ``python -m bench field`` prints how often the right
place comes first, and how the two scores compare.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

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
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.request import SAME_ANGLE, SAME_DISTANCE

# set by hand
_FEW, _MANY = (256, 128, 192), (1024, 512, 768)  # structure, ground and free points that are looked up
_PROMISING = 64  # best hypotheses that are looked up with the many
_PATCH = 4.0  # metres: points of one patch are looked up one after the other, for they lie in the same memory
_SAMPLES = 6000  # points in the space around the robot, of which those that rays passed through are looked up
_DEPTH = (-3.0, 9.0)  # metres, their heights relative to the sensor
_MARGIN = 0.35  # metres that a cell of the field reaches beyond its middle: a ray has passed only what lies before that
_LAYERS = 2  # cells that a surface fills on the way through it


@dataclass(frozen=True)
class ScoredPlace:
    """A hypothesis at the best pose near it.

    Attributes:
        hypothesis: there; with the lead that any of those had which came to this place.
        score: evidence score in [0, 1], as the field sees it.
        inside: share of the scan that lies where the map has been surveyed.
        hinted: whether a pose hint came to this place.
    """

    hypothesis: Hypothesis
    score: float
    inside: float
    hinted: bool = False

    @property
    def rank(self) -> float:
        """Score times the share that lies inside: what lies beyond the map is not explained by it."""
        return self.score * self.inside


@dataclass(frozen=True)
class Rivals:
    """All places that one keyframe was scored at, best first; no two are the same.

    Attributes:
        T_map_odom: (N, 4, 4).
        scores: (N,) float32 evidence scores in [0, 1]; those of the best 64 hypotheses from four times as many points.
        inside: (N,) float32 shares of the scan that lie where the map has been surveyed.
    """

    T_map_odom: Floats
    scores: Floats32
    inside: Floats32

    def __len__(self) -> int:
        """Return the number of places N."""
        return len(self.scores)

    @classmethod
    def none(cls) -> Rivals:
        """Return no places."""
        nothing = np.empty(0, dtype=np.float32)
        return cls(np.empty((0, 4, 4)), nothing, nothing)


@dataclass(frozen=True)
class Scored:
    """What a keyframe's hypotheses came to.

    Attributes:
        rivals: all places.
        places: the best of them, and those that hints came to, best first.
    """

    rivals: Rivals
    places: list[ScoredPlace]


def score_hypotheses(
    field: kernels.FieldMap, hypotheses: Sequence[Hypothesis], scan: ScanInput, best: int, hints: int = 0
) -> Scored:
    """Score hypotheses of ``T_map_odom``, of which the last ``hints`` are pose hints.

    Hypotheses that come to the same place (2 m, 5 degrees) are one: the best of them. The ``best`` places are returned
    as hypotheses again.
    """
    if not hypotheses:
        return Scored(Rivals.none(), [])
    pivot = scan.T_odom_body[:3, 3]
    T = np.array([each.T_map_odom for each in hypotheses])
    yaw = np.arctan2(T[:, 1, 0], T[:, 0, 0])
    few, many = _field_scans(scan)
    found = kernels.field_scores(field, few.scan, np.column_stack([T[:, :3, :3] @ pivot + T[:, :3, 3], yaw]))
    score, inside = few.scores(found)
    # some points tell what is far below the best; what is not is told apart by more
    promising = np.argsort(-score * inside, kind="stable")[:_PROMISING]
    score[promising], inside[promising] = many.scores(
        kernels.field_scores(field, many.scan, found.pose[promising], refine=False)
    )
    T = _poses(found.pose, pivot)
    members = _places(found.pose, score * inside)
    firsts = np.array([each[0] for each in members])
    rivals = Rivals(T[firsts], score[firsts].astype(np.float32), inside[firsts].astype(np.float32))
    last = len(hypotheses) - hints  # what follows are hints
    places = []
    for rank, numbers in enumerate(members):
        hinted = hints > 0 and max(numbers) >= last
        if rank < best or hinted:
            first, here = numbers[0], [hypotheses[k] for k in numbers]
            # the votes for the place, if it has any: a hint that came to it, now or before, takes none away
            own = next((each for each in here if each.station is not None), here[0])
            own = replace(own, T_map_odom=T[first], lead=max(each.lead for each in here))
            places.append(ScoredPlace(own, float(score[first]), float(inside[first]), hinted))
    return Scored(rivals, places)


@dataclass(frozen=True)
class _Compared:
    """A part of a scan that is compared with the field.

    Attributes:
        scan: points.
        every: how many of the scan's each of its structure, ground and free points stands for.
    """

    scan: kernels.FieldScan
    every: tuple[float, float, float]

    @classmethod
    def of(cls, kinds: tuple[Points, Points, Points], counts: tuple[int, int, int]) -> _Compared:
        """Take at most ``counts`` points of each kind."""
        some = [_evenly(points, count) for points, count in zip(kinds, counts, strict=True)]
        structure, low, free = (len(p) / max(len(s), 1) for p, s in zip(kinds, some, strict=True))
        return cls(kernels.FieldScan(*some), (structure, low, free))

    def scores(self, found: kernels.FieldScores) -> tuple[Floats, Floats]:
        """Return evidence scores (H,) and shares inside (H,)."""
        each_high, each_low, each_free = self.every
        structure, low, near = found.structure * each_high, found.low * each_low, found.near * each_high
        some = np.maximum(found.structure, 1)
        ground = (found.grounded * each_low + 0.5 * PSEUDO) / (low + PSEUDO)
        passed = found.passed * each_free * _points_passed()
        free = (near + 0.5 * PSEUDO) / (near + passed + PSEUDO)
        score = np.sqrt(found.near / some * (found.covered / some) * ground * free)
        score[structure < MIN_STRUCTURE] = 0.0
        whole = len(self.scan.structure) * each_high + len(self.scan.low) * each_low
        return score, (structure + low) / max(whole, 1.0)


def _places(pose: Floats, rank: Floats) -> list[list[int]]:
    """Group poses (H, 4): those at each place, its best first, the best place first."""
    order = np.argsort(-rank, kind="stable")
    x, y, z, yaw = pose[order].astype(np.float32).T
    cos, sin = np.cos(yaw), np.sin(yaw)
    gap = np.square(x[:, None] - x)
    gap += np.square(y[:, None] - y)
    gap += np.square(z[:, None] - z)
    along = np.outer(cos, cos)
    along += np.outer(sin, sin)
    same = (gap < SAME_DISTANCE**2) & (along > np.cos(SAME_ANGLE))
    free = np.ones(len(order), dtype=bool)
    out = []
    for k, row in enumerate(same):
        if free[k]:
            members = np.flatnonzero(row & free)
            free[members] = False
            out.append(order[members].tolist())
    return out


def _poses(pose: Floats, pivot: Floats) -> Floats:
    """Return ``T_map_odom`` (H, 4, 4) that put the pivot (3,) at poses (H, 4)."""
    T = np.tile(np.eye(4), (len(pose), 1, 1))
    cos, sin = np.cos(pose[:, 3]), np.sin(pose[:, 3])
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = cos, -sin, sin, cos
    T[:, :3, 3] = pose[:, :3] - T[:, :3, :3] @ pivot
    return T


def _field_scans(scan: ScanInput) -> tuple[_Compared, _Compared]:
    """Return few and many points of a scan, relative to the body."""
    cloud, T = scan.cloud, scan.T_odom_body
    points = cloud.points - T[:3, 3].astype(np.float32)
    order = _by_patch(points)
    points, height, above = points[order], cloud.height[order], cloud.above[order]
    free = (_seen_through(scan.range_image) @ T[:3, :3].T).astype(np.float32)
    kinds = points[height > STRUCTURE_HEIGHT], points[~above], free[_by_patch(free)]
    return _Compared.of(kinds, _FEW), _Compared.of(kinds, _MANY)


def _evenly(points: Points, count: int) -> Points:
    """Return at most ``count`` points, spread evenly over all in their order."""
    return points[np.linspace(0, len(points) - 1, count).astype(np.int64)] if len(points) > count else points


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
