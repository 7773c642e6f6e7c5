"""Exact binomial bounds on shares of runs."""

from __future__ import annotations

CONFIDENCE = 0.95
"""Of all bounds, one-sided."""


def upper(events: int, runs: int, confidence: float = CONFIDENCE) -> float:
    """Return the Clopper-Pearson bound that the true share is below; 1 without runs."""
    from scipy.stats import beta

    _checked(events, runs)
    return 1.0 if events == runs else float(beta.ppf(confidence, events + 1, runs - events))


def lower(events: int, runs: int, confidence: float = CONFIDENCE) -> float:
    """Return the Clopper-Pearson bound that the true share is above; 0 without runs."""
    from scipy.stats import beta

    _checked(events, runs)
    return 0.0 if events == 0 else float(beta.ppf(1.0 - confidence, events, runs - events + 1))


def _checked(events: int, runs: int) -> None:
    if not 0 <= events <= runs:
        raise ValueError(f"{events} events of {runs} runs: there are as many runs as events at least")
