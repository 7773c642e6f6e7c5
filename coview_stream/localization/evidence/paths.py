"""Paths: the poses of places at all keyframes of a search, and the best shift of each.

Each keyframe moves a place to the pose nearby with the most hits. On a sparse survey this is metres off, in another
direction at each keyframe, and neighbouring places have nearly equal evidence. Odometry hardly drifts between
keyframes, so the poses of a place are smoothed to a path, and the path is shifted and turned as a whole to the largest
evidence of all keyframes.

The likelihood ratio of a place is the mean over equally probable shifts. A mean of ratios against chance is again a
ratio: chance exceeds R with probability 1 / R at most. Turns at the best shift add a factor, their mean against none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

import coview_kernels as kernels
from coview_stream.geometry.arrays import Bools, Floats, Floats32
from coview_stream.localization.evidence.background import NEARBY_VARIANCE, Background, observe_around
from coview_stream.localization.evidence.likelihood import log_likelihood_ratios
from coview_stream.localization.evidence.observation import ObservedScan, Share

_SHIFTS: Floats = np.array([(x, y, 0.0, 0.0) for y in range(-2, 3) for x in range(-2, 3)], dtype=np.float64)
"""Shifts of a path, metres: the basin of a place."""
_TURNS: Floats = np.radians(1.0) * np.array([[0.0, 0.0, 0.0, turn] for turn in (-1, 0, 1)])  # of a shifted path
_DRIFT = 0.02, 0.05  # of odometry between keyframes, one sigma: share of the distance, and metres
SCATTER = 0.2
"""Metres of a pose about its path where few poses show it: cells are half a metre wide."""
_WEIGHT = 4.0  # of that scatter, in degrees of freedom


class Settled(NamedTuple):
    """P places at the best shifts of their paths."""

    poses: Floats  # (P, 4) at the newest keyframe, best first shifted, then turned
    observed: Floats32  # (P, 15) mean observations there
    shifted: Floats  # (P, S, 4) poses of all shifts at the newest keyframe
    table: Floats  # (P, S) log-likelihood ratios of the shifts against chance, with the mean factor of turns

    def ratios(self, count: Bools | None = None) -> Floats:
        """Return log-likelihood ratios (P,) of the places, by the shifts in the mask ``count`` (P, S), default all."""
        table = self.table if count is None else np.where(count, self.table, -np.inf)
        return np.asarray(np.logaddexp.reduce(table, axis=1) - np.log(table.shape[1]))


def look_back(field: kernels.FieldMap, scans: Sequence[ObservedScan], T_map_odom: Floats) -> tuple[Floats32, Floats]:
    """Return observations (P, W, 15) of scans, oldest first, at places ``T_map_odom`` (P, 4, 4), and poses (P, W, 4).

    Each scan starts at the pose of the next newer scan and moves to most hits nearby, which undoes odometry's drift.
    """
    observed = np.empty((len(T_map_odom), len(scans), NEARBY_VARIANCE.stop), dtype=np.float32)
    poses = np.empty((len(T_map_odom), len(scans), 4))
    for k, scan in reversed(list(enumerate(scans))):
        there = scan.few.look_up(field, scan.poses(T_map_odom), kernels.Move.NEAR)
        observed[:, k] = np.column_stack([there.shares, observe_around(field, scan.few, there.poses)])
        poses[:, k], T_map_odom = there.poses, scan.transforms(there.poses)
    return observed, poses


@dataclass(frozen=True)
class Paths:
    """Poses of P places at W keyframes, oldest first."""

    field: kernels.FieldMap
    scans: Sequence[ObservedScan]  # (W,) of the keyframes
    poses: Floats  # (P, W, 4)
    around: Floats32  # (P, 8) outcomes around the places and their variances, means over the keyframes

    @classmethod
    def of(cls, field: kernels.FieldMap, scans: Sequence[ObservedScan], poses: Floats, observed: Floats32) -> Paths:
        """Smooth the poses (P, W, 4) of places with observations (P, W, 15), as :func:`look_back` returns them."""
        newest = scans[-1].transforms(poses[:, -1])
        straight = np.stack([scan.poses(newest) for scan in scans], axis=1)
        offsets = poses - straight
        offsets[:, :, 3] = (offsets[:, :, 3] + np.pi) % (2.0 * np.pi) - np.pi
        smooth = straight + smoothed(offsets, np.array([scan.body for scan in scans]))
        return cls(field, scans, smooth, observed[:, :, len(Share) :].mean(axis=1))

    def observe(self, moves: Floats, many: bool = False) -> Floats32:
        """Return mean observations (P, M, 15) over the keyframes with the paths moved by ``moves`` (P, M, 4)."""
        places, count, _ = moves.shape
        total = np.zeros((places * count, len(Share)), dtype=np.float32)
        for k, scan in enumerate(self.scans):
            part, at = scan.many if many else scan.few, (self.poses[:, k, None] + moves).reshape(-1, 4)
            total += part.look_up(self.field, at, kernels.Move.HEIGHT).shares
        around = np.repeat(self.around, count, axis=0)
        return np.column_stack([total / len(self.scans), around]).reshape(places, count, -1).astype(np.float32)

    def settled(self, background: Background) -> Settled:
        """Return the places at the best shifts of their paths."""
        every, newest = np.arange(len(self.poses)), self.poses[:, -1]

        def ratios(observed: Floats32) -> Floats:
            flat = observed.reshape(-1, observed.shape[2])
            return log_likelihood_ratios(flat, background).reshape(observed.shape[:2])

        shifts = np.tile(_SHIFTS, (len(every), 1, 1))
        table = ratios(self.observe(shifts))
        turned = shifts[every, table.argmax(axis=1), None] + _TURNS
        observed = self.observe(turned)
        turns = ratios(observed)
        gain = np.logaddexp.reduce(turns, axis=1) - np.log(len(_TURNS)) - table.max(axis=1)
        best = turns.argmax(axis=1)
        return Settled(
            newest + turned[every, best], observed[every, best], newest[:, None] + shifts, table + gain[:, None]
        )


def smoothed(offsets: Floats, bodies: Floats) -> Floats:
    """Return offsets (P, W, 4) from straight paths, smoothed: odometry drifts as a random walk, and poses scatter.

    ``bodies`` (W, 3) are the body's positions in the odometry frame. The scatter of a place is that of x and y about a
    linear drift; z and heading are averaged by the same weights.
    """
    count = len(bodies)
    steps = np.linalg.norm(np.diff(bodies, axis=0), axis=1)
    driven = np.concatenate([[0.0], np.cumsum(steps)])
    linear = np.column_stack([np.ones(count), driven - driven.mean()])
    rest = (np.eye(count) - linear @ np.linalg.pinv(linear)) @ offsets[:, :, :2]
    free = 2.0 * max(count - 2, 0)
    variance = (np.square(rest).sum(axis=(1, 2)) + _WEIGHT * SCATTER**2) / (free + _WEIGHT)
    change = np.diff(np.eye(count), axis=0)
    walk = change.T @ (change / (np.square(_DRIFT[0] * steps) + _DRIFT[1] ** 2)[:, None])
    information = np.eye(count) / variance[:, None, None] + walk
    return np.asarray(np.linalg.solve(information, offsets / variance[:, None, None]))
