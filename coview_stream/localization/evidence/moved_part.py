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
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, rot_z, yaw_of
from coview_stream.localization.evidence.observation import ObservedScan

# set by hand
_PRIOR = 5e-4  # probability that a survey has a part of the site shifted as a whole
_LEAST, _MOST = 2.0, 8.0  # metres, range of the shifts
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
    place = scans[-1].poses(T_map_odom[None])[0]
    place[3] = 0.0  # from here on points are relative to the body, along the map's axes
    structure, unexplained = _structure(field, scans, T_map_odom, place)
    if len(unexplained) < _MIN_POINTS:
        return NO_PART
    axis = np.arange(-_MOST, _MOST + 0.5)
    shifts: Floats = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    length = np.linalg.norm(shifts, axis=1)
    shifts = shifts[(length >= _LEAST) & (length <= _MOST)]
    cell = np.floor(unexplained[:, :2] / np.float32(_PATCH)).astype(np.int64)
    patch = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    weights = (patch == np.arange(int(patch.max()) + 1)[:, None]).astype(np.float64)  # of points in patches
    weights /= weights.sum(axis=1, keepdims=True)
    fits = weights @ _explained(field, unexplained, structure, shifts, place).T  # (P, H) shares
    chance = np.ones(len(shifts), dtype=bool)
    for _ in range(2):
        usual = (fits[:, chance].sum(axis=1) + _PSEUDO * _PSEUDO_SHARE) / (int(chance.sum()) + _PSEUDO)
        ratios = _log_likelihood_ratios(fits, np.clip(usual, *_SHARES))
        best = int(ratios.argmax())
        chance = np.linalg.norm(shifts - shifts[best], axis=1) > _SAME
    odds = _PRIOR * math.exp(min(float(ratios[best]), 100.0)) / len(shifts)
    return MovedPart(odds / (1.0 + odds), float(np.linalg.norm(shifts[best])))


def _structure(
    field: kernels.FieldMap, scans: Sequence[ObservedScan], T_map_odom: Floats, place: Floats
) -> tuple[Points, Points]:
    """Return the scans' structure at a place, and a sample of its unexplained points, both (N, 3)."""
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
        unexplained.append(shown[-1][kernels.unexplained(field, upright, pose[0])])
    points = np.concatenate(unexplained)
    _, first = np.unique(np.floor(points / np.float32(_VOXEL)).astype(np.int64), axis=0, return_index=True)
    points = points[np.sort(first)]
    if len(points) > _MAX_POINTS:
        points = points[np.linspace(0, len(points) - 1, _MAX_POINTS).astype(np.int64)]
    return np.concatenate(shown), points


def _explained(field: kernels.FieldMap, points: Points, structure: Points, shifts: Floats, place: Floats) -> Floats:
    """Return (H, N): 1 where a point (N, 3), at a shift (H, 2) of a place (4,), is near unexplained map structure.

    ``points`` and the scan's ``structure`` (M, 3) are relative to the place.
    """
    explained = kernels.near_structure(field, points, place, shifts)
    shift, point = np.nonzero(explained)
    if len(point):
        moved = points[point]
        moved[:, :2] += shifts[shift].astype(np.float32)
        distance, _ = kernels.nearest(kernels.PointGrid(structure), moved, _TAKEN)
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
