"""Consensus: every keyframe votes for one ``T_map_odom``.

Each (keyframe, station, shift) is a hypothesis of the same unknown transform. Odometry says where the other
keyframes stood relative to the newest one, so a hypothesis of the newest keyframe predicts a station and a shift
for each of the others: :class:`StationGrid` looks their distances up there, and they are added. All M x S hypotheses
are summed, none is cut by a top-k before it could be confirmed.
"""

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
from coview_stream.localization.search.retrieval import ScoreVolume

_SAMPLE = 100_000  # distances that a median is taken of; set by hand
_SHORTLIST = 4000  # hypotheses among which distinct peaks are sought; set by hand
_MARGIN = 100  # cells around the stations that are looked up; steps of more find nothing there; set by hand
_LEVEL_GAP = 2.5  # metres: stations farther apart in height are on different storeys; set by hand
_FILLED = 0.25  # share of the cells that must have a station for a raster of the values; set by hand
_NO_VOTES = np.empty(0, dtype=np.float32)


@dataclass(frozen=True)
class Hypothesis:
    """A coarse ``T_map_odom`` to register from.

    Attributes:
        T_map_odom: (4, 4).
        station: index of its station; None for a pose hint, which has no votes.
        shift: its number of sectors; None for a pose hint.
        score: sum of its votes, lower is better.
        learned: whether the votes are those of learned features.
        lead: how much the mean keyframe's votes prefer it to the next place, in robust standard deviations; 0 where it
            is not the first.
        exact: whether matched keypoints have refined it.
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
    """The vote of one keyframe."""

    centre: Floats  # (3,) odometry frame, z on the ground
    scores: Floats32  # z-scores (S, ...) of the distances, in the grid's layout
    smallest: float  # smallest raw distance of any channel, for the paper's single-minimum rule
    where: tuple[int, int]  # its station and shift
    sectors: int


class Consensus:
    """The votes of the newest keyframes, and the hypotheses that they agree on."""

    def __init__(self, stations: Floats32, block: float, config: ConsensusConfig) -> None:
        self.config = config
        self.stations = stations
        self.grid = StationGrid(stations, block)
        self._votes: deque[_Vote] = deque(maxlen=config.window)

    def __len__(self) -> int:
        """Return how many keyframes have voted."""
        return len(self._votes)

    def clear(self) -> None:
        """Forget all votes."""
        self._votes.clear()

    def vote(self, centre: Floats, distances: Mapping[Channel, ScoreVolume] | Mapping[str, ScoreVolume]) -> None:
        """Add one keyframe's distances (M, S) per channel; ``centre`` (3,) is its descriptor's zero, odometry frame.

        Channels are standardised (median and MAD over all hypotheses) before they are averaged: how far a
        hypothesis stands out is comparable between channels and places, the distance itself is not.
        """
        best = min(distances.values(), key=lambda volume: float(volume.min()))
        station, shift = np.unravel_index(int(best.argmin()), best.shape)
        mean = np.zeros_like(best)
        for volume in distances.values():
            mean += robust_zscore(volume)
        mean *= np.float32(1.0 / len(distances))
        scores = self.grid.to_grid(np.ascontiguousarray(mean.T))
        where = int(station), int(shift)
        self._votes.append(_Vote(centre, scores, float(best.min()), where, best.shape[1]))

    def vote_nearest(self, centre: Floats, nearest: dict[Channel, Nearest], sectors: int) -> None:
        """Add one keyframe for mode ``single``: the nearest station of each channel, out of ``sectors`` shifts."""
        best = min(nearest.values(), key=lambda found: float(found.distance[0]))
        where = int(best.station[0]), int(best.shift[0])
        self._votes.append(_Vote(centre, _NO_VOTES, float(best.distance[0]), where, sectors))

    def hypotheses(self) -> list[Hypothesis]:
        """Return the best spatially distinct hypotheses, best first; none before the first vote."""
        if not self._votes:
            return []
        if self.config.mode == "single":
            vote = min(self._votes, key=lambda vote: vote.smallest)
            return [self._hypothesis(*vote.where, vote.smallest, vote.centre)]
        return self._peaks(self.scores(), self._votes[-1].centre)

    def scores(self) -> ScoreVolume:
        """Sum the votes (M, S) for the newest keyframe to stand at station m with shift n, per sqrt(keyframe)."""
        newest = self._votes[-1]
        total = newest.scores.copy()
        yaw = yaw_of_shift(np.arange(len(total)), len(total))
        turns = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        for vote in list(self._votes)[:-1]:
            step = vote.centre - newest.centre
            cells = np.rint(np.tensordot(step[:2], turns, (0, 1)).T / self.grid.block).astype(np.int64)
            for n, cell in enumerate(cells):
                self.grid.add(total[n], vote.scores[n], cell, float(step[2]))
        total *= np.float32(1.0 / np.sqrt(len(self._votes)))
        return np.asarray(self.grid.from_grid(total).T)

    def _peaks(self, scores: ScoreVolume, centre: Floats) -> list[Hypothesis]:
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
        """Apply eq. 12, corrected: the rotation is about the keyframe's centre, not the odometry frame's origin."""
        turn = rot_z(float(yaw_of_shift(shift, self._votes[-1].sectors)))
        T = pose_from(turn, self.stations[station].astype(np.float64)) @ pose_from(np.eye(3), -centre)
        return Hypothesis(T, station, shift, score)


def yaw_of_shift(shift: npt.ArrayLike, sectors: int) -> Floats:
    """Return the heading of the odometry frame's x axis in the map for shift n (any shape), radians (eq. 9)."""
    return np.asarray(shift, dtype=np.float64) * (-2.0 * np.pi / sectors)


