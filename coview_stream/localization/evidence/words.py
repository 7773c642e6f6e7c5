"""Probabilities in words for people: 1 in so many."""

from __future__ import annotations

LEAST = 1e-9
"""Smaller probabilities are not told apart: the model of the evidence is not as good as that."""


def one_in(probability: float) -> str:
    """Say a probability in words, with two digits that never understate it: 1 in 60,000."""
    if probability >= 0.5:
        return "more likely than not"
    if probability < LEAST:
        return f"less than 1 in {1.0 / LEAST:,.0f}"
    number = 1.0 / probability * (1.0 + 1e-7)  # what 1 - confidence has lost makes no 9,900 of 10,000
    digits = 10 ** max(0, len(str(int(number))) - 2)
    return f"1 in {int(number // digits * digits):,}"
