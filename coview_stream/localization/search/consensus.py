"""Consensus: every keyframe votes for one ``T_map_odom``.

Each (keyframe, station, shift) is a hypothesis of the same unknown transform. Odometry says where the other
keyframes stood relative to the newest one, so a hypothesis of the newest keyframe predicts a station and a shift
for each of the others: their distances are looked up there and added. All M x S hypotheses are summed, none is cut
by a top-k before it could be confirmed.
"""

# FOLDED coview_stream/localization/search/consensus.py: """The stations as the square grid they stand on: whatever has a value for each, looked up a step farther on."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from coview_kernels import Nearest
from coview_stream.config import Channel, ConsensusConfig
from coview_stream.geometry.arrays import Floats, Floats32, Indices, Ints
from coview_stream.geometry.transforms import Pose, pose_from, rot_z

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
class _Vote:
    centre: Floats  # (3,) odometry frame, z on the ground
    votes: Floats32  # standardised distances (S, ...), spread over the grid
    smallest: float  # smallest raw distance of any channel, for the paper's single-minimum rule
    where: tuple[int, int]  # its station and shift
    sectors: int


class Consensus:
    """The newest keyframes' votes and the hypotheses they agree on."""

    def __init__(self, stations: Floats32, block: float, config: ConsensusConfig) -> None:
        self.config = config
        self.stations = stations
        self.grid = StationGrid(stations, block)
        self._ballots: deque[_Vote] = deque(maxlen=config.window)

    def __len__(self) -> int:
        """Return how many keyframes have voted."""
        return len(self._ballots)

    def clear(self) -> None:
        """Forget all votes."""
        self._ballots.clear()

    def vote(self, centre: Floats, distances: Mapping[Channel, Floats32] | Mapping[str, Floats32]) -> None:
        """Add one keyframe's distances (M, S) per channel; ``centre`` (3,) is its descriptor's zero, odometry frame.

        Channels are standardised (median and MAD over all hypotheses) before they are averaged: how far a
        hypothesis stands out is comparable between channels and places, the distance itself is not.
        """
        best = min(distances.values(), key=lambda volume: float(volume.min()))
        station, shift = np.unravel_index(int(best.argmin()), best.shape)
        votes = np.zeros_like(best)
        for volume in distances.values():
            votes += robust_zscore(volume)
        votes *= np.float32(1.0 / len(distances))
        spread = self.grid.spread(np.ascontiguousarray(votes.T))
        ballot = _Vote(centre, spread, float(best.min()), (int(station), int(shift)), best.shape[1])
        self._ballots.append(ballot)

    def vote_nearest(self, centre: Floats, nearest: dict[Channel, Nearest], sectors: int) -> None:
        """Add what ``single`` makes of one keyframe: the nearest station of each channel, out of ``sectors`` shifts."""
        best = min(nearest.values(), key=lambda found: float(found.distance[0]))
        where = int(best.station[0]), int(best.shift[0])
        self._ballots.append(_Vote(centre, _NO_VOTES, float(best.distance[0]), where, sectors))

    def hypotheses(self) -> list[Hypothesis]:
        """Return the best spatially distinct hypotheses, best first; none before the first vote."""
        if not self._ballots:
            return []
        if self.config.mode == "single":
            ballot = min(self._ballots, key=lambda b: b.smallest)
            return [self._hypothesis(*ballot.where, ballot.smallest, ballot.centre)]
        return self._peaks(self.scores(), self._ballots[-1].centre)

    def scores(self) -> Floats32:
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
        scores: Floats32 = self.grid.gathered(total).T
        return scores

    def _peaks(self, scores: Floats32, centre: Floats) -> list[Hypothesis]:
        stations, sectors = scores.shape
        flat = np.ascontiguousarray(scores.T).ravel()
        shortlist = argsmallest(flat, _SHORTLIST)
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

    def _hypothesis(self, station: int, shift: int, score: float, centre: Floats) -> Hypothesis:
        """Eq. 12, mended: the turn is about the keyframe's centre, not about the odometry frame's origin."""
        turn = rot_z(float(yaw_of_shift(shift, self._ballots[-1].sectors)))
        T = pose_from(turn, self.stations[station].astype(np.float64)) @ pose_from(np.eye(3), -centre)
        return Hypothesis(T, station, shift, score)


def yaw_of_shift(shift: npt.ArrayLike, sectors: int) -> Floats:
    """Eq. 9: heading of the odometry frame's x axis in the map for shift n (any shape), radians."""
    return np.asarray(shift, dtype=np.float64) * (-2.0 * np.pi / sectors)


def robust_zscore(volume: Floats32) -> Floats32:
    """How many robust standard deviations each distance lies from the median of all, negative is better."""
    sample = _sample(volume)
    if not len(sample):
        return np.zeros_like(volume)
    median = np.median(sample)
    spread = np.float32(1.4826 * np.median(np.abs(sample - median)) + 1e-6)
    votes: Floats32 = (volume - median) * np.float32(1.0 / spread)
    if median > 1.0:  # then what nothing is known of would count in favour
        np.maximum(votes, np.float32(0.0), out=votes, where=volume == 1.0)
    return votes


