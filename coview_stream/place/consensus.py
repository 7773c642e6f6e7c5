"""Consensus: every keyframe votes for one ``T_map_odom``.

Each (keyframe, station, shift) is a hypothesis of the same unknown transform. Odometry says where the other
keyframes stood relative to the newest one, so a hypothesis of the newest keyframe predicts a station and a shift
for each of the others: their distances are looked up there and added. All M x S hypotheses are summed, none is cut
by a top-k before it could be confirmed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from coview_kernels import Nearest
from coview_stream.config import Channel, ConsensusConfig
from coview_stream.geometry import Pose, pose_from, rot_z
from coview_stream.place.retrieval import Volume
from coview_stream.place.station_grid import StationGrid, Values

_SAMPLE = 100_000  # numbers are enough for a median
_NO_VOTES = np.empty(0, dtype=np.float32)
_SHORTLIST = 4000  # hypotheses among which distinct peaks are sought


@dataclass(frozen=True)
class Hypothesis:
    """A coarse ``T_map_odom`` (4 x 4), with its station, shift and summed score (lower is better).

    Station and shift are None where no vote stands behind it: somebody suggested it. ``learned`` says that the votes
    are those of learned features, and ``lead`` by how much the mean keyframe's votes favour it over the next place, in
    robust standard deviations; 0 where it is not the first. ``exact`` says that keypoints have agreed on it.
    """

    T_map_odom: Pose
    station: int | None
    shift: int | None
    score: float
    learned: bool = False
    lead: float = 0.0
    exact: bool = False


@dataclass(frozen=True)
class _Ballot:
    centre: npt.NDArray[np.float64]  # (3,) odometry frame, z on the ground
    votes: Values  # standardised distances (S, ...), spread over the grid
    smallest: float  # smallest raw distance of any channel, for the paper's single-minimum rule
    where: tuple[int, int]  # its station and shift
    sectors: int


class Consensus:
    """The newest keyframes' votes and the hypotheses they agree on."""

    def __init__(self, stations: npt.NDArray[np.float32], block: float, config: ConsensusConfig) -> None:
        self.config = config
        self.stations = stations
        self.grid = StationGrid(stations, block)
        self._ballots: deque[_Ballot] = deque(maxlen=config.window)

    def __len__(self) -> int:
        """Return how many keyframes have voted."""
        return len(self._ballots)

    def clear(self) -> None:
        """Forget all votes."""
        self._ballots.clear()

    def vote(
        self, centre: npt.NDArray[np.float64], distances: Mapping[Channel, Volume] | Mapping[str, Volume]
    ) -> None:
        """Add one keyframe's distances (M, S) per channel; ``centre`` (3,) is its descriptor's zero, odometry frame.

        Channels are standardised (median and MAD over all hypotheses) before they are averaged: how far a
        hypothesis stands out is comparable between channels and places, the distance itself is not.
        """
        best = min(distances.values(), key=lambda volume: float(volume.min()))
        station, shift = np.unravel_index(int(best.argmin()), best.shape)
        votes = np.zeros_like(best)
        for volume in distances.values():
            votes += standardised(volume)
        votes *= np.float32(1.0 / len(distances))
        spread = self.grid.spread(np.ascontiguousarray(votes.T))
        ballot = _Ballot(centre, spread, float(best.min()), (int(station), int(shift)), best.shape[1])
        self._ballots.append(ballot)

    def vote_nearest(
        self, centre: npt.NDArray[np.float64], nearest: dict[Channel, Nearest], sectors: int
    ) -> None:
        """Add what ``single`` makes of one keyframe: the nearest station of each channel, out of ``sectors`` shifts."""
        best = min(nearest.values(), key=lambda found: float(found.distance[0]))
        where = int(best.station[0]), int(best.shift[0])
        self._ballots.append(_Ballot(centre, _NO_VOTES, float(best.distance[0]), where, sectors))

    def hypotheses(self) -> list[Hypothesis]:
        """Return the best spatially distinct hypotheses, best first; none before the first vote."""
        if not self._ballots:
            return []
        if self.config.mode == "single":
            ballot = min(self._ballots, key=lambda b: b.smallest)
            return [self._hypothesis(*ballot.where, ballot.smallest, ballot.centre)]
        return self._peaks(self.scores(), self._ballots[-1].centre)

    def scores(self) -> Volume:
        """Sum the votes (M, S) for the newest keyframe to stand at station m with shift n, per sqrt(keyframe)."""
        newest = self._ballots[-1]
        total = newest.votes.copy()
        yaw = yaw_of_shift(np.arange(len(total)), len(total))
        turned = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        for ballot in list(self._ballots)[:-1]:
            step = ballot.centre - newest.centre
            cells = np.rint(np.tensordot(step[:2], turned, (0, 1)).T / self.grid.block).astype(np.int64)
            for n, cell in enumerate(cells):
                self.grid.add(total[n], ballot.votes[n], cell, float(step[2]))
        total *= np.float32(1.0 / np.sqrt(len(self._ballots)))
        scores: Volume = self.grid.gathered(total).T
        return scores

    def _peaks(self, scores: Volume, centre: npt.NDArray[np.float64]) -> list[Hypothesis]:
        stations, sectors = scores.shape
        flat = np.ascontiguousarray(scores.T).ravel()
        shortlist = smallest(flat, _SHORTLIST)
        shift, station = np.divmod(shortlist, stations)
        xyz = self.stations[station].astype(np.float64)
        yaw = yaw_of_shift(shift, sectors)
        free = np.ones(len(shortlist), dtype=bool)
        found: list[Hypothesis] = []
        while free.any() and len(found) < self.config.peaks:
            k = int(free.argmax())
            found.append(self._hypothesis(int(station[k]), int(shift[k]), float(flat[shortlist[k]]), centre))
            turn = np.abs((yaw - yaw[k] + np.pi) % (2 * np.pi) - np.pi)
            near = np.linalg.norm(xyz - xyz[k], axis=1) < self.config.distinct_distance
            free &= ~(near & (turn < self.config.distinct_yaw))
        return found

    def _hypothesis(
        self, station: int, shift: int, score: float, centre: npt.NDArray[np.float64]
    ) -> Hypothesis:
        """Eq. 12, mended: the turn is about the keyframe's centre, not about the odometry frame's origin."""
        turn = rot_z(float(yaw_of_shift(shift, self._ballots[-1].sectors)))
        T = pose_from(turn, self.stations[station].astype(np.float64)) @ pose_from(np.eye(3), -centre)
        return Hypothesis(T, station, shift, score)


