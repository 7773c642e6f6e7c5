"""Evidence of a moved part: what a place leaves unexplained may all be explained some metres beside it.

Where a survey has the buildings a few metres off, and trees, poles and hedges where they are, the scan fits at two
places: most of it at one, and what is left at the other. Which of the two is right nothing here can tell. Objects that
were replaced since the survey do not agree on a shift, but for chance: so what the place leaves unexplained is held
against the map at shifts all around it, the best shift against the background of the others.

Chance moves a patch of some metres as a whole: a wall that fits at a wrong shift fits with all its points, and a hedge
along itself. So patches are what agrees or not, each with its own background. And what stands at the shift has to be
something that the scan misses at the place: map structure that the scan has explained there is no second time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

import coview_kernels as kernels
from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.transforms import Points
from coview_stream.localization.evidence.observation import ObservedScan

# set by hand
_PRIOR = 5e-4  # probability that a survey has a part of the site shifted as a whole
_LEAST, _MOST = 2.0, 8.0  # metres, of shifts
_SAME = 2.5  # metres: shifts that share what they explain
_PATCH = 3.0  # metres: points that agree or not as one
_TAKEN = 1.0  # metres from any point of the scan: what the map has there, the scan has explained
_MIN_POINTS, _MAX_POINTS = 10, 512  # left unexplained; fewer agree on anything
_VOXEL = 0.25  # metres, of what several keyframes see
_AGREEING = np.linspace(0.05, 1.0, 20)  # shares of the patches that stayed, which are summed over
_FITS = 0.9  # share of a patch's points that the map explains where it belongs
_PSEUDO, _PSEUDO_SHARE = 2.0, 0.1  # shifts at which each patch is presumed to fit by so much
_SHARES = (0.05, 0.9)  # of a patch by chance


@dataclass(frozen=True)
class MovedPart:
    """A part of what is seen that fits elsewhere.

    Attributes:
        probability: that there is one.
        metres: how far off it fits.
    """

    probability: float
    metres: float


NO_PART = MovedPart(0.0, 0.0)


def find_moved_part(field: kernels.FieldMap, scans: Sequence[ObservedScan], T_map_odom: Floats) -> MovedPart:
    """Look for a part of what is seen that is unexplained at a place and fits at one shift of it.

    Args:
        field: the map's.
        scans: of the newest keyframes, the newest last.
        T_map_odom: (4, 4) the place, level, at the newest of them.
    """
    place = scans[-1].poses(T_map_odom[None])[0]
    place[3] = 0.0  # points are relative to the body and along the map's axes from here on
    every, left = _seen(field, scans, T_map_odom, place)
    if len(left) < _MIN_POINTS:
        return NO_PART
    shifts = _shifts()
    fits = _patches(left) @ _explained(field, left, every, shifts, place).T  # (P, H) shares
    chance = np.ones(len(shifts), dtype=bool)
    for _ in range(2):
        usual = (fits[:, chance].sum(axis=1) + _PSEUDO * _PSEUDO_SHARE) / (int(chance.sum()) + _PSEUDO)
        ratios = _log_likelihood_ratios(fits, np.clip(usual, *_SHARES))
        best = int(ratios.argmax())
        chance = np.linalg.norm(shifts - shifts[best], axis=1) > _SAME
    odds = _PRIOR * math.exp(min(float(ratios[best]), 100.0)) / len(shifts)
    return MovedPart(odds / (1.0 + odds), float(np.linalg.norm(shifts[best])))


def _seen(
    field: kernels.FieldMap, scans: Sequence[ObservedScan], T_map_odom: Floats, place: Floats
) -> tuple[Points, Points]:
    """Return the structure that scans see at a place, all of it and some of what is unexplained, both (N, 3)."""
    every, left = [], []
    T = T_map_odom[None]
    for scan in reversed(scans):
        pose, structure = scan.poses(T), scan.many.points.structure
        if scan is not scans[-1]:  # the drift since then undone
            pose = scan.few.look_up(field, pose, kernels.Move.NEAR).poses
            T = scan.transforms(pose)
        cos, sin = math.cos(pose[0, 3]), math.sin(pose[0, 3])
        turned = structure @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        every.append((turned + (pose[0, :3] - place[:3])).astype(np.float32))
        left.append(every[-1][kernels.unexplained(field, structure, pose[0])])
    points = np.concatenate(left)
    _, first = np.unique(np.floor(points / np.float32(_VOXEL)).astype(np.int64), axis=0, return_index=True)
    points = points[np.sort(first)]
    if len(points) > _MAX_POINTS:
        points = points[np.linspace(0, len(points) - 1, _MAX_POINTS).astype(np.int64)]
    return np.concatenate(every), points


def _explained(field: kernels.FieldMap, points: Points, every: Points, shifts: Floats, place: Floats) -> Floats:
    """Tell which points (N, 3) at which shifts (H, 2) lie near map structure that the scan misses at the place: 1, 0.

    Args:
        field: the map's.
        points: relative to the place.
        every: (M, 3) structure that the scan sees, likewise.
        shifts: metres.
        place: (4,) pose, heading 0.
    """
    moved = np.repeat(points[None], len(shifts), axis=0)
    moved[:, :, :2] += shifts[:, None].astype(np.float32)
    flat = moved.reshape(-1, 3)
    near = np.flatnonzero(kernels.near_structure(field, flat, place))
    out = np.zeros(len(flat))
    if len(near):
        distance, _ = cKDTree(every).query(flat[near], distance_upper_bound=_TAKEN)
        out[near[~np.isfinite(distance)]] = 1.0
    return out.reshape(len(shifts), len(points))


def _patches(points: Points) -> Floats:
    """Return weights (P, N) of points in the patches that they form, level squares; those of each add up to one."""
    _, patch = np.unique(np.floor(points[:, :2] / np.float32(_PATCH)).astype(np.int64), axis=0, return_inverse=True)
    own: Ints = np.ravel(patch)
    weights = np.zeros((int(own.max()) + 1, len(points)))
    weights[own, np.arange(len(points))] = 1.0
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _log_likelihood_ratios(fits: Floats, usual: Floats) -> Floats:
    """Return the ratios (H,) of "a share of the patches belongs here" against "they fit by chance".

    Args:
        fits: (P, H) shares of the patches' points that are explained at each shift.
        usual: (P,) what each patch's is by chance.
    """
    share = _AGREEING[:, None] * _FITS + (1.0 - _AGREEING[:, None]) * usual  # (Q, P)
    each = np.log(share / usual) @ fits + np.log((1.0 - share) / (1.0 - usual)) @ (1.0 - fits)
    top = each.max(axis=0)
    return np.asarray(np.log(np.exp(each - top).mean(axis=0)) + top)


def _shifts() -> Floats:
    """Return shifts (H, 2) on a grid, metres."""
    axis = np.arange(-_MOST, _MOST + 0.5)
    every = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    length = np.linalg.norm(every, axis=1)
    return np.asarray(every[(length >= _LEAST) & (length <= _MOST)])
