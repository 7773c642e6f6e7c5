"""Likelihood ratio of a place: how much better "the robot is here" explains the observations than chance does.

At the right place a share q of what stands is still as the map has it, and is explained as the survey allows; of the
rest, chance explains what it explains anywhere. So an outcome has the probability

    m = q d + (1 - q) b

with b the background's and d what a survey of this kind shows of what is there. q (the site may have changed), d (a
survey from above shows roofs, one from the ground facades) and the share of rays that pass through what stands
(foliage) are nuisances: they are summed over. Most sites are much as the survey has them, so a share q has the density
2 q; and what chance shows of edges and of walls tells something of d. With n the effective number of observations of a
kind and s the shares of their outcomes, the log-likelihood ratio is n sum(s log(m / b)): a place that explains no more
than chance cannot gain, as q >= 0. What the map does not cover adds nothing; a rival that has it covered gains by it.

The ground is one observation of a place, not many, for a road is level everywhere: its share is held against the Beta
distribution of the chance places' shares. One chance place in a hundred is presumed to be as clear and as level as the
right one.

The prior of a place is even between "one of these" and "none of these" (outside the map, a wrong map, a rearranged
site), and among these falls with its rank in the votes that named it. As likelihoods are against chance, "none of
these" has the likelihood 1. Chance gives a ratio of R or more with a probability of at most 1 / R (Markov), so N places
give at most N / R equally good ones by chance, in expectation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import betaln

from coview_stream.geometry.arrays import Bools, Floats, Floats32, Ints
from coview_stream.localization.evidence.background import Background, outcomes
from coview_stream.localization.evidence.observation import Share

# set by hand
KEPT = np.linspace(0.05, 1.0, 20)  # shares q that are summed over
_KEPT_PRIOR = KEPT / KEPT.sum()
_SURVEYS = np.array(
    [
        [0.1, 0.25, 0.6, 0.05],
        [0.2, 0.4, 0.35, 0.05],
        [0.3, 0.15, 0.45, 0.1],
        [0.5, 0.25, 0.15, 0.1],
        [0.65, 0.25, 0.05, 0.05],
        [0.8, 0.17, 0.02, 0.01],
    ]
)
"""Outcomes of what is there: on, near, under an edge, unexplained; from an airborne survey, of a canopy that hides what
stands below it, of hedges and crowns that few pulses have met, and then of streets, to one of the same kind."""
_EDGES = _SURVEYS[:, 2] / _SURVEYS[:, :3].sum(axis=1)  # of what they explain, the share that is below an edge
_EDGES_WIDTH = 0.1  # where that is more than what chance has, its odds fall e-fold for each so much more
_LEAKS = np.array([0.05, 0.3, 0.6])  # of the background's passed rays, those that pass what stands there
_GROUND = (5.0, 1.5)  # Beta distribution of the share of the ground at the right place: grass and litter lower it
_OPEN = 0.01  # share of chance places that are as clear of structure and as level as the right one: an open road
_EDGE = 0.02  # shares of the ground beyond it are not told apart


NUISANCES = (len(KEPT), len(_SURVEYS), len(_LEAKS))
"""Shape (Q, D, L) of a table over the nuisances: share kept, kind of survey, leaks."""


def log_likelihood_ratios(observed: Floats32, background: Background) -> Floats:
    """Return log-likelihood ratios (P,) of places against chance, summed over the nuisances.

    Args:
        observed: (P, 7) mean observations at the places, see :class:`Share`.
        background: the shares that chance explains.
    """
    if not len(observed):
        return np.empty(0)
    table = log_likelihoods(observed, background).reshape(len(observed), -1)
    top = table.max(axis=1)
    return np.asarray(np.log(np.exp(table - top[:, None]) @ nuisance_prior(background).ravel()) + top)


def nuisance_prior(background: Background) -> Floats:
    """Return the probabilities (Q, D, L) of the nuisances before a place is looked at; they add up to one.

    By chance, too, a scan falls on map structure where the survey shows walls, and below edges where it does not: of
    what the right place explains, no greater share is below edges than of what chance explains, or not by much.
    """
    chance = background.structure[2] / background.structure[:3].sum()
    kinds = 1.0 / (1.0 + np.exp((_EDGES - chance) / _EDGES_WIDTH))
    each = _KEPT_PRIOR[:, None, None] * (kinds / kinds.sum())[:, None]
    return np.asarray(np.repeat(each, len(_LEAKS), axis=2) / len(_LEAKS))


def log_likelihoods(observed: Floats32, background: Background) -> Floats:
    """Return log-likelihood ratios (P, Q, D, L) of places against chance, for each value of the nuisances."""
    counts = outcomes(observed)
    q = KEPT[:, None, None]
    explained = q * _SURVEYS + (1.0 - q) * background.structure  # (Q, D, 4)
    structure = np.einsum("pc,qdc->pqd", counts, np.log(explained / background.structure)) * background.number[0]
    passed = background.passed * (KEPT[:, None] * _LEAKS + 1.0 - KEPT[:, None])  # (Q, L)
    hit = observed[:, Share.PASSED].astype(np.float64)
    covered = np.maximum(observed[:, Share.COVERED], observed[:, Share.COVERED_GROUND])
    clear = np.maximum(covered - hit, 0.0)
    free = background.number[1] * (
        hit[:, None, None] * np.log(passed / background.passed)
        + clear[:, None, None] * np.log((1.0 - passed) / (1.0 - background.passed))
    )
    beside = free + _ground(observed, background)[:, None, None]
    beside -= np.logaddexp(math.log1p(-_OPEN), math.log(_OPEN) + beside)  # chance, too, may stand on an open road
    return np.asarray(structure[:, :, :, None] + beside[:, :, None, :])


def _ground(observed: Floats32, background: Background) -> Floats:
    covered = observed[:, Share.COVERED_GROUND].astype(np.float64)
    share = np.clip(observed[:, Share.GROUND] / np.maximum(covered, 0.05), _EDGE, 1.0 - _EDGE)
    a, b = background.ground
    gain = _beta(share, *_GROUND) - _beta(share, a, b)
    mean = np.full(1, min(max(a / (a + b), _EDGE), 1.0 - _EDGE))
    # a place that is rougher than chance is worth no more than one that is like chance, however rare it is
    usual = float((_beta(mean, *_GROUND) - _beta(mean, a, b))[0])
    return np.asarray(np.clip(covered, 0.0, 1.0) * np.where(share < mean, np.minimum(gain, usual), gain))


def _beta(x: Floats, a: float, b: float) -> Floats:
    return np.asarray((a - 1.0) * np.log(x) + (b - 1.0) * np.log1p(-x) - betaln(a, b))


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