def yaw_of_shift(shift: npt.ArrayLike, sectors: int) -> npt.NDArray[np.float64]:
    """Eq. 9: heading of the odometry frame's x axis in the map for shift n (any shape), radians."""
    return np.asarray(shift, dtype=np.float64) * (-2.0 * np.pi / sectors)


def standardised(volume: Volume) -> Volume:
    """How many robust standard deviations each distance lies from the median of all, negative is better."""
    sample = _sample(volume)
    if not len(sample):
        return np.zeros_like(volume)
    median = np.median(sample)
    spread = np.float32(1.4826 * np.median(np.abs(sample - median)) + 1e-6)
    votes: Volume = (volume - median) * np.float32(1.0 / spread)
    if median > 1.0:  # then what nothing is known of would count in favour
        np.maximum(votes, np.float32(0.0), out=votes, where=volume == 1.0)
    return votes


def _sample(volume: Volume) -> npt.NDArray[np.float32]:
    """Distances (K,) at every shift of stations spread over the map, those left out that were not scored."""
    every = max(1, volume.size // _SAMPLE)
    for rows in (volume[::every], volume):  # the paper's mode leaves most stations at 1, unscored
        scored = rows[(rows != 1.0).any(axis=1)]
        if scored.size >= min(_SAMPLE // 2, volume.size // 2):
            break
    return np.asarray(scored.ravel())


def smallest(values: npt.NDArray[np.float32], count: int) -> npt.NDArray[np.int64]:
    """Return the indices of the ``count`` smallest of (N,) values, smallest first; equal ones by index."""
    if count >= len(values):
        return np.asarray(np.argsort(values, kind="stable"))
    # most are ruled out by a bound from a sample, which is too small now and then: then all are looked at
    every = max(1, len(values) // _SAMPLE)
    sample = values[::every]
    rank = min(2 * count // every, len(sample) - 1)
    found = np.flatnonzero(values <= np.partition(sample, rank)[rank])
    if len(found) < count:
        found = np.arange(len(values))
    near = values[found]
    bound = np.partition(near, count - 1)[count - 1]
    found = found[near <= bound]
    return np.asarray(found[np.argsort(values[found], kind="stable")[:count]])
