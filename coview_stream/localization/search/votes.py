"""Votes of keyframes: what the consensus asks of one, and the vote that is a table of every station and shift."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Generic, NamedTuple, Protocol, Self, TypeVar

import numpy as np

from coview_stream.geometry.arrays import Floats, Floats32, Ints
from coview_stream.geometry.rasters import argsmallest

ScoreVolume = Floats32
"""(M, S): one number for each station and shift."""

_SAMPLE = 100_000  # distances that a median is taken of; set by hand


V = TypeVar("V")


class Request(NamedTuple, Generic[V]):
    """What a vote is asked for.

    Attributes:
        vote: it.
        stations: (K,), -1 for none.
        shifts: (K,).
    """

    vote: V
    stations: Ints
    shifts: Ints


class Vote(Protocol):
    """What one keyframe says of the stations at every shift; shift n means yaw -2 pi n / ``sectors`` (eq. 9)."""

    @property
    def centre(self) -> Floats:
        """(3,) zero of its descriptor, z on the ground; odometry frame, metres."""
        ...

    @property
    def sectors(self) -> int:
        """Number of shifts S."""
        ...

    def candidates(self) -> tuple[Ints, Ints]:
        """Return stations and shifts (K,), each once, where it may have been taken: what is worth the others' votes."""
        ...

    def at(self, stations: Ints, shifts: Ints) -> Floats32:
        """Return z-scores (K,) of stations at shifts, negative is better; 0 for station -1, which is none."""
        ...

    def at_all(self, requests: Sequence[Request[Self]]) -> list[Floats32]:
        """Return what :meth:`at` of each request's vote does; all votes are of the same kind and map as this one."""
        ...


class TableVote:
    """Vote that knows its z-score at every station and shift.

    Attributes:
        centre: (3,) as :attr:`Vote.centre`.
        scores: (M, S) z-scores, lower is better.
        count: how many of the best are candidates.
    """

    def __init__(self, centre: Floats, scores: ScoreVolume, count: int = 4000) -> None:
        self.centre = centre
        self.scores = scores
        self.count = count

    @classmethod
    def of_distances(cls, centre: Floats, volumes: Iterable[ScoreVolume], count: int = 4000) -> TableVote:
        """Make the vote of distances (M, S), one volume per channel.

        Channels are standardised (median and MAD over all stations and shifts) before they are averaged: how far one
        stands out is comparable between channels and places, the distance itself is not.
        """
        scores = [robust_zscore(volume) for volume in volumes]
        mean: ScoreVolume = sum(scores[1:], start=scores[0]) * np.float32(1.0 / len(scores))
        return cls(centre, mean, count)

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

    def at_all(self, requests: Sequence[Request[TableVote]]) -> list[Floats32]:
        """Look all up, one after the other."""
        return [vote.at(stations, shifts) for vote, stations, shifts in requests]


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
