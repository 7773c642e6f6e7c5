"""Probabilities in words."""

from __future__ import annotations

import pytest

from coview_stream.localization.evidence.words import one_in


@pytest.mark.parametrize(
    ("probability", "words"),
    [
        (1.0, "more likely than not"),
        (0.5, "more likely than not"),
        (0.49, "1 in 2"),
        (0.3, "1 in 3"),
        (1e-2, "1 in 100"),
        (1e-5, "1 in 100,000"),  # 1 / 1e-5 is less than that
        (1.0 - 0.9999, "1 in 10,000"),
        (1 / 61_987, "1 in 61,000"),
        (1e-9, "1 in 1,000,000,000"),
        (9e-10, "less than 1 in 1,000,000,000"),
        (0.0, "less than 1 in 1,000,000,000"),
    ],
)
def test_small_probabilities_in_words(probability, words):
    assert one_in(probability) == words
