"""Share of a map's places as clear of structure and as level as the right one: open roads, car parks, fields.

Ground and free space of a scan agree with the map at the right place and at every open place. The rarity of open places
determines the value of that agreement (:mod:`coview_stream.localization.evidence.likelihood`): next to nothing on a
plain, up to ten nats in hills. Open places are counted twice, and the larger share holds: among a hundred chance places
that the search has scored, and among poses at random stations, thousands at each keyframe. A place has to stay
open over the whole drive: poses that are open so far are followed from keyframe to keyframe, and new ones are also
looked up at the earlier keyframes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

import coview_kernels as kernels
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.localization.evidence.background import OPEN, Background
from coview_stream.localization.evidence.likelihood import NUISANCES, clear_and_level
from coview_stream.localization.evidence.observation import ObservedScan, ScanPart, Share

_STATIONS = 4096  # from which a keyframe is observed
_FOLLOWED = 96  # drives that continue, and new ones looked up at earlier keyframes: gives their count to a tenth
_PRESUMED = 1.0 / OPEN  # weight of the presumed share in places: one of them is open
_STEPS = 5  # of expectation and maximization
_BLOCK = 512  # places at a time: intermediate arrays stay in the cache
_SEED = 20240
SIGHT = 35.0
"""Metres from the leader within which places share its ground and its free space."""


@dataclass(frozen=True)
class _Drives:
    """Imagined drives with odometry's motion: each was at a random station and heading at one of the keyframes."""

    poses: Floats  # (S, 4) at the newest keyframe
    weights: Floats  # (S,) number of drives that each represents
    observed: Floats32  # (S, W, 7) observations at the keyframes, oldest first

    @classmethod
    def none(cls) -> _Drives:
        return cls(np.empty((0, 4)), np.empty(0), np.empty((0, 1, len(Share)), dtype=np.float32))

    def __add__(self, other: _Drives) -> _Drives:
        if not len(self.poses):
            return other
        both = (np.concatenate([getattr(part, name) for part in (self, other)]) for name in self.__dataclass_fields__)
        return _Drives(*both)

    def sampled(self, probable: Floats, random: np.random.Generator) -> _Drives:
        """Return at most :data:`_FOLLOWED` drives, drawn by probability (S,) to be open, weighted to represent all."""
        chances = self.weights * probable
        step = chances.sum() / _FOLLOWED
        if len(chances) <= _FOLLOWED or not step > 0.0:
            return self
        drawn = np.searchsorted(np.cumsum(chances), step * (random.random() + np.arange(_FOLLOWED)))
        rows, count = np.unique(np.minimum(drawn, len(chances) - 1), return_counts=True)
        return _Drives(self.poses[rows], count * step / probable[rows], self.observed[rows])


