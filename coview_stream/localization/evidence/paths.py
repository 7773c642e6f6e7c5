"""Paths: the poses of places at all keyframes of a search, and the best shift of each.

Each keyframe moves a place to the pose nearby with the most hits. On a sparse survey this is metres off, in another
direction at each keyframe, and neighbouring places have nearly equal evidence. Odometry hardly drifts between
keyframes, so the poses of a place are smoothed to a path, and the path is shifted and turned as a whole to the largest
evidence of all keyframes.

The ratio of a place is the mean over equally probable shifts. A mean of ratios against chance is one, too: chance
exceeds R with probability 1 / R at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

import coview_kernels as kernels
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.localization.evidence.background import Background, observe_around
from coview_stream.localization.evidence.likelihood import log_likelihood_ratios
from coview_stream.localization.evidence.observation import ObservedScan, Share

_STEP, _REACH = 1.0, 2  # metres of a shift, and steps to each side: the basin of a place
_TURN = np.radians(1.0)
_DRIFT = 0.02, 0.05  # of odometry between keyframes, one sigma: share of the distance, and metres
_SCATTER, _WEIGHT = (
    0.2,
    4.0,
)  # metres of a pose about its path, of half-metre cells, and its weight in degrees of freedom


def _grid(reach: int) -> Floats:
    side = _STEP * np.arange(-reach, reach + 1)
    x, y = np.meshgrid(side, side)
    return np.column_stack([x.ravel(), y.ravel(), np.zeros((x.size, 2))])


_BASIN, _AROUND = _grid(_REACH), _grid(1)
_TURNS = np.array([[0.0, 0.0, 0.0, turn] for turn in (-_TURN, 0.0, _TURN)])


class Settled(NamedTuple):
    """Places at their best shifts."""

    moves: Floats  # (P, 4) shifts in x, y, z and heading
    ratios: Floats  # (P,) log-likelihood ratios against chance, as a mean over shifts
    observed: Floats32  # (P, 15) mean observations there


def look_back(
    field: kernels.FieldMap, scans: Sequence[ObservedScan], T_map_odom: Floats
) -> tuple[Floats32, Floats]:  # fmt: skip
    """Return observations (P, W, 15) of scans, oldest first, at places ``T_map_odom`` (P, 4, 4), and poses (P, W, 4).

    Each scan begins at the pose of the next newer one, which undoes odometry's drift, and moves to most hits nearby.
    """
    width = len(Share) + 8
    observed = np.empty((len(T_map_odom), len(scans), width), dtype=np.float32)
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
    scans: Sequence[ObservedScan]  # (W) of the keyframes
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
        every = np.arange(len(self.poses))

        def ratios(moves: Floats) -> tuple[Floats, Floats32]:
            observed = self.observe(moves)
            flat = observed.reshape(-1, observed.shape[2])
            return log_likelihood_ratios(flat, background).reshape(moves.shape[:2]), observed

        shifts = np.tile(_BASIN, (len(every), 1, 1))
        table, _ = ratios(shifts)
        top = table.max(axis=1)
        mean = np.log(np.exp(table - top[:, None]).mean(axis=1)) + top
        best = shifts[every, table.argmax(axis=1)]
        further = best[:, None] + _AROUND
        best = further[every, ratios(further)[0].argmax(axis=1)]
        turned = best[:, None] + _TURNS
        table, observed = ratios(turned)
        turn = table.argmax(axis=1)
        gain = table[every, turn] - table[:, 1] - np.log(len(_TURNS)) * (turn != 1)
        return Settled(turned[every, turn], mean + np.maximum(gain, 0.0), observed[every, turn])


def smoothed(offsets: Floats, bodies: Floats) -> Floats:
    """Return offsets (P, W, 4) from straight paths, smoothed: odometry drifts as a random walk, and poses scatter.

    ``bodies`` (W, 3) are the body's positions in the odometry frame. The scatter of a place is that about a linear
    drift.
    """
    count = len(bodies)
    steps = np.linalg.norm(np.diff(bodies, axis=0), axis=1)
    driven = np.concatenate([[0.0], np.cumsum(steps)])
    linear = np.column_stack([np.ones(count), driven - driven.mean()])
    rest = (np.eye(count) - linear @ np.linalg.pinv(linear)) @ offsets[:, :, :2]
    free = 2.0 * max(count - 2, 0)
    variance = (np.square(rest).sum(axis=(1, 2)) + _WEIGHT * _SCATTER**2) / (free + _WEIGHT)
    change = np.diff(np.eye(count), axis=0)
    walk = change.T @ (change / (np.square(_DRIFT[0] * steps) + _DRIFT[1] ** 2)[:, None])
    information = np.eye(count) / variance[:, None, None] + walk
    return np.asarray(np.linalg.solve(information, offsets / variance[:, None, None]))
