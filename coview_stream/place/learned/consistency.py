"""Which pairs of keypoints can all be true at once: gravity is known, so distances from above must agree."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from coview_stream.place.learned.match_config import LearnedMatchConfig

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]


def consistency(query: F64, known: F64, config: LearnedMatchConfig) -> F32:
    """Weigh how well every two pairs of points agree: a turn about the vertical and a shift keep distances.

    Args:
        query: (N, 2) metres, the pairs' points in the scan.
        known: (N, 2) metres, the same pairs' points in the map.
        config: tolerances.

    Returns:
        (N, N) symmetric, 0 where two pairs contradict each other, lie too close together or are the same one, else
        exp(-d^2 / 2 spread^2) of the difference d of their distances. Mirror images keep distances too: what follows
        has to look at the residuals.

    Raises:
        ValueError: the two sides are of different numbers.
    """
    if query.shape != known.shape or query.shape[1:] != (2,):
        raise ValueError(f"pairs of points {query.shape} and {known.shape}: both have to be (N, 2)")
    here, there = _distances(query), _distances(known)
    apart = np.minimum(here, there) >= config.least_apart
    here -= there
    fits = apart & (np.abs(here) < config.tolerance)
    np.fill_diagonal(fits, False)
    here *= here
    here *= np.float32(-0.5 / config.spread**2)
    return np.where(fits, np.exp(here), np.float32(0.0))


def _distances(xy: F64) -> F32:
    """Distances (N, N) between points; they are subtracted before single precision takes over."""
    step = [(xy[:, None, k] - xy[None, :, k]).astype(np.float32) for k in (0, 1)]
    return np.asarray(np.hypot(*step))