class OpenPlaces:
    """Count of open places at stations all over a map, over the keyframes of a search."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all counts."""
        self._random = np.random.default_rng(_SEED)
        self._count = 0  # drives so far
        self._drives, self._probable = _Drives.none(), np.empty(0)
        self._at = np.empty((0, 2))  # stations of the newest keyframe
        self._newest: tuple[_Drives, Sequence[ObservedScan], ObservedScan, kernels.FieldMap] | None = None

    def look(
        self, field: kernels.FieldMap, stations: Floats32, scans: Sequence[ObservedScan], scan: ObservedScan,
        height: float,
    ) -> None:  # fmt: skip
        """Observe a map's ``field`` from drives to random ``stations`` (M, 3), ``height`` metres above them.

        Drives of the earlier keyframes ``scans``, oldest first, continue to the newest ``scan``.
        """
        part = _ground(scan)
        if len(scans) and len(self._drives.poses):
            kept = self._drives.sampled(self._probable, self._random)
            there = scan.poses(scans[-1].transforms(kept.poses))
            observed = part.look_up(field, there, kernels.Move.NEAR)
            history = np.concatenate([kept.observed, observed.shares[:, None]], axis=1)
            self._drives = _Drives(observed.poses, kept.weights, history)
        count = _STATIONS if len(stations) else 0
        chosen = self._random.integers(max(len(stations), 1), size=count)
        heading = self._random.uniform(-np.pi, np.pi, count)
        order = np.argsort(chosen, kind="stable")  # looks up neighbours in turn, as they share memory
        at = stations[chosen[order]].astype(np.float64)
        poses = np.column_stack([at[:, :2], at[:, 2] + height, heading[order]])
        observed = part.look_up(field, poses, kernels.Move.NEAR)
        if not len(scans):
            return self.add(observed.shares[:, None], observed.poses)
        drives = _Drives(observed.poses, np.ones(count), observed.shares[:, None])
        self._newest = drives, scans, scan, field
        self._at, self._count = at[:, :2], self._count + count
        return None

    def add(self, observed: Floats32, poses: Floats) -> None:
        """Add random drives: their observations (S, W, 7) at all keyframes, and poses (S, 4) at the newest."""
        self._drives = self._drives + _Drives(poses, np.ones(len(poses)), observed)
        self._at, self._count = poses[:, :2], self._count + len(poses)

    def forget(self, keyframe: int) -> None:
        """Drop the observations of a keyframe, by its number from the oldest, 0."""
        rest = np.arange(self._drives.observed.shape[1]) != keyframe
        self._drives = replace(self._drives, observed=self._drives.observed[:, rest])

    def share(self, chance: Floats32, background: Background, leader: Floats | None = None) -> Floats:
        """Return the probability (Q, L) that a chance place is open, by nuisance values.

        ``chance`` (P, 7) are observations at chance places more than :data:`SIGHT` from ``leader`` (x, y, ...); drives
        nearer to it are ignored, too. ``background`` is that of the other shares.
        """
        self._look_back(background)
        weights, count = self._drives.weights.astype(np.float32), float(self._count)
        if leader is not None and count:
            weights *= np.linalg.norm(self._drives.poses[:, :2] - leader[:2], axis=1) > SIGHT
            # presumed of earlier drives, too; if more of them end far from the leader, the maximum below counts
            count *= float((np.linalg.norm(self._at - leader[:2], axis=1) > SIGHT).mean())
        scored = _odds_against(chance, background)
        anywhere = _odds_against(self._drives.observed.mean(axis=1), background)
        named = rate = np.full(scored.shape[1:], OPEN, dtype=np.float32)
        for _ in range(_STEPS):
            named = _probability(scored, named).sum(axis=0) / np.float32(len(chance) + 1)  # one more is not open
            probable = _probability(anywhere, rate)
            counted = np.tensordot(weights, probable, axes=1)
            rate = ((counted + OPEN * _PRESUMED) / (np.maximum(counted, count) + _PRESUMED)).astype(np.float32)
        self._probable = probable.max(axis=(1, 2)).astype(np.float64)
        return np.maximum(rate, named).astype(np.float64)

    def _look_back(self, background: Background) -> None:
        """Look up the earlier keyframes along the newest drives that may be open by the newest keyframe."""
        if self._newest is None:
            return
        newest, scans, scan, field = self._newest
        self._newest = None
        odds = _odds_against(newest.observed[:, 0], background)
        newest = newest.sampled(_probability(odds, np.float32(OPEN)).max(axis=(1, 2)).astype(np.float64), self._random)
        observed, T_map_odom = newest.observed, scan.transforms(newest.poses)
        for earlier in reversed(scans):
            there = _ground(earlier).look_up(field, earlier.poses(T_map_odom), kernels.Move.NEAR)
            observed = np.concatenate([there.shares[:, None], observed], axis=1)
            T_map_odom = earlier.transforms(there.poses)
        self._drives = self._drives + replace(newest, observed=observed)


def _ground(scan: ObservedScan) -> ScanPart:
    """Return the few ground and free points of a scan; without ground, some structure shows the surveyed part."""
    points = scan.few.points
    return replace(scan.few, points=replace(points, structure=points.structure[: 0 if len(points.low) else None : 8]))


def _odds_against(observed: Floats32, background: Background) -> Floats32:
    """Return the likelihood ratios (P, Q, L), not open to open, of places with observations (P, 7)."""
    out = np.empty((len(observed), NUISANCES[0], NUISANCES[2]), dtype=np.float32)
    for start in range(0, len(out), _BLOCK):
        part = slice(start, start + _BLOCK)
        np.clip(-clear_and_level(observed[part], background), -60.0, 60.0, out=out[part], casting="same_kind")
    return np.exp(out, out=out)


def _probability(odds_against: Floats32, share: Floats32 | np.float32) -> Floats32:
    """Return the probabilities (P, Q, L) that places with these odds are open, where a ``share`` (Q, L) of all is."""
    probability = odds_against * ((1.0 - share) / np.maximum(share, np.float32(1e-10)))
    probability += 1.0
    return np.asarray(np.reciprocal(probability, out=probability))
