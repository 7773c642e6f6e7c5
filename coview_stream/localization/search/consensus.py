"""Consensus: all keyframes vote on hypotheses of one ``T_map_odom``.

A keyframe names stations and shifts where it may have been taken; each pair is a hypothesis of the same unknown
transform. Odometry predicts the station and shift of the other keyframes under it, and their votes there are added. A
place named by one keyframe is scored by all keyframes; other places are never scored.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_kernels import Registration
from coview_stream.basemap.stations import StationGrid
from coview_stream.config import ConsensusConfig
from coview_stream.geometry.arrays import Floats, Floats32, Indices, Ints
from coview_stream.geometry.transforms import Pose
from coview_stream.localization.evidence.observation import Evidence

_KEPT = 8  # places per requested hypothesis that are kept between keyframes
_BIN, _BIN_YAW = 2.0 / 3.0, 0.5  # bin sizes relative to the distances that make places distinct


@dataclass(frozen=True)
class Hypothesis:
    """A hypothesis of ``T_map_odom``, from the votes that name it to its registration."""

    T_map_odom: Pose  # (4, 4); after registration the registered pose
    station: int | None = None  # index of the station; None for a place that no vote has named, like a pose hint
    shift: int | None = None  # number of sectors; None likewise
    votes: float = 0.0  # sum of the votes over the root of their number, lower is better
    learned: bool = False  # whether learned features voted
    hinted: bool = False  # whether a pose hint led to this place
    score: float = 0.0  # of the newest keyframe, in [0, 1], by the field
    ratio: float = 0.0  # log-likelihood ratio of the keyframes so far against chance
    probability: float = 0.0  # posterior probability that the robot is here
    registration: Registration | None = None  # of the newest keyframe
    evidence: Evidence | None = None  # at the registered pose

    def after(self, T_other_odom: Pose) -> Hypothesis:
        """Return this hypothesis of ``T_map_other`` as one of ``T_map_odom``, by the turn ``T_other_odom`` (4, 4)."""
        T = self.T_map_odom @ T_other_odom
        registration = None if self.registration is None else self.registration._replace(T_map_source=T)
        return replace(self, T_map_odom=T, registration=registration)


class Vote(Protocol):
    """One keyframe's scores of the stations at every shift; shift n means yaw -2 pi n / ``sectors`` (eq. 9)."""

    @property
    def centre(self) -> Floats:
        """(3,) zero of the descriptor, z on the ground; odometry frame, metres."""
        ...

    @property
    def sectors(self) -> int:
        """Number of shifts S."""
        ...

    def candidates(self) -> tuple[Ints, Ints]:
        """Return distinct stations and shifts (K,) where the keyframe may have been taken."""
        ...

    def at(self, stations: Ints, shifts: Ints) -> Floats32:
        """Return z-scores (K,) of stations at shifts, lower is better; 0 for station -1, none."""
        ...

    def at_all(self, requests: Sequence[tuple[Self, Ints, Ints]]) -> list[Floats32]:
        """Return :meth:`at` of several votes of this kind and map, each with its stations and shifts."""
        ...


@dataclass(frozen=True)
class _Places:
    """N level hypotheses of ``T_map_odom`` and the votes on them."""

    shift: Ints  # (N,) headings, numbers of sectors
    offset: Floats  # (N, 3) float64 position of the odometry frame's origin; map frame, metres
    station: Indices  # (N,) of the newest keyframe, -1 for none
    votes: Floats32  # (N, W) z-scores of the keyframes in the window, 0 before they vote

    @classmethod
    def none(cls, window: int) -> _Places:
        integers = np.zeros(0, dtype=np.int64)
        return cls(integers, np.zeros((0, 3)), integers, np.zeros((0, window), dtype=np.float32))

    def __len__(self) -> int:
        return len(self.shift)

    def __getitem__(self, chosen: Indices) -> _Places:
        return _Places(self.shift[chosen], self.offset[chosen], self.station[chosen], self.votes[chosen])

    def __add__(self, other: _Places) -> _Places:
        both = (np.concatenate([getattr(p, name) for p in (self, other)]) for name in self.__dataclass_fields__)
        return _Places(*both)


