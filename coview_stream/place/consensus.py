"""Consensus: every keyframe votes for one ``T_map_odom``.

Each (keyframe, station, shift) is a hypothesis of the same unknown transform. Odometry says where the other
keyframes stood relative to the newest one, so a hypothesis of the newest keyframe predicts a station and a shift
for each of the others: their distances are looked up there and added. All M x S hypotheses are summed, none is cut
by a top-k before it could be confirmed.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from coview_stream.config import Channel, ConsensusConfig
from coview_stream.geometry import Pose, pose_from, rot_z
from coview_stream.place.retrieval import Volume

_SHORTLIST = 4000  # hypotheses among which distinct peaks are sought
_MARGIN = 100  # cells around the stations; farther apart than this keyframes do not vote together
_LEVEL_GAP = 2.5  # metres: stations farther apart in height are on different storeys


@dataclass(frozen=True)
class Hypothesis:
    """A coarse ``T_map_odom`` (4 x 4), with its station, shift and summed score (lower is better)."""

    T_map_odom: Pose
    station: int
    shift: int
    score: float


@dataclass(frozen=True)
class _Ballot:
    centre: npt.NDArray[np.float64]  # (3,) odometry frame, z on the ground
    votes: npt.NDArray[
        np.float32
    ]  # (S, M + 1) standardised distances; the last station is nowhere: no opinion
    smallest: float  # smallest raw distance of any channel, for the paper's single-minimum rule
    where: tuple[int, int]  # its station and shift


class StationGrid:
    """Finds the station at a position: stations stand at the centres of a square grid, one per level.

    The grid has a margin, so that a step from any station to a place off the map is one addition and finds nothing.
    """

    def __init__(self, stations: npt.NDArray[np.float32], block: float) -> None:
        self.stations = stations
        self.block = block
        cells = np.floor(stations[:, :2].astype(np.float64) / block).astype(np.int64)
        cells += _MARGIN - cells.min(axis=0)
        self._width = int(cells[:, 1].max()) + 1 + _MARGIN
        self._flat = cells[:, 0] * self._width + cells[:, 1]
        order = np.lexsort((stations[:, 2], self._flat))
        unique, first, count = np.unique(self._flat[order], return_index=True, return_counts=True)
        size = (int(cells[:, 0].max()) + 1 + _MARGIN) * self._width
        self._grid = np.full((int(count.max()), size), -1, dtype=np.int32)
        for level in range(len(self._grid)):
            has = count > level
            self._grid[level, unique[has]] = order[first[has] + level]

    def moved(self, shift_cells: npt.NDArray[np.int64], rise: float) -> npt.NDArray[np.int32]:
        """Index (M,) of the station that lies ``shift_cells`` (2,) from each station, -1 where there is none.

        ``rise`` (metres) is the height gained on the way; it picks the storey.
        """
        if np.abs(shift_cells).max() >= _MARGIN:
            return np.full(len(self.stations), -1, dtype=np.int32)
        there = self._flat + (shift_cells[0] * self._width + shift_cells[1])
        if len(self._grid) == 1:
            return np.asarray(self._grid[0][there])
        levels = self._grid[:, there]
        gap = np.abs(self.stations[levels, 2] - (self.stations[:, 2] + rise))
        gap[levels < 0] = np.inf
        best = gap.argmin(axis=0)
        columns = np.arange(len(self.stations))
        return np.where(gap[best, columns] < _LEVEL_GAP, levels[best, columns], -1).astype(np.int32)


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

    def vote(self, centre: npt.NDArray[np.float64], distances: dict[Channel, Volume]) -> None:
        """Add one keyframe's distances (M, S) per channel; ``centre`` (3,) is its descriptor's zero, odometry frame.

        Channels are standardised (median and MAD over all hypotheses) before they are averaged: how far a
        hypothesis stands out is comparable between channels and places, the distance itself is not.
        """
        votes = sum(standardised(volume) for volume in distances.values()) / np.float32(len(distances))
        best = min(distances.values(), key=lambda volume: float(volume.min()))
        station, shift = np.unravel_index(int(best.argmin()), best.shape)
        by_shift = np.zeros((np.shape(votes)[1], len(self.stations) + 1), dtype=np.float32)
        by_shift[:, :-1] = np.transpose(votes)
        self._ballots.append(_Ballot(centre, by_shift, float(best.min()), (int(station), int(shift))))

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
        total = newest.votes[:, :-1].copy()
        sectors = len(total)
        for ballot in list(self._ballots)[:-1]:
            step = ballot.centre - newest.centre
            for n in range(sectors):
                xy = rot_z(float(yaw_of_shift(n, sectors)))[:2, :2] @ step[:2]
                moved = self.grid.moved(np.rint(xy / self.grid.block).astype(np.int64), float(step[2]))
                total[n] += ballot.votes[n][
                    moved
                ]  # -1, no station there (map edge, building), finds the zero
        return np.asarray(total.T / np.float32(np.sqrt(len(self._ballots))))

    def _peaks(self, scores: Volume, centre: npt.NDArray[np.float64]) -> list[Hypothesis]:
        sectors = scores.shape[1]
        flat = np.ascontiguousarray(scores).ravel()
        some = min(_SHORTLIST, flat.size - 1)
        shortlist = np.argpartition(flat, some)[: some + 1]
        shortlist = shortlist[np.argsort(flat[shortlist], kind="stable")]
        station, shift = np.divmod(shortlist, sectors)
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
        turn = rot_z(float(yaw_of_shift(shift, self._ballots[-1].votes.shape[0])))
        T = pose_from(turn, self.stations[station].astype(np.float64)) @ pose_from(np.eye(3), -centre)
        return Hypothesis(T, station, shift, score)


def yaw_of_shift(shift: npt.ArrayLike, sectors: int) -> npt.NDArray[np.float64]:
    """Eq. 9: heading of the odometry frame's x axis in the map for shift n (any shape), radians."""
    return np.asarray(shift, dtype=np.float64) * (-2.0 * np.pi / sectors)


def standardised(volume: Volume) -> Volume:
    """How many robust standard deviations each distance lies from the median of all, negative is better."""
    scored = volume[(volume != 1.0).any(axis=1)]  # ring-key mode leaves most stations at 1, unscored
    if not len(scored):
        return np.zeros_like(volume)
    step = max(1, scored.size // 100_000)
    while np.gcd(step, scored.shape[1]) > 1:  # or the sample would hold few of the shifts
        step += 1
    sample = scored.ravel()[::step]
    median = np.float32(np.median(sample))
    spread = np.float32(1.4826 * np.median(np.abs(sample - median)) + 1e-6)
    votes: Volume = (volume - median) / spread
    return np.where(volume == 1.0, np.maximum(votes, np.float32(0.0)), votes)
