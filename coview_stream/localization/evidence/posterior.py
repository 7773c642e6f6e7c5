"""Posterior of the places that were scored, and of "none of these": outside the map, a wrong map, a rearranged site.

A place's prior is even between "one of these" and "none", and among these falls with its rank in the votes that named
it. Likelihoods are those of :mod:`coview_stream.localization.evidence.likelihood`, against chance, so that "none of
these" has the likelihood 1. As chance gives a likelihood ratio of R or more with a probability of at most 1 / R
(Markov's inequality), N places give an expected number of at most N / R equally good ones by chance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.geometry.arrays import Bools, Floats, Ints


@dataclass(frozen=True)
class Posterior:
    """Probabilities of places.

    Attributes:
        place: (P,) that the robot is there.
        none: that it is at none of them.
    """

    place: Floats
    none: float

    def error(self, same: Bools) -> float:
        """Return the probability that the robot is at none of the places ``same`` (P,): summed, so that 1e-30 is."""
        return float(self.place[~same].sum() + self.none)


def posterior(ratios: Floats, votes: Ints, count: int, looks: int = 1) -> Posterior:
    """Return the posterior of places.

    Args:
        ratios: (P,) log-likelihood ratios against chance.
        votes: (P,) rank of each in the votes, from 0.
        count: number N of places that were scored, these among them: the others have the likelihood of chance.
        looks: how often a search has looked anew, on other keyframes than before: each is another chance of an error.
    """
    ranks = np.minimum(votes, max(count, 1) - 1)
    # two recognizers rank places, and those that are followed keep theirs: the sum may be more than one list's
    harmonic = float((1.0 / np.arange(1, max(count, 1) + 1)).sum())
    total = max(harmonic, float((1.0 / (1.0 + ranks)).sum()))
    logs = np.append(ratios - np.log1p(ranks) - np.log(total * looks), 0.0)
    odds = np.exp(logs - logs.max())
    odds /= odds.sum()
    return Posterior(odds[:-1], float(odds[-1]))


def expected_by_chance(ratio: float, count: int) -> float:
    """Return the expected number of chance places, of ``count``, with a log-likelihood ratio of ``ratio`` or more."""
    return float(count * np.exp(-max(ratio, 0.0)))
