"""Turn about the vertical and shift that lay points on their partners, in closed form."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Alignment:
    """``p_map = R(yaw) p_query + (x, y)``."""

    x: float
    y: float
    yaw: float
    """Radians in (-pi, pi]."""
    residuals: F64
    """(N,) metres, in the plane."""

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, metres."""
        return float(np.sqrt(np.mean(self.residuals**2)))


def align(query: F64, known: F64, weights: F64 | None = None) -> Alignment:
    """Weighted least squares in the plane.

    Args:
        query: (N, 2) metres.
        known: (N, 2) metres, the partners.
        weights: (N,) not negative, not all zero (all 1).

    Raises:
        ValueError: fewer than 2 points, the sides differ in number, or no weight is left.
    """
    if query.shape != known.shape or query.shape[1:] != (2,) or len(query) < 2:
        raise ValueError(f"points {query.shape} and {known.shape}: both have to be (N, 2), N at least 2")
    share = np.ones(len(query)) if weights is None else np.asarray(weights, dtype=np.float64)
    if share.shape != (len(query),) or (share < 0).any() or np.count_nonzero(share) < 2:
        raise ValueError("weights have to be (N,), not negative, and positive for at least 2 points")
    share = share / share.sum()
    middle, other = share @ query, share @ known
    a, b = query - middle, known - other
    sine = share @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    cosine = share @ (a * b).sum(axis=1)
    yaw = math.atan2(sine, cosine)
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    x, y = other - turn @ middle
    missed = b - a @ turn.T
    return Alignment(float(x), float(y), yaw, np.hypot(missed[:, 0], missed[:, 1]))
