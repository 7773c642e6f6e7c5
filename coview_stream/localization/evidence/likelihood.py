"""Likelihood ratio of a place: "the robot is here" against chance, as explanations of the observations.

At the right place the survey explains an unchanged share q of the structure, and chance the rest. So an outcome has the
probability

    m = q d + (1 - q) b

with b its background probability and d its probability for unchanged structure in a survey of this kind. The sum is
over three nuisance parameters: q (the site may have changed), d (a survey from above shows roofs, one from the ground
facades) and the share of rays that pass through structure (foliage). Most sites have changed little, so q has the
density 2 q; the chance shares of edges and walls inform d. With n the effective number of observations of a kind and s
the shares of their outcomes, the log-likelihood ratio is n sum(s log(m / b)): a place that explains no more than chance
cannot gain, as q >= 0. Points outside the survey add nothing; a rival that covers them gains.

The ground counts as one observation, as a road is level everywhere: its share is compared with the Beta distribution of
the chance places' shares. Some chance places are as clear and level as the right one
(:mod:`coview_stream.localization.evidence.open_places`).

The prior is even between "one of these places" and "none of these" (outside the map, a wrong map, a rearranged site),
and falls with a place's rank in the votes. Likelihoods are against chance, so "none of these" has the likelihood 1.
Chance gives a ratio of R or more with probability 1 / R at most (Markov's inequality), so N places give at most N / R
equally good ones by chance, in expectation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.geometry.arrays import Bools, Floats, Floats32, Ints
from coview_stream.geometry.distributions import log_beta
from coview_stream.localization.evidence.background import Background, outcomes
from coview_stream.localization.evidence.observation import Share

KEPT = np.linspace(0.05, 1.0, 20)  # shares q
_KEPT_PRIOR = KEPT / KEPT.sum()
_SURVEYS = np.array([
    [0.1, 0.25, 0.6, 0.05],
    [0.2, 0.4, 0.35, 0.05],
    [0.3, 0.15, 0.45, 0.1],
    [0.5, 0.25, 0.15, 0.1],
    [0.65, 0.25, 0.05, 0.05],
    [0.8, 0.17, 0.02, 0.01],
])  # fmt: skip
"""Outcomes of unchanged structure, set by hand: on, near, under an edge, unexplained. The rows range from an airborne
survey (a closed canopy, then hedges and crowns with few returns, then streets) to a survey from the ground."""
_EDGES = _SURVEYS[:, 2] / _SURVEYS[:, :3].sum(axis=1)  # share of the explained points below an edge
_EDGES_WIDTH = 0.1  # excess of that share over chance's that lowers a survey's odds e-fold
_LEAKS = np.array([0.05, 0.3, 0.6])  # rays through unchanged structure, as a share of the background's
_GROUND = (5.0, 1.5)  # Beta distribution of the share of the ground at the right place: grass and litter lower it
_EDGE = 0.02  # shares of the ground are clipped to this margin

_NORMAL = np.linspace(-8.0, 8.0, 129)  # standard deviations
_NORMAL_WEIGHTS = -0.5 * np.square(_NORMAL) - np.log(np.exp(-0.5 * np.square(_NORMAL)).sum())  # logarithms

NUISANCES = (len(KEPT), len(_SURVEYS), len(_LEAKS))
"""Shape (Q, D, L) of a table over the nuisance parameters: unchanged share, kind of survey, leaks."""


def log_likelihood_ratios(observed: Floats32, background: Background) -> Floats:
    """Return log-likelihood ratios (P,) of places against chance, summed over the nuisance parameters.

    ``observed`` (P, 7) are mean observations, see :class:`Share`; (P, 15) with the outcomes around the places.
    """
    if not len(observed):
        return np.empty(0)
    table = log_likelihoods(observed, background).reshape(len(observed), -1)
    top = table.max(axis=1)
    return np.asarray(np.log(np.exp(table - top[:, None]) @ nuisance_prior(background).ravel()) + top)


def nuisance_prior(background: Background) -> Floats:
    """Return the prior probabilities (Q, D, L) of the nuisance parameters, which add up to one.

    Chance also puts a scan on walls where the survey shows walls, and below edges where it shows roofs. So surveys
    whose share below edges exceeds chance's are improbable.
    """
    chance = background.structure[2] / background.structure[:3].sum()
    kinds = 1.0 / (1.0 + np.exp((_EDGES - chance) / _EDGES_WIDTH))
    table = _KEPT_PRIOR[:, None, None] * (kinds / kinds.sum())[:, None]
    return np.asarray(np.repeat(table, len(_LEAKS), axis=2) / len(_LEAKS))


def ratio_variances(observed: Floats32, background: Background) -> Floats:
    """Return the variances (P,) of log-likelihood ratios by the standard errors of chance at each place.

    An error counts by the share that unchanged structure explains, at the most probable nuisance values. From place to
    place all outcomes vary together, with the density of the map, so these errors add up, unlike errors around a place.
    """
    counts = outcomes(observed)
    chance = background.structure_at(observed)[:, None, None]
    right = KEPT[:, None, None] * _SURVEYS
    explained = right + (1.0 - KEPT[:, None, None]) * chance  # (P, Q, D, 4)
    structure = np.einsum("pc,pqdc->pqd", counts, np.log(explained / chance)) * background.number[0]
    best = (structure + np.log(nuisance_prior(background).sum(axis=2))).reshape(len(counts), -1).argmax(axis=1)
    unchanged = (right / explained).reshape(len(explained), -1, 4)
    weights = background.number[0] * counts * unchanged[np.minimum(np.arange(len(counts)), len(explained) - 1), best]
    own, shared = background.relative_errors_at(observed)
    return np.asarray(np.square(weights * own).sum(axis=1) + np.square((weights * shared).sum(axis=1)))


def log_likelihoods(observed: Floats32, background: Background) -> Floats:
    """Return log-likelihood ratios (P, Q, D, L) of places against chance, by nuisance values."""
    counts = outcomes(observed)
    q = KEPT[:, None, None]
    chance = background.structure_at(observed)[:, None, None]
    explained = q * _SURVEYS + (1.0 - q) * chance  # (P, Q, D, 4)
    structure = np.einsum("pc,pqdc->pqd", counts, np.log(explained / chance)) * background.number[0]
    rest = clear_and_level(observed, background)
    rest -= np.logaddexp(np.log1p(-background.open), np.log(background.open) + rest)  # a chance place may also be open
    return np.asarray(structure[:, :, :, None] + rest[:, :, None, :])


def clear_and_level(observed: Floats32, background: Background) -> Floats:
    """Return log-likelihood ratios (P, Q, L) of free space and ground against a chance place that is not open."""
    passed = background.passed * (KEPT[:, None] * _LEAKS + 1.0 - KEPT[:, None])  # (Q, L)
    hit = observed[:, Share.PASSED].astype(np.float64)
    covered = np.maximum(observed[:, Share.COVERED], observed[:, Share.COVERED_GROUND])
    clear = np.maximum(covered - hit, 0.0)
    free = np.multiply.outer(hit, background.number[1] * np.log(passed / background.passed))
    free += np.multiply.outer(clear, background.number[1] * np.log((1.0 - passed) / (1.0 - background.passed)))
    ground = observed[:, Share.COVERED_GROUND].astype(np.float64)
    share = np.clip(observed[:, Share.GROUND] / np.maximum(ground, 0.05), _EDGE, 1.0 - _EDGE)
    a, b = background.ground
    mean = np.full(1, min(max(a / (a + b), _EDGE), 1.0 - _EDGE))
    gain, usual = (_beta(x, *_GROUND) - _beta(x, a, b) for x in (share, mean))
    # a place rougher than chance gets no more than a place like chance, however rare it is
    level = np.clip(ground, 0.0, 1.0) * np.where(share < mean, np.minimum(gain, usual), gain)
    free += level[:, None, None]
    return np.asarray(free)


def _beta(x: Floats, a: float, b: float) -> Floats:
    return np.asarray((a - 1.0) * np.log(x) + (b - 1.0) * np.log1p(-x) - log_beta(a, b))


@dataclass(frozen=True)
class Posterior:
    """Probabilities of places."""

    place: Floats  # (P,) probability that the robot is at the place
    none: float  # probability that it is at none of them

    def error(self, same: Bools) -> float:
        """Return the probability that the robot is at none of the places ``same`` (P,), exact near 0."""
        return float(self.place[~same].sum() + self.none)


def posterior(ratios: Floats, votes: Ints, count: int, starts: int = 1, variances: Floats | None = None) -> Posterior:
    """Return the posterior of places with log-likelihood ratios (P,) against chance and vote ranks (P,) from 0.

    ``count`` is the number N of scored places, including these: the others have the likelihood of chance. ``starts`` is
    the number of starts of the search since a place was accepted, ``variances`` (P,) are of the ratios, default none.

    It may be evaluated after every keyframe: where every place is wrong, the odds of all places together are a
    martingale, so the probability that they ever exceed 1 / e is e at most (Ville's inequality). Each restart is one
    more chance of an error. The prior falls with the square of ``starts``, so all starts together have less than 2 e.
    """
    ranks = np.minimum(votes, max(count, 1) - 1)
    # two recognizers rank places, and followed places keep their ranks: their sum may exceed that of one list
    harmonic = float((1.0 / np.arange(1, max(count, 1) + 1)).sum())
    total = max(harmonic, float((1.0 / (1.0 + ranks)).sum()))
    logs = np.append(ratios - np.log1p(ranks) - np.log(total * starts**2), 0.0)
    leader = int(logs.argmax())
    gaps = logs[leader] - logs
    if variances is not None and leader < len(ranks):
        gaps = _mean_gaps(gaps, np.sqrt(np.append(variances, 0.0) + variances[leader]))
    odds = np.exp(-gaps)
    odds /= odds.sum()
    return Posterior(odds[:-1], float(odds[-1]))


def _mean_gaps(gaps: Floats, sigmas: Floats) -> Floats:
    """Return the log-odds (N,) of the mean probability under normal errors ``sigmas`` of log-odds ``gaps`` (N,)."""
    uncertain = gaps - sigmas * _NORMAL[:, None]
    wrong = np.logaddexp.reduce(_NORMAL_WEIGHTS[:, None] - np.logaddexp(0.0, uncertain), axis=0)
    return np.asarray(np.where(gaps > 0.0, np.log(-np.expm1(wrong)) - wrong, gaps))


def odds_of(gaps: Floats, variances: Floats) -> Floats:
    """Return the odds (N,) of places against a leader, whose log-ratio exceeds theirs by uncertain ``gaps`` (N,)."""
    return np.asarray(np.exp(-_mean_gaps(gaps, np.sqrt(variances))))


def expected_by_chance(ratio: float, count: int) -> float:
    """Return an upper limit on the expected number of ``count`` chance places with a log-ratio of ``ratio`` or more."""
    return float(count * np.exp(-max(ratio, 0.0)))
