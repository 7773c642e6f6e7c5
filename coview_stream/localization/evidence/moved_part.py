"""Evidence of a moved part: unexplained structure of a scan that fits some metres beside the place.

Where a survey shows buildings a few metres off, but trees, poles and hedges in place, the scan fits at two places and
cannot decide between them. Objects replaced since the survey agree on a shift only by chance. So the unexplained
structure is compared with the map at shifts around the place, the best shift against the background of the others.

A patch of some metres fits by chance as a whole, like all points of a wall or along a hedge. So patches agree or not,
each against its own background. Map structure counts only where the scan has not already explained it at the place.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import coview_kernels as kernels
from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.transforms import Points, rot_z, yaw_of
from coview_stream.localization.evidence.observation import ObservedScan

# set by hand
_PRIOR = 5e-4  # probability that a survey has a part of the site shifted as a whole
_LEAST = 2.0  # metres, least shift that unexplained structure shows
FARTHEST_MOVED = 8.0
"""Metres, greatest shift of a moved part."""
_SAME = 2.5  # metres: nearer shifts explain the same points
_PATCH = 3.0  # metres
_TAKEN = 1.0  # metres from a point of the scan within which map structure is explained
_MIN_POINTS, _MAX_POINTS = 10, 512  # of unexplained points; fewer agree on any shift
_VOXEL = 0.25  # metres
_AGREEING = np.linspace(0.05, 1.0, 20)  # shares of patches that belong to the part, summed over
_FITS = 0.9  # share of a patch's points that the map explains at the right shift
_PSEUDO, _PSEUDO_SHARE = 2.0, 0.1  # prior of a patch's chance share: shifts, share
_SHARES = (0.05, 0.9)  # range of a patch's chance share


@dataclass(frozen=True)
class MovedPart:
    """Part of the scans that fits elsewhere."""

    probability: float  # that such a part exists
    metres: float  # length of its shift


NO_PART = MovedPart(0.0, 0.0)


def find_moved_part(field: kernels.FieldMap, scans: Sequence[ObservedScan], T_map_odom: Floats) -> MovedPart:
    """Search for a part of the scans (newest last) that is unexplained at a place and fits at one shift of it.

    ``T_map_odom`` (4, 4) is the place, registered at the newest keyframe: its lean is the sensor's and turns with it.
    """
    shifts = _all_shifts()
    ratios = _shift_ratios(field, SeenStructure.of(field, scans, T_map_odom), shifts)
    if ratios is None:
        return NO_PART
    best = int(ratios.argmax())
    odds = _PRIOR * math.exp(min(float(ratios[best]), 100.0)) / len(shifts)
    return MovedPart(odds / (1.0 + odds), float(np.linalg.norm(shifts[best])))


def log_odds_of_moved(
    field: kernels.FieldMap, scans: Sequence[ObservedScan], T_map_odom: Floats, T_map_other: Floats
) -> float:
    """Return the log-odds of "the robot is at the other place, and structure that fits here has moved" to "it is here".

    Here is ``T_map_odom``; other arguments are as in :func:`find_moved_part`. The rest of the view has not moved, and
    does not fit here: of the view, a share of the distribution Beta(1, 3) has moved, and if the robot is here, a share
    of the distribution Beta(1, 1) fits. No part moves farther than :data:`FARTHEST_MOVED`.
    """
    here, other = scans[-1].poses(np.stack([T_map_odom, T_map_other]))
    shift = (other - here)[:2]
    if float(np.linalg.norm(shift)) > FARTHEST_MOVED:
        return -math.inf
    seen, alone, rest, ratios = SeenStructure.of(field, scans, T_map_odom), 0.0, 0.0, None
    seen = seen.turned(float(other[3] - here[3]))
    if len(seen.explained):
        there = kernels.near_structure(field, seen.explained, seen.place, shift[None])[0]
        alone = float((1.0 - _in_patches(seen.explained) @ there.astype(np.float64)).sum())
    if len(seen.unexplained) >= _MIN_POINTS:
        rest = float(len(_in_patches(seen.unexplained)))
    if float(np.linalg.norm(shift)) >= _LEAST:
        ratios = _shift_ratios(field, seen, np.concatenate([_all_shifts(), shift[None]]))
    share = 3.0 * (rest + 1.0) * (rest + 2.0) / ((alone + rest + 2.0) * (alone + rest + 3.0))
    return math.log(_PRIOR * share) + (0.0 if ratios is None else float(ratios[-1]))


def _all_shifts() -> Floats:
    """Return (H, 2) the shifts tried, a metre apart."""
    axis = np.arange(-FARTHEST_MOVED, FARTHEST_MOVED + 0.5)
    shifts: Floats = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    length = np.linalg.norm(shifts, axis=1)
    return np.asarray(shifts[(length >= _LEAST) & (length <= FARTHEST_MOVED)])


def _shift_ratios(field: kernels.FieldMap, seen: SeenStructure, shifts: Floats) -> Floats | None:
    """Return the log-ratios (H,) of "unexplained structure belongs at this shift" to chance; None for few points."""
    if len(seen.unexplained) < _MIN_POINTS:
        return None
    fits = _in_patches(seen.unexplained) @ _explained(field, seen, shifts).T  # (P, H) shares
    chance = np.ones(len(shifts), dtype=bool)
    for _ in range(2):
        usual = (fits[:, chance].sum(axis=1) + _PSEUDO * _PSEUDO_SHARE) / (int(chance.sum()) + _PSEUDO)
        ratios = _log_likelihood_ratios(fits, np.clip(usual, *_SHARES))
        best = int(ratios.argmax())
        chance = np.linalg.norm(shifts - shifts[best], axis=1) > _SAME
    return ratios


def _in_patches(points: Points) -> Floats:
    """Return weights (P, N) of points (N, 3) that average over each of P patches."""
    patch = np.unique(_cells(points[:, :2], _PATCH), return_inverse=True)[1]
    weights = (patch == np.arange(int(patch.max()) + 1)[:, None]).astype(np.float64)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


@dataclass(frozen=True)
class SeenStructure:
    """The scans' structure, all (N, 3) relative to the body along the map's axes, at a place."""

    place: Floats  # (4,) x, y, z and 0
    structure: Points
    explained: Points  # a sample
    unexplained: Points  # a sample

    def turned(self, angle: float) -> SeenStructure:
        """Return the structure turned about the body by an angle, radians."""
        R = rot_z(angle).T.astype(np.float32)
        return SeenStructure(self.place, self.structure @ R, self.explained @ R, self.unexplained @ R)

    @classmethod
    def of(cls, field: kernels.FieldMap, scans: Sequence[ObservedScan], T_map_odom: Floats) -> SeenStructure:
        """Look at scans, newest last, from a place ``T_map_odom`` (4, 4)."""
        place = scans[-1].poses(T_map_odom[None])[0]
        place[3] = 0.0
        shown, unexplained = [], []
        T, newest = T_map_odom[None], scans[-1].T_odom_body[:3, :3]
        lean = newest.T @ rot_z(-yaw_of(T_map_odom)) @ T_map_odom[:3, :3] @ newest  # in the body's axes
        for scan in reversed(scans):
            R = scan.T_odom_body[:3, :3]
            upright = (scan.many.points.structure @ (R @ lean @ R.T).T).astype(np.float32)
            pose = scan.poses(T)
            if scan is not scans[-1]:  # undo odometry's drift since then
                pose = scan.few.look_up(field, pose, kernels.Move.NEAR).poses
            T = scan.transforms(pose)
            cos, sin = math.cos(pose[0, 3]), math.sin(pose[0, 3])
            turned = upright @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
            shown.append((turned + (pose[0, :3] - place[:3])).astype(np.float32))
            unexplained.append(kernels.unexplained(field, upright, pose[0]))
        structure, hidden = np.concatenate(shown), np.concatenate(unexplained)
        return cls(place, structure, _sample(structure[~hidden]), _sample(structure[hidden]))


def _sample(points: Points) -> Points:
    """Return one point per voxel, some hundreds at most."""
    _, first = np.unique(_cells(points, _VOXEL), return_index=True)
    points = points[np.sort(first)]
    if len(points) > _MAX_POINTS:
        points = points[np.linspace(0, len(points) - 1, _MAX_POINTS).astype(np.int64)]
    return points


def _cells(points: Points, size: float) -> Ints:
    """Return the numbers (N,) of the cells of an edge ``size`` that hold points (N, D), in the order of x, y, ..."""
    cell = np.floor(points / np.float32(size)).astype(np.int64) + (1 << 20)
    return np.asarray(cell @ (1 << np.arange(21 * (points.shape[1] - 1), -1, -21)))


def _explained(field: kernels.FieldMap, seen: SeenStructure, shifts: Floats) -> Floats:
    """Return (H, N): 1 where an unexplained point, shifted (H, 2), is near map structure without any of the scan."""
    explained = kernels.near_structure(field, seen.unexplained, seen.place, shifts)
    shift, point = np.nonzero(explained)
    if len(point):
        moved = seen.unexplained[point]
        moved[:, :2] += shifts[shift].astype(np.float32)
        distance, _ = kernels.nearest(kernels.PointGrid(seen.structure), moved, _TAKEN)
        explained[shift, point] = ~np.isfinite(distance)
    return explained.astype(np.float64)


def _log_likelihood_ratios(fits: Floats, usual: Floats) -> Floats:
    """Return the log-ratios (H,) of "a share of the patches belongs here" against "they fit by chance".

    ``fits`` (P, H) are explained shares of the patches at the shifts, ``usual`` (P,) their chance shares.
    """
    share = _AGREEING[:, None] * _FITS + (1.0 - _AGREEING[:, None]) * usual  # (Q, P)
    table = np.log(share / usual) @ fits + np.log((1.0 - share) / (1.0 - usual)) @ (1.0 - fits)
    top = table.max(axis=0)
    return np.asarray(np.log(np.exp(table - top).mean(axis=0)) + top)