def robust_zscore(volume: ScoreVolume) -> ScoreVolume:
    """Return by how many robust standard deviations (M, S) each distance exceeds the median; negative is better."""
    sample = _sample(volume)
    if not len(sample):
        return np.zeros_like(volume)
    median = np.median(sample)
    deviation = np.float32(1.4826 * np.median(np.abs(sample - median)) + 1e-6)
    scores: ScoreVolume = (volume - median) * np.float32(1.0 / deviation)
    if median > 1.0:  # unscored entries (1.0) must not get a negative z-score
        np.maximum(scores, np.float32(0.0), out=scores, where=volume == 1.0)
    return scores


def _sample(volume: ScoreVolume) -> Floats32:
    """Draw distances (K,) at every shift of every so many stations, without stations that were not scored."""
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
    # a bound from a sample rules most out; where it leaves fewer than ``count``, all are sorted
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


class StationGrid:
    """The square grid at whose cells' centres the stations stand, one per level: values are added a step apart on it.

    The values of stations, ``(S, M)``, take either of two layouts, which agree for steps of less than 100 cells. Where
    at least a quarter of the cells has a station, and none has two, the values form a raster, ``(S, H, W)``, and a step
    is a shifted slice; otherwise (a lone road, or storeys) each is looked up, ``(S, M + 1)``, where the last column
    means no station.

    Attributes:
        is_raster: whether the first layout is used.
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
        self.is_raster = bool(single and len(stations) >= _FILLED * rows * columns)
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

    def shifted_index(self, step: Ints, rise: float) -> Indices:
        """Return the index (M,) of the station ``step`` (2,) cells away from each station, -1 where there is none.

        ``rise`` is the height gained on the way, metres; it picks the storey.
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

    def to_grid(self, values: Floats32) -> Floats32:
        """Return values (S, M) of the stations in the layout for :meth:`add`; a cell without a station has zero."""
        if not self.is_raster:
            return np.concatenate([values, np.zeros((len(values), 1), dtype=np.float32)], axis=1)
        cells = np.zeros((len(values), self._shape[0] * self._shape[1]), dtype=np.float32)
        cells[:, self._cell] = values
        return cells.reshape(len(values), *self._shape)

    def from_grid(self, layout: Floats32) -> Floats32:
        """Return values (S, M) of the stations from their layout; undoes :meth:`to_grid`."""
        if not self.is_raster:
            return layout[:, :-1]
        return np.asarray(layout.reshape(len(layout), -1)[:, self._cell])

    def add(self, total: Floats32, values: Floats32, step: Ints, rise: float) -> None:
        """Add to each station's ``total`` the one of ``values`` ``step`` cells away; both are one row of a layout."""
        if not self.is_raster:
            total[:-1] += values.take(self.shifted_index(step, rise))  # -1, no station there, finds the zero
            return
        (rows, columns), (down, across) = self._shape, step.tolist()
        if abs(down) < rows and abs(across) < columns:
            to = slice(max(0, -down), rows - max(0, down)), slice(max(0, -across), columns - max(0, across))
            of = slice(max(0, down), rows - max(0, -down)), slice(max(0, across), columns - max(0, -across))
            total[to] += values[of]
