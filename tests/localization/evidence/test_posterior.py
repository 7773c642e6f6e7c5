"""Posterior: places share one probability with "none of these", which wins by default."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coview_stream.localization.evidence.likelihood import expected_by_chance, posterior

FIRST = np.array([True])


def of(ratios, votes=None, count=None):
    ratios = np.asarray(ratios, dtype=float)
    votes = np.zeros(len(ratios), dtype=int) if votes is None else np.asarray(votes)
    return posterior(ratios, votes, len(ratios) if count is None else count)


def mask(count, *chosen):
    same = np.zeros(count, dtype=bool)
    same[list(chosen)] = True
    return same


@given(st.lists(st.tuples(st.floats(-900, 900), st.integers(0, 400)), max_size=40), st.integers(0, 500))
def test_probabilities_sum_to_one(places, more):
    found = of([ratio for ratio, _ in places], [rank for _, rank in places], len(places) + more)
    assert found.place.shape == (len(places),)
    assert (found.place >= 0).all()
    assert found.none >= 0
    assert found.place.sum() + found.none == pytest.approx(1.0)


def test_none_of_these_wins_without_evidence():
    """However many places were scored: what explains no more than chance is not where the robot is."""
    assert of([]).none == 1.0
    for count in (1, 5, 300):
        ratios = np.zeros(count)
        assert of(ratios, np.arange(count)).none == pytest.approx(0.5)  # the prior
        assert of(ratios - 2.0, np.arange(count)).none > 0.8
        assert of(ratios[:1], count=count).none > of(ratios[:1], count=1).none - 1e-12


@pytest.mark.parametrize("ratio", [5.0, 40.0, 700.0])
def test_equal_twins_share(ratio):
    twins = of([ratio, ratio, -3.0], count=200)
    assert twins.place[0] == twins.place[1]
    assert twins.error(mask(3, 0)) >= 0.5
    assert twins.error(mask(3, 0, 1)) < twins.error(mask(3, 0))
    four = of([ratio] * 4)
    assert four.place == pytest.approx([four.place[0]] * 4)
    assert four.error(mask(4, 2)) >= 0.75


def test_more_places_make_one_less_certain():
    """A place with the same evidence among more places is more likely to be chance's."""
    errors = [of([12.0], count=count).error(FIRST) for count in (1, 10, 100, 1000)]
    assert errors == sorted(errors)
    assert errors[0] < errors[-1]


def test_vote_rank_lowers_the_prior():
    errors = [of([12.0], [rank], 300).error(FIRST) for rank in (0, 1, 10, 100, 299, 10_000)]
    assert errors == sorted(errors)
    assert errors[0] < errors[3]
    assert errors[4] == errors[5]  # a place that no vote named comes last


def test_small_errors_are_exact():
    """1 - p is 0 in float64 from 1e-16 on: the error is summed over all that is not the place."""
    for ratio in (20.0, 60.0, 200.0, 600.0):
        found = of([ratio], count=1)
        assert found.error(FIRST) == pytest.approx(math.exp(-ratio), rel=1e-6)
    rival = of([300.0, 200.0], count=2)
    assert rival.error(mask(2, 0)) == pytest.approx(math.exp(-100.0), rel=1e-6)
    assert 1.0 - rival.place[0] == 0.0
    assert of([300.0, 200.0, 250.0], count=3).error(mask(3, 0)) == pytest.approx(math.exp(-50.0), rel=1e-6)


def test_huge_and_tiny_ratios_stay_finite():
    for ratios in ([1e5, -1e5, 0.0], [-1e5, -1e5], [1e5, 1e5]):
        found = of(ratios, count=50)
        assert np.isfinite(found.place).all()
        assert found.place.sum() + found.none == pytest.approx(1.0)


# ---- against chance


@pytest.mark.parametrize("count", [1, 10, 250])
def test_expected_number_by_chance_is_markovs_bound(count):
    assert expected_by_chance(0.0, count) == count
    assert expected_by_chance(-5.0, count) == count  # no more than were scored
    assert expected_by_chance(math.log(1000.0), count) == pytest.approx(count / 1000.0)


def test_chance_reaches_a_likelihood_ratio_no_more_often_than_its_inverse():
    """Ten thousand searches among 50 places by chance, whose ratios are those of a coin against a biased one."""
    rng = np.random.default_rng(1)
    heads = rng.binomial(40, 0.3, (10_000, 50))
    ratios = heads * np.log(0.6 / 0.3) + (40 - heads) * np.log(0.4 / 0.7)
    best = ratios.max(axis=1)
    for wanted in (1.0, 0.1, 0.01):
        seen = np.mean([expected_by_chance(ratio, 50) <= wanted for ratio in best])
        assert seen <= wanted + 3.0 * np.sqrt(wanted / len(best))
    errors = np.array([of(each, np.arange(50)).error(mask(50, int(each.argmax()))) for each in ratios[:4000]])
    assert (errors < 0.1).mean() < 0.1
