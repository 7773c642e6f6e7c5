"""Consensus: every keyframe votes for one ``T_map_odom``.

A keyframe names places: stations and shifts at which it may have been taken. Each is a hypothesis of the same unknown
transform. Odometry says where the other keyframes stood, so that each of them is asked for its vote on the station and
shift that the hypothesis predicts for it, and the votes are added. What no keyframe names is never scored; what one
names is scored by all.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_stream.basemap.stations import StationGrid
from coview_stream.config import ConsensusConfig
from coview_stream.geometry.arrays import Floats, Floats32, Indices, Ints
from coview_stream.geometry.transforms import Pose
from coview_stream.localization.search.votes import Request, Vote

_KEPT = 8  # places are kept from keyframe to keyframe for each hypothesis that is asked for: the best; set by hand
_BIN, _BIN_YAW = 2.0 / 3.0, 0.5  # of what makes places distinct: bins that keep the best place each; set by hand


@dataclass(frozen=True)
class Hypothesis:
    """A coarse ``T_map_odom`` to register from.

    Attributes:
        T_map_odom: (4, 4).
        station: index of its station; None for a pose hint, which has no votes.
        shift: its number of sectors; None for a pose hint.
        score: sum of its votes, lower is better.
        learned: whether the votes are those of learned features.
    """

    T_map_odom: Pose
    station: int | None
    shift: int | None
    score: float
    learned: bool = False


@dataclass(frozen=True)
class _Places:
    """N hypotheses of ``T_map_odom``, level, and the votes on them.

    Attributes:
        shift: (N,) their headings.
        offset: (N, 3) float64 where they put the odometry frame's origin; map frame, metres.
        station: (N,) at which they put the newest keyframe, -1 for none.
        votes: (N, W) float32 z-scores of the keyframes in the window, 0 of those that have not voted yet.
    """

    shift: Ints
    offset: Floats
    station: Indices
    votes: Floats32

    @classmethod
    def none(cls, window: int) -> _Places:
        integers = np.zeros(0, dtype=np.int64)
        return cls(integers, np.zeros((0, 3)), integers, np.zeros((0, window), dtype=np.float32))

    def __len__(self) -> int:
        return len(self.shift)

    def __getitem__(self, chosen: Indices) -> _Places:
        return _Places(self.shift[chosen], self.offset[chosen], self.station[chosen], self.votes[chosen])

    def __add__(self, other: _Places) -> _Places:
        return _Places(
            *(
                np.concatenate([getattr(self, name), getattr(other, name)])
                for name in ("shift", "offset", "station", "votes")
            )
        )


class Consensus:
    """The votes of the newest keyframes, and the hypotheses that they agree on."""

    def __init__(self, grid: StationGrid, config: ConsensusConfig) -> None:
        self.config = config
        self.grid = grid
        self._votes: deque[tuple[int, Vote]] = deque(maxlen=config.window)  # with the column of its z-scores
        self.clear()

    def __len__(self) -> int:
        """Return how many keyframes have voted."""
        return len(self._votes)

    def clear(self) -> None:
        """Forget all votes."""
        self._votes.clear()
        self._places = _Places.none(self.config.window)

    def vote(self, vote: Vote) -> None:
        """Add one keyframe's vote: on the places that are known, and with all older votes on those that it names."""
        column = (self._votes[-1][0] + 1) % self.config.window if self._votes else 0
        self._votes.append((column, vote))
        known, named = self._moved(self._places, vote), self._named(vote)
        asked = [Request(vote, each.station, each.shift) for each in (known, named)]
        into = [each.votes[:, column] for each in (known, named)]
        for other, older in list(self._votes)[:-1]:
            asked.append(Request(older, self.grid.at(self._seen(named, older)), named.shift))
            into.append(named.votes[:, other])
        for votes, found in zip(into, vote.at_all(asked), strict=True):
            votes[:] = found
        places = known + named
        order = np.argsort(places.votes.sum(axis=1), kind="stable")
        _, first = np.unique(self._bins(places, vote)[order], return_index=True)
        self._places = places[order[np.sort(first)[: _KEPT * self.config.peaks]]]

    def hypotheses(self) -> list[Hypothesis]:
        """Return the best spatially distinct hypotheses, best first; none before the first vote."""
        places = self._places[np.flatnonzero(self._places.station >= 0)]
        if not len(places):
            return []
        newest = self._votes[-1][1]
        scores = places.votes.sum(axis=1) * np.float32(1.0 / np.sqrt(len(self._votes)))
        yaw = yaw_of_shift(places.shift, newest.sectors)
        rule = self.config
        chosen = kernels.distinct_poses(
            self._seen(places, newest), yaw, rule.peaks, rule.distinct_distance, rule.distinct_yaw
        )
        poses = np.tile(np.eye(4), (len(chosen), 1, 1))
        cos, sin = np.cos(yaw[chosen]), np.sin(yaw[chosen])
        poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = cos, -sin, sin, cos
        poses[:, :3, 3] = places.offset[chosen]
        numbers = (values[chosen].tolist() for values in (places.station, places.shift, scores))
        return [Hypothesis(*each) for each in zip(poses, *numbers, strict=True)]

    def _bins(self, places: _Places, vote: Vote) -> Ints:
        """Give places (N,) numbers by where they put a keyframe; those that share one are not distinct."""
        rule, there = self.config, self._seen(places, vote)
        edge = np.array([_BIN * rule.distinct_distance] * 2 + [0.5 * rule.distinct_distance])
        sectors = max(1, int(_BIN_YAW * rule.distinct_yaw * vote.sectors / (2.0 * np.pi)))
        x, y, z = np.floor(there / edge).astype(np.int64).T % 2**18  # more than any map has
        return np.asarray(((x * 2**18 + y) * 2**18 + z) * 2**9 + places.shift // sectors)

    def _seen(self, places: _Places, vote: Vote) -> Floats:
        """Return where the places put a keyframe, (N, 3) in the map's frame."""
        yaw = yaw_of_shift(np.arange(vote.sectors), vote.sectors)
        (x, y, z), cos, sin = vote.centre, np.cos(yaw), np.sin(yaw)
        turned = np.stack([cos * x - sin * y, sin * x + cos * y, np.full(len(yaw), z)], axis=1)
        return np.asarray(places.offset + turned[places.shift])

    def _moved(self, places: _Places, vote: Vote) -> _Places:
        """Return known places at the stations at which they put a keyframe, whose height they follow."""
        there = self._seen(places, vote)
        station = self.grid.at(there)
        found = station >= 0
        places.offset[found, 2] += self.grid.stations[station[found], 2] - there[found, 2]
        return _Places(places.shift, places.offset, station, places.votes)

    def _named(self, vote: Vote) -> _Places:
        """Return the places that a keyframe names (eq. 12, corrected: the yaw turns about it), no votes on them yet."""
        station, shift = vote.candidates()
        offset = np.zeros((len(station), 3))
        votes = np.zeros((len(station), self.config.window), dtype=np.float32)
        places = _Places(shift, offset, station, votes)
        offset[:] = self.grid.stations[station] - self._seen(places, vote)
        return places


def yaw_of_shift(shift: npt.ArrayLike, sectors: int) -> Floats:
    """Return the heading of the odometry frame's x axis in the map for shift n (any shape), radians (eq. 9)."""
    return np.asarray(shift, dtype=np.float64) * (-2.0 * np.pi / sectors)
