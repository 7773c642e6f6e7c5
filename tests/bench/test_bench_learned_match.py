"""What learned matching is compared with computes the same."""

from __future__ import annotations

import numpy as np
import pytest

from bench.speed import learned_match
from coview_stream.localization.search.learned.consistent_pairs import maximum_clique
from coview_stream.localization.search.learned.correlation import correlate
from coview_stream.localization.search.learned.feature_index import FeatureIndex


def test_both_dense_baselines_equal_ours_on_a_map_that_is_not_square():
    rng = np.random.default_rng(0)
    features = rng.normal(size=(3, 40, 71)).astype(np.float32)
    query, weight = rng.normal(size=(3, 32, 32)).astype(np.float32), np.ones((32, 32), np.float32)
    yaws = np.array([0.2, 1.9])
    ours = correlate(query, weight, FeatureIndex(features, (0, 0)), yaws, min_coverage=None)
    np.testing.assert_allclose(ours, learned_match.OneFft(features)(query, weight, yaws), atol=1e-5)
    np.testing.assert_allclose(ours, learned_match.convolved(features, query, weight, yaws), atol=1e-5)
    with pytest.raises(RuntimeError, match="differ"):
        learned_match._same(ours, ours + 0.01)


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_listing_all_cliques_finds_the_largest(share):
    rng = np.random.default_rng(1)
    upper = np.triu(rng.random((40, 40)) < share, 1)
    weights = (upper | upper.T).astype(np.float32)
    found = maximum_clique(weights, 100_000)
    assert found.exact
    assert learned_match.enumerated(weights > 0) == len(found)