def _sample(volume: Floats32) -> Floats32:
    """Distances (K,) at every shift of stations spread over the map, those left out that were not scored."""
    every = max(1, volume.size // _SAMPLE)
    for rows in (volume[::every], volume):  # the paper's mode leaves most stations at 1, unscored
        scored = rows[(rows != 1.0).any(axis=1)]
        if scored.size >= min(_SAMPLE // 2, volume.size // 2):
            break
    return np.asarray(scored.ravel())


def argsmallest(values: Floats32, count: int) -> Ints:
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


_MARGIN = 100  # cells around the stations that are looked up; steps of more find nothing there

_LEVEL_GAP = 2.5  # metres: stations farther apart in height are on different storeys

_FILLED = 0.25  # share of the cells that must have a station, or the values are not laid out on them


class StationGrid:
    """Finds the station at a position: stations stand at the centres of a square grid, one per level.

    The values of stations, ``(S, M)``, are added up a step apart in either of two layouts, which agree for steps of
    less than 100 cells. Where most cells have one station they are laid out on the cells, ``(S, H, W)``, and a step is
    a shifted slice; otherwise (a lone road, or storeys) each is looked up, ``(S, M + 1)``, where the last column means
    no station.

    Attributes:
        laid_out: whether the first layout is used.
    """

    def __init__(self, stations: Floats32, block: float) -> None:
        self.stations = stations
        self.block = block
        cells = np.floor(stations[:, :2].astype(np.float64) / block).astype(np.int64)
        cells -= cells.min(axis=0)
        rows, columns = (int(n) + 1 for n in cells.max(axis=0))
        self._shape = rows, columns
        self._cell = cells[:, 0] * columns + cells[:, 1]
        single = len(np.unique(self._cell)) == len(stations)
        self.laid_out = bool(single and len(stations) >= _FILLED * rows * columns)
        self._width = columns + 2 * _MARGIN
        self._flat = (cells[:, 0] + _MARGIN) * self._width + cells[:, 1] + _MARGIN

    @cached_property
    def _grid(self) -> Indices:
        """Station (L, cells) of each level and cell with its margin, lowest level first, -1 for none."""
        order = np.lexsort((self.stations[:, 2], self._flat))
        unique, first, count = np.unique(self._flat[order], return_index=True, return_counts=True)
        size = (self._shape[0] + 2 * _MARGIN) * self._width
        grid = np.full((int(count.max()), size), -1, dtype=np.intp)
        for level in range(len(grid)):
            has = count > level
            grid[level, unique[has]] = order[first[has] + level]
        return grid

    def moved(self, step: Ints, rise: float) -> Indices:
        """Index (M,) of the station that lies ``step`` (2,) cells from each station, -1 where there is none.

        ``rise`` (metres) is the height gained on the way; it picks the storey.
        """
        if np.abs(step).max() >= _MARGIN:
            return np.full(len(self.stations), -1, dtype=np.intp)
        there = self._flat + (step[0] * self._width + step[1])
        if len(self._grid) == 1:
            return np.asarray(self._grid[0][there])
        levels = self._grid[:, there]
        gap = np.abs(self.stations[levels, 2] - (self.stations[:, 2] + rise))
        gap[levels < 0] = np.inf
        best = gap.argmin(axis=0)
        columns = np.arange(len(self.stations))
        return np.where(gap[best, columns] < _LEVEL_GAP, levels[best, columns], -1)

    def spread(self, values: Floats32) -> Floats32:
        """Lay out values (S, M) of the stations for :meth:`add`; a cell without a station has zero."""
        if not self.laid_out:
            return np.concatenate([values, np.zeros((len(values), 1), dtype=np.float32)], axis=1)
        cells = np.zeros((len(values), self._shape[0] * self._shape[1]), dtype=np.float32)
        cells[:, self._cell] = values
        return cells.reshape(len(values), *self._shape)

    def gathered(self, spread: Floats32) -> Floats32:
        """Values (S, M) of the stations out of their layout; undoes :meth:`spread`."""
        if not self.laid_out:
            return spread[:, :-1]
        return np.asarray(spread.reshape(len(spread), -1)[:, self._cell])

    def add(self, total: Floats32, values: Floats32, step: Ints, rise: float) -> None:
        """Add to each station's ``total`` what ``values`` has ``step`` cells farther on; both one row of a layout."""
        if not self.laid_out:
            total[:-1] += values.take(self.moved(step, rise))  # -1, no station there, finds the zero
            return
        (rows, columns), (down, across) = self._shape, step.tolist()
        if abs(down) < rows and abs(across) < columns:
            to = slice(max(0, -down), rows - max(0, down)), slice(max(0, -across), columns - max(0, across))
            of = slice(max(0, down), rows - max(0, -down)), slice(max(0, across), columns - max(0, -across))
            total[to] += values[of]
