"""The paper's own modes, for its table: exact votes, ring keys, the single smallest distance, strict co-visibility."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import numpy as np

from coview_stream import BaseMap
from coview_stream.config import Channel, ConsensusConfig
from coview_stream.descriptors import coview
from coview_stream.geometry.arrays import Floats, Floats32, Ints
from coview_stream.geometry.rasters import argsmallest
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.localization.search import recognizers
from coview_stream.localization.search.consensus import Consensus, Hypothesis, yaw_of_shift
from coview_stream.localization.search.retrieval import Retrieval, StationConsensus, exact_distances

CANDIDATES = 200
"""Stations nearest in ring key that are compared; all others count as distance 1."""

_SAMPLE = 100_000  # distances that a median is taken of


@dataclass(frozen=True)
class Modes:
    """The modes of one variant.

    Attributes:
        ring_key: compare only the stations nearest in ring key.
        single: of all keyframes' distances the one smallest names the place, instead of a consensus.
        strict: keep only what is horizontally visible (eq. 2 alone).
    """

    ring_key: bool = False
    single: bool = False
    strict: bool = False

    @contextmanager
    def descriptors(self) -> Iterator[None]:
        """Describe stations and keyframes by this variant's co-visibility until the block ends."""
        with patch.object(coview, "_VERTICAL", "off" if self.strict else "max"):
            yield

    @contextmanager
    def localizer(self) -> Iterator[None]:
        """Make localizers vote by this variant until the block ends."""

        def consensus(retrieval: Retrieval, config: ConsensusConfig) -> PaperConsensus | StationConsensus:
            exact = self.ring_key or self.single
            return PaperConsensus(retrieval, config, self) if exact else StationConsensus(retrieval, config)

        with self.descriptors(), patch.object(recognizers, "StationConsensus", consensus):
            yield

    def distances(self, base_map: BaseMap, query: Mapping[Channel, Floats32]) -> dict[Channel, Floats32]:
        """Return the distances (M, S) of a query to the stations, by channel."""
        volumes = {}
        for name, descriptor in query.items():
            stations = base_map.descriptors(name)
            if not self.ring_key:
                volumes[name] = exact_distances(stations, descriptor)
                continue
            gap = np.linalg.norm(ring_key(stations.astype(np.float32)) - ring_key(descriptor), axis=1)
            nearest = np.argsort(gap, kind="stable")[:CANDIDATES]
            volumes[name] = np.ones((len(stations), descriptor.shape[-1]), dtype=np.float32)
            volumes[name][nearest] = exact_distances(stations[nearest], descriptor)
        return volumes


def ring_key(descriptor: Floats32) -> Floats32:
    """Return the paper's rotation-invariant key (..., R): share of occupied (non-zero) sectors of every ring."""
    return np.asarray((descriptor != 0).mean(axis=-1, dtype=np.float32))


class TableVote:
    """Vote of z-scores (M, S), lower is better, at every station and shift; the best ``count`` are candidates."""

    def __init__(self, centre: Floats, scores: Floats32, count: int = 4000) -> None:
        self.centre, self.scores, self.count = centre, scores, count

    @classmethod
    def of_distances(cls, centre: Floats, volumes: Iterable[Floats32]) -> TableVote:
        """Average the standardised distances (M, S) of each channel: the distances themselves do not compare."""
        scores = [robust_zscore(volume) for volume in volumes]
        return cls(centre, sum(scores[1:], start=scores[0]) * np.float32(1.0 / len(scores)))

    @property
    def sectors(self) -> int:
        """Number of shifts S."""
        return int(self.scores.shape[1])

    def candidates(self) -> tuple[Ints, Ints]:
        """Return stations and shifts (K,) of the best scores."""
        station, shift = np.divmod(argsmallest(self.scores.ravel(), self.count), self.sectors)
        return station, shift

    def at(self, stations: Ints, shifts: Ints) -> Floats32:
        """Look z-scores (K,) up; 0 for station -1."""
        return np.where(stations < 0, np.float32(0.0), self.scores[stations, shifts])

    def at_all(self, requests: Sequence[tuple[TableVote, Ints, Ints]]) -> list[Floats32]:
        """Look all up, one after the other."""
        return [vote.at(stations, shifts) for vote, stations, shifts in requests]


