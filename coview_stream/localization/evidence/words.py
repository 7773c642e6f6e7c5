"""Probabilities in words for people: 1 in so many."""

from __future__ import annotations

LEAST = 1e-9
"""Least probability that is reported: the model of the evidence is no better."""


def one_in(probability: float) -> str:
    """Return a probability in words, rounded up to two digits: 1 in 60,000."""
    if probability >= 0.5:
        return "more likely than not"
    if probability < LEAST:
        return f"less than 1 in {1.0 / LEAST:,.0f}"
    number = 1.0 / probability * (1.0 + 1e-7)  # the rounding of 1 - confidence must not turn 10,000 into 9,900
    digits = 10 ** max(0, len(str(int(number))) - 2)
    return f"1 in {int(number // digits * digits):,}"
