"""Share of a map's places that are as clear of structure and as level as the right one: open roads, car parks, fields.

Ground and free space of a scan agree with the map at the right place, and at every open place. How rare open places are
decides how much that agreement is worth (:mod:`coview_stream.localization.evidence.likelihood`): next to nothing on a
plain, as much as ten nats in hills. They are counted twice, and the larger share holds: among the places that the
search scores, hundreds that votes have named, and among stations all over the map, thousands that nothing has chosen.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import coview_kernels as kernels
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.localization.evidence.background import OPEN, Background
from coview_stream.localization.evidence.likelihood import NUISANCES, clear_and_level
from coview_stream.localization.evidence.observation import ScanPart, Share

_STATIONS = 4096  # that a keyframe is observed from
_MOST = 8 * _STATIONS  # stations of a search: rarer open places are not told from none
_PRESUMED = 1.0 / OPEN  # places that the presumed share counts as: one of them is open
_STEPS = 5  # of expectation and maximization
_EVERY = 8  # one of so many structure points is looked up
_BLOCK = 512  # places at a time: intermediate arrays stay in the cache
_SEED = 20240
_NOTHING = np.empty((0, len(Share)), dtype=np.float32)
SIGHT = 35.0
"""Metres from the leader within which places have its ground and its free space in common."""


class OpenPlaces:
    """Count of open places at stations all over a map, keyframe by keyframe."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all counts."""
        self._random = np.random.default_rng(_SEED)
        self._count, self._open = 0, np.zeros((1, 1))  # stations; sum of their probabilities (Q, L)
        self.add(_NOTHING, np.empty((0, 2)))

    def look(self, field: kernels.FieldMap, stations: Floats32, part: ScanPart, height: float) -> None:
        """Observe a map's ``field`` from some ``stations`` (M, 3), the body ``height`` metres above, at any heading."""
        if self._count >= _MOST or not len(stations):
            return self.add(_NOTHING, np.empty((0, 2)))
        chosen = self._random.integers(len(stations), size=_STATIONS)
        heading = self._random.uniform(-np.pi, np.pi, _STATIONS)
        order = np.argsort(chosen, kind="stable")  # neighbours are looked up in turn: they lie in the same memory
        at = stations[chosen[order]].astype(np.float64)
        poses = np.column_stack([at[:, :2], at[:, 2] + height, heading[order]])
        # structure only moves the scan as it moves those at scored places
        ground = replace(part, points=replace(part.points, structure=part.points.structure[::_EVERY]))
        return self.add(ground.look_up(field, poses, kernels.Move.NEAR).shares, at[:, :2])

    def add(self, observed: Floats32, at: Floats) -> None:
        """Add a keyframe's observations (S, 7) at stations (S, 2) that nothing has chosen."""
        self._newest, self._at, self._before = observed, at, (self._count, self._open)

    def share(self, chance: Floats32, background: Background, leader: Floats | None = None) -> Floats:
        """Return the probability (Q, L) that a chance place is open, by the nuisances.

        Args:
            chance: (P, 7) observations at scored places more than :data:`SIGHT` from the leader.
            background: of the other shares.
            leader: x, y, ... of the leader: stations as near are left out as well.
        """
        newest = self._newest
        if leader is not None:
            newest = newest[np.linalg.norm(self._at - leader[:2], axis=1) > SIGHT]
        scored, anywhere = _odds_against(chance, background), _odds_against(newest, background)
        self._count = self._before[0] + len(anywhere)
        named = rate = np.full(scored.shape[1:], OPEN, dtype=np.float32)
        for _ in range(_STEPS):
            named = _expected(scored, named) / np.float32(len(chance) + 1)  # one more is not open
            self._open = self._before[1] + _expected(anywhere, rate)
            rate = ((self._open + OPEN * _PRESUMED) / (self._count + _PRESUMED)).astype(np.float32)
        return np.maximum(rate, named).astype(np.float64)


def _odds_against(observed: Floats32, background: Background) -> Floats32:
    """Return likelihood ratios (P, Q, L) of places that are not open to open ones, for these observations (P, 7)."""
    out = np.empty((len(observed), NUISANCES[0], NUISANCES[2]), dtype=np.float32)
    for start in range(0, len(out), _BLOCK):
        part = slice(start, start + _BLOCK)
        np.clip(-clear_and_level(observed[part], background), -60.0, 60.0, out=out[part], casting="same_kind")
    return np.exp(out, out=out)


def _expected(odds_against: Floats32, share: Floats32) -> Floats32:
    """Return the expected number (Q, L) of open places among P with these odds, where a ``share`` (Q, L) of all is."""
    probability = odds_against * ((1.0 - share) / np.maximum(share, np.float32(1e-10)))
    probability += 1.0
    np.reciprocal(probability, out=probability)
    return np.asarray(probability.sum(axis=0))