def robust_zscore(volume: Floats32) -> Floats32:
    """Return the robust standard deviations (M, S) by which each distance exceeds the median; negative is better."""
    every = max(1, volume.size // _SAMPLE)
    sample = np.empty(0, dtype=np.float32)
    for rows in (volume[::every], volume):  # ring keys leave most stations at 1, unscored
        sample = rows[(rows != 1.0).any(axis=1)].ravel()
        if sample.size >= min(_SAMPLE // 2, volume.size // 2):
            break
    if not len(sample):
        return np.zeros_like(volume)
    median = np.median(sample)
    deviation = np.float32(1.4826 * np.median(np.abs(sample - median)) + 1e-6)
    scores: Floats32 = (volume - median) * np.float32(1.0 / deviation)
    if median > 1.0:  # unscored stations must not get a negative z-score
        np.maximum(scores, np.float32(0.0), out=scores, where=volume == 1.0)
    return scores


class SmallestDistance:
    """The newest keyframes' smallest distances; the smallest of them names the place."""

    def __init__(self, stations: Floats32, window: int) -> None:
        self._stations = stations
        self._places: deque[Hypothesis] = deque(maxlen=window)

    def __len__(self) -> int:
        """Return how many keyframes have voted."""
        return len(self._places)

    def clear(self) -> None:
        """Forget all votes."""
        self._places.clear()

    def vote(self, centre: Floats, volumes: Iterable[Floats32]) -> None:
        """Add a keyframe's distances (M, S), one volume per channel; ``centre`` (3,) as in a vote."""
        best = min(volumes, key=lambda volume: float(volume.min()))
        station, shift = (int(n) for n in np.unravel_index(int(best.argmin()), best.shape))
        turn = rot_z(float(yaw_of_shift(shift, best.shape[1])))  # eq. 12, corrected: about the keyframe
        T = pose_from(turn, self._stations[station].astype(np.float64)) @ pose_from(np.eye(3), -centre)
        self._places.append(Hypothesis(T, station, shift, float(best.min())))

    def hypotheses(self) -> list[Hypothesis]:
        """Return the one hypothesis; none before the first vote."""
        return [min(self._places, key=lambda place: place.votes)] if self._places else []


class PaperConsensus:
    """Consensus by exact distances, or their single smallest, with the interface of the product's."""

    def __init__(self, retrieval: Retrieval, config: ConsensusConfig, modes: Modes) -> None:
        self._map: Any = retrieval.base_map
        self._modes = modes
        grid = self._map.station_grid
        self._votes: Consensus | SmallestDistance = (
            SmallestDistance(grid.stations, config.window) if modes.single else Consensus(grid, config)
        )

    def __len__(self) -> int:
        """Return how many keyframes have voted."""
        return len(self._votes)

    def clear(self) -> None:
        """Forget all votes."""
        self._votes.clear()

    def vote(self, centre: Floats, query: Mapping[Channel, Floats32], area: object = None) -> None:
        """Add one keyframe's vote; circles are not searched."""
        add_vote(self._votes, centre, self._modes.distances(self._map, query))

    def hypotheses(self) -> list[Hypothesis]:
        """Return the best hypotheses, best first."""
        return self._votes.hypotheses()


def add_vote(votes: Consensus | SmallestDistance, centre: Floats, volumes: Mapping[Channel, Floats32]) -> None:
    """Add one keyframe's distances to a consensus, or to the single smallest."""
    if isinstance(votes, SmallestDistance):
        votes.vote(centre, volumes.values())
    else:
        votes.vote(TableVote.of_distances(centre, volumes.values()))
