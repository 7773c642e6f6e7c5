"""Places: poses that are one place, and the probabilities of a keyframe's places."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from coview_stream.geometry.arrays import Bools, Floats, Floats32
from coview_stream.localization.evidence.moved_part import NO_PART, MovedPart
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.request import SAME_ANGLE, SAME_DISTANCE

BASIN_DISTANCE, BASIN_ANGLE = SAME_DISTANCE, float(np.radians(15.0))
"""Metres and radians from the leader within which registration converges to it."""


@dataclass(frozen=True)
class Scored:
    """Scores of a keyframe's hypotheses."""

    rivals: int  # number of distinct places
    places: list[Hypothesis]  # followed places, most probable first; then those that only the map names
    error: float = 1.0  # probability that the robot is not at the first place
    none: float = 1.0  # probability that it is at no place of the map
    by_chance: float = np.inf  # expected number of chance places as good as the first
    second: Hypothesis | None = None  # most probable place other than the first; None without any
    moved: MovedPart = NO_PART  # part of the scans that fits elsewhere than at the first

    @property
    def left(self) -> int:
        """Effective number of places: the number of equally probable places with the same entropy."""
        probability = np.array([place.probability for place in self.places])
        share = probability[probability > 0.0] / max(float(probability.sum()), 1e-300)
        return round(float(np.exp(-(share * np.log(share)).sum())))

    def together_with(self, other: Scored) -> Scored:
        """Return these places with the error by both readings of the scan, which share their first place.

        The odds against "none", which is common to both, add up; the other's places count only in the error.
        """
        none = [max(each.none, 1e-300) for each in (self, other)]
        right = sum((1.0 - each.error) / part for each, part in zip((self, other), none, strict=True))
        wrong = sum(each.error / part for each, part in zip((self, other), none, strict=True)) - 1.0
        share = 1.0 / (right + wrong)
        places = [replace(place, probability=place.probability / none[0] * share) for place in self.places]
        second = next((k for k, place in enumerate(self.places) if place is self.second), None)
        return replace(
            self, places=places, error=wrong * share, none=share, second=None if second is None else places[second]
        )

    def beside(self, others: list[Hypothesis]) -> Scored:
        """Add places whose ``probability`` is their odds against the first place."""
        if not others:
            return self
        right = 1.0 - self.error  # of all poses around the first place, and of both readings
        share = 1.0 / (1.0 + right * sum(place.probability for place in others))
        places = [replace(place, probability=share * place.probability) for place in self.places]
        added = [replace(place, probability=right * share * place.probability) for place in others]
        second = next((k for k, place in enumerate(self.places) if place is self.second), None)
        rivals = added if second is None else [*added, places[second]]
        return replace(
            self, places=[*places, *added], error=1.0 - share * right, none=share * self.none,
            second=max(rivals, key=lambda place: place.probability),
        )  # fmt: skip

    def weighed(self, odds: Floats, first: Bools) -> Scored:
        """Multiply the odds of places by 1 + ``odds`` (P,), as a prior; ``first`` (P,) masks the first's poses."""
        gain = np.where(first, 1.0 + odds[0], 1.0 + odds)
        probability = np.array([place.probability for place in self.places])
        right = (1.0 + odds[0]) * (1.0 - self.error)
        wrong = self.error + float((odds * probability)[~first].sum())
        places = [
            replace(place, probability=place.probability * factor)
            for place, factor in zip(self.places, (gain / (right + wrong)).tolist(), strict=True)
        ]
        others = [place for place, its in zip(places, first.tolist(), strict=True) if not its]
        second = max(others, key=lambda place: place.probability, default=None)
        return replace(
            self, places=places, error=wrong / (right + wrong), none=self.none / (right + wrong),
            second=None if self.second is None else second,
        )  # fmt: skip

    def doubted(self, moved: MovedPart) -> Scored:
        """Add the error by a moved part, as either part may be the unmoved one."""
        return replace(self, error=min(1.0, self.error + 0.5 * moved.probability), moved=moved)


def apart(poses: Floats, leader: Floats, distance: float, angle: float) -> Bools:
    """Return a mask of the poses (P, 4) more than ``distance`` metres or ``angle`` radians from a leader (4,)."""
    turn = np.abs((poses[:, 3] - leader[3] + np.pi) % (2.0 * np.pi) - np.pi)
    return np.asarray((np.linalg.norm(poses[:, :3] - leader[:3], axis=1) > distance) | (turn > angle))


def same(poses: Floats, others: Floats) -> Bools:
    """Return a mask (P, Q) of the poses (P, 4) and the others (Q, 4) that are one place."""
    (x, y, z, yaw), (u, v, w, turn) = poses.astype(np.float32).T, others.astype(np.float32).T
    gap = np.square(x[:, None] - u) + np.square(y[:, None] - v) + np.square(z[:, None] - w)
    along = np.outer(np.cos(yaw), np.cos(turn)) + np.outer(np.sin(yaw), np.sin(turn))
    return np.asarray((gap < SAME_DISTANCE**2) & (along > np.cos(SAME_ANGLE)))


def grouped(pose: Floats, rank: Floats32) -> list[list[int]]:
    """Group poses (H, 4) into places: lists of rows, best pose and best place first."""
    order = np.argsort(-rank, kind="stable")
    equal = same(pose[order], pose[order])
    free = np.ones(len(order), dtype=bool)
    alone, rows = (np.count_nonzero(equal, axis=1) == 1).tolist(), order.tolist()
    out = []
    for k, row in enumerate(equal):
        if alone[k]:
            out.append([rows[k]])
        elif free[k]:
            members = np.flatnonzero(row & free)
            free[members] = False
            out.append(order[members].tolist())
    return out