class Consensus:
    """The votes of the newest keyframes, and the hypotheses that they agree on."""

    def __init__(self, grid: StationGrid, config: ConsensusConfig) -> None:
        self.config = config
        self.grid = grid
        self._votes: deque[tuple[int, Vote]] = deque(maxlen=config.window)  # with the column of its z-scores
        self.clear()

    def __len__(self) -> int:
        """Return the number of keyframes that have voted."""
        return len(self._votes)

    def clear(self) -> None:
        """Forget all votes."""
        self._votes.clear()
        self._places = _Places.none(self.config.window)

    def vote(self, vote: Vote) -> None:
        """Add a keyframe's vote on the known places, and all votes on the places that it names."""
        column = (self._votes[-1][0] + 1) % self.config.window if self._votes else 0
        self._votes.append((column, vote))
        followed, added = self._moved(self._places, vote), self._named(vote)
        requests = [(vote, places.station, places.shift) for places in (followed, added)]
        targets = [places.votes[:, column] for places in (followed, added)]
        for other, older in list(self._votes)[:-1]:
            requests.append((older, self.grid.at(self._positions(added, older)), added.shift))
            targets.append(added.votes[:, other])
        for target, scores in zip(targets, vote.at_all(requests), strict=True):
            target[:] = scores
        places = followed + added
        order = np.argsort(places.votes.sum(axis=1), kind="stable")
        _, first = np.unique(self._bins(places, vote)[order], return_index=True)
        self._places = places[order[np.sort(first)[: _KEPT * self.config.peaks]]]

    def hypotheses(self) -> list[Hypothesis]:
        """Return the best spatially distinct hypotheses, best first; none before the first vote."""
        places = self._places[np.flatnonzero(self._places.station >= 0)]
        if not len(places):
            return []
        newest = self._votes[-1][1]
        votes = places.votes.sum(axis=1) * np.float32(1.0 / np.sqrt(len(self._votes)))
        yaw = yaw_of_shift(places.shift, newest.sectors)
        rule = self.config
        chosen = kernels.distinct_poses(
            self._positions(places, newest), yaw, rule.peaks, rule.distinct_distance, rule.distinct_yaw
        )
        poses = np.tile(np.eye(4), (len(chosen), 1, 1))
        cos, sin = np.cos(yaw[chosen]), np.sin(yaw[chosen])
        poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = cos, -sin, sin, cos
        poses[:, :3, 3] = places.offset[chosen]
        numbers = (values[chosen].tolist() for values in (places.station, places.shift, votes))
        return [Hypothesis(*row) for row in zip(poses, *numbers, strict=True)]

    def _bins(self, places: _Places, vote: Vote) -> Ints:
        """Return the bin (N,) of a keyframe's pose under each place; places in one bin are not distinct."""
        rule, position = self.config, self._positions(places, vote)
        edge = np.array([_BIN * rule.distinct_distance] * 2 + [0.5 * rule.distinct_distance])
        sectors = max(1, int(_BIN_YAW * rule.distinct_yaw * vote.sectors / (2.0 * np.pi)))
        x, y, z = np.floor(position / edge).astype(np.int64).T % 2**18  # more than any map has
        return np.asarray(((x * 2**18 + y) * 2**18 + z) * 2**9 + places.shift // sectors)

    def _positions(self, places: _Places, vote: Vote) -> Floats:
        """Return a keyframe's position (N, 3) under each place, map frame."""
        yaw = yaw_of_shift(np.arange(vote.sectors), vote.sectors)
        (x, y, z), cos, sin = vote.centre, np.cos(yaw), np.sin(yaw)
        turned = np.stack([cos * x - sin * y, sin * x + cos * y, np.full(len(yaw), z)], axis=1)
        return np.asarray(places.offset + turned[places.shift])

    def _moved(self, places: _Places, vote: Vote) -> _Places:
        """Return the known places at the stations of a new keyframe, at the height of these stations."""
        position = self._positions(places, vote)
        station = self.grid.at(position)
        on_map = station >= 0
        places.offset[on_map, 2] += self.grid.stations[station[on_map], 2] - position[on_map, 2]
        return _Places(places.shift, places.offset, station, places.votes)

    def _named(self, vote: Vote) -> _Places:
        """Return the places that a keyframe names, without votes (eq. 12, corrected: the yaw is about the keyframe)."""
        station, shift = vote.candidates()
        votes = np.zeros((len(station), self.config.window), dtype=np.float32)
        places = _Places(shift, np.zeros((len(station), 3)), station, votes)
        return replace(places, offset=self.grid.stations[station] - self._positions(places, vote))


def yaw_of_shift(shift: npt.ArrayLike, sectors: int) -> Floats:
    """Return the heading of the odometry frame's x axis in the map for shift n (any shape), radians (eq. 9)."""
    return np.asarray(shift, dtype=np.float64) * (-2.0 * np.pi / sectors)
