"""Cliques are cliques, the largest where that is claimed, and the relaxation finds what was planted."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coview_stream.localization.search.learned.consistent_pairs import largest_clique, maximum_clique, relaxed_clique


def random_graph(nodes, share, seed):
    rng = np.random.default_rng(seed)
    weights = np.triu(rng.uniform(0.05, 1.0, (nodes, nodes)) * (rng.random((nodes, nodes)) < share), 1)
    return (weights + weights.T).astype(np.float32)


def planted(nodes, members, share, seed):
    rng = np.random.default_rng(seed)
    weights = random_graph(nodes, share, seed)
    chosen = np.sort(rng.choice(nodes, members, replace=False))
    weights[np.ix_(chosen, chosen)] = 1.0
    np.fill_diagonal(weights, 0.0)
    return weights, chosen


def is_clique(weights, members):
    return all(weights[i, j] > 0 for i, j in combinations(members, 2)) and len(set(members)) == len(members)


def clique_number(weights):
    """Size by trying all sets of nodes."""
    nodes = len(weights)
    near = [sum(1 << j for j in range(nodes) if j != i and weights[i, j] > 0) for i in range(nodes)]
    most = 0
    for chosen in range(1 << nodes):
        rest, size = chosen, chosen.bit_count()
        if size <= most:
            continue
        while rest:
            i = (rest & -rest).bit_length() - 1
            rest &= rest - 1
            if chosen & ~near[i] & ~(1 << i):
                break
        else:
            most = size
    return most


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(0, 11), st.floats(0.0, 1.0), st.integers(0, 10_000))
def test_clique_search_equals_brute_force(nodes, share, seed):
    weights = random_graph(nodes, share, seed)
    expected = clique_number(weights)
    for found in (maximum_clique(weights, 100_000), largest_clique(weights > 0, np.empty(0, dtype=np.int64), 100_000)):
        assert found.exact
        assert is_clique(weights, found.members)
        assert len(found) == expected
        assert (np.diff(found.members) > 0).all()


@pytest.mark.parametrize("share", [0.3, 0.6, 0.85])
def test_clique_search_on_sixteen_nodes_equals_brute_force(share):
    weights = random_graph(16, share, 7)
    assert len(maximum_clique(weights, 100_000)) == clique_number(weights)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(1, 60), st.floats(0.0, 1.0), st.integers(0, 10_000))
def test_relaxation_returns_a_maximal_clique(nodes, share, seed):
    weights = random_graph(nodes, share, seed)
    members = relaxed_clique(weights)
    assert len(members) >= 1
    assert is_clique(weights, members)
    others = np.setdiff1d(np.arange(nodes), members)
    assert not (weights[np.ix_(others, members)] > 0).all(axis=1).any()
    proved = largest_clique(weights > 0, members, 3000)
    assert is_clique(weights, proved.members)
    assert len(proved) >= len(members)


@pytest.mark.parametrize(("nodes", "members", "share"), [(200, 20, 0.05), (400, 20, 0.05), (400, 80, 0.1)])
def test_relaxation_finds_planted_clique(nodes, members, share):
    weights, chosen = planted(nodes, members, share, 3)
    np.testing.assert_array_equal(relaxed_clique(weights), chosen)
    found = maximum_clique(weights, 2000)
    np.testing.assert_array_equal(found.members, chosen)
    assert found.exact


def test_relaxation_is_near_optimal_on_random_graphs():
    """The leading eigenvector alone, without the growing penalty, reaches 0.84 of it on average."""
    reached = []
    for seed in range(10):
        weights = random_graph(60, 0.5, seed)
        reached.append(len(relaxed_clique(weights)) / len(maximum_clique(weights, 100_000)))
    assert np.mean(reached) > 0.87


def test_clique_search_finds_planted_clique_without_start():
    weights, chosen = planted(300, 25, 0.2, 5)
    found = largest_clique(weights > 0, np.empty(0, dtype=np.int64), 20_000)
    np.testing.assert_array_equal(found.members, chosen)
    assert found.exact


def test_clique_search_reports_exhausted_branch_limit():
    weights = random_graph(120, 0.7, 0)
    start = relaxed_clique(weights)
    short = largest_clique(weights > 0, start, 20)
    assert not short.exact
    assert is_clique(weights, short.members)
    assert len(short) >= len(start)
    longer = largest_clique(weights > 0, start, 1_000_000)
    assert longer.exact
    assert len(longer) >= len(short)
    np.testing.assert_array_equal(longer.members, largest_clique(weights > 0, start, 1_000_000).members)


def test_empty_and_complete_graphs():
    empty = np.zeros((0, 0), np.float32)
    assert len(maximum_clique(empty, 10)) == 0
    assert maximum_clique(empty, 10).exact
    assert len(maximum_clique(np.zeros((5, 5), np.float32), 10)) == 1
    full = np.ones((300, 300), np.float32)
    np.testing.assert_array_equal(maximum_clique(full, 10).members, np.arange(300))
    deep = largest_clique(full > 0, np.empty(0, dtype=np.int64), 2000)
    np.testing.assert_array_equal(deep.members, np.arange(300))
    assert deep.exact


@pytest.mark.parametrize("start", [[0, 1], [2, 2]])
def test_start_that_is_not_a_clique_is_refused(start):
    with pytest.raises(ValueError, match="no clique"):
        largest_clique(np.zeros((3, 3), bool), np.array(start), 10)
