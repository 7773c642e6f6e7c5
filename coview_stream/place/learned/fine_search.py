"""From a place to within a few metres, to a pose: by correlation on fine cells, where keypoints do not agree."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.fft import next_fast_len

from coview_stream.geometry import wrap_angle
from coview_stream.place.learned.coarse_map import CoarseMap
from coview_stream.place.learned.correlation import COVERED, correlate

F32 = npt.NDArray[np.float32]


@dataclass(frozen=True)
class FinePose:
    """``p_map = R(yaw) p_query + (x, y)`` at the peak of the mean inner product, metres and radians in [-pi, pi)."""

    x: float
    y: float
    yaw: float
    score: float


def refine_on_grid(
    query: F32,
    weight: F32,
    features: npt.NDArray[np.floating],
    corner: npt.ArrayLike,
    start: tuple[float, float, float],
    *,
    radius: float = 5.0,
    spread: float = math.radians(10.0),
    steps: int = 5,
    cell: float = 1.0,
    surveyed: npt.NDArray[np.bool_] | None = None,
    covered: float | None = COVERED,
) -> FinePose | None:
    """Correlate on all cells near a start and at headings about its own, then between cells by a parabola per axis.

    Args:
        query: (C, h, h), h even, times its weight, the query's frame in the middle.
        weight: (h, h).
        features: (C, H, W) of the map, or of a part of it.
        corner: (2,) x and y of the lower corner of the map's cell (0, 0), metres.
        start: x and y (metres) and heading (radians) of the query's frame in the map.
        radius: how far off it may be, metres.
        spread: how far its heading may be off, radians; it is searched in ``steps`` steps to either side.
        steps: at least 1.
        cell: edge of a cell of either, metres.
        surveyed: (H, W), see :class:`CoarseMap`.
        covered: see :func:`correlate`.

    Returns:
        None where no place within reach has enough of the map under it.

    Raises:
        ValueError: query and map do not fit.
    """
    if steps < 1:
        raise ValueError(f"{steps} steps to either side of the heading: at least 1 is needed")
    margin, reach = query.shape[1] // 2, math.ceil(radius / cell)
    origin = np.asarray(corner, dtype=np.float64)
    col, row = np.rint((np.asarray(start[:2]) - origin) / cell - 0.5).astype(int)
    top, left = (max(0, at - reach - margin) for at in (row, col))
    bottom, right = (max(0, at + reach + margin + 1) for at in (row, col))
    part = features[:, top:bottom, left:right]
    if not part.size:
        return None
    known = CoarseMap(
        part,
        origin + np.array([left, top]) * cell,
        cell,
        surveyed=None if surveyed is None else surveyed[top:bottom, left:right],
        block=next_fast_len(2 * (margin + reach) + 1, real=True),
        margin=margin,
        most_bytes=0,  # most blocks only surround those that are asked for
    )
    yaws = start[2] + np.linspace(-spread, spread, 2 * steps + 1)
    within = radius + 0.5 * cell
    scores = correlate(query, weight, known, yaws, known.blocks_near(start[:2], within), covered)
    rows, cols = np.indices(scores.shape[1:])
    away = known.centre_of(rows, cols) - np.asarray(start[:2])
    scores = np.where(np.hypot(away[..., 0], away[..., 1]) <= within, scores, np.float32(-np.inf))
    if not np.isfinite(scores).any():
        return None
    return _between(scores, known, yaws)


def _between(scores: F32, known: CoarseMap, yaws: npt.NDArray[np.float64]) -> FinePose:
    """Peak of scores (K, H, W), between cells and headings."""
    k, r, c = (int(at) for at in np.unravel_index(int(scores.argmax()), scores.shape))
    turn, down, right = _vertex(scores[:, r, c], k), _vertex(scores[k, :, c], r), _vertex(scores[k, r], c)
    x, y = known.centre_of(r + down, c + right)
    yaw = wrap_angle(float(yaws[k] + turn * (yaws[1] - yaws[0])))
    return FinePose(float(x), float(y), yaw, float(scores[k, r, c]))


def _vertex(values: F32, peak: int) -> float:
    """Where between its neighbours (-0.5 to 0.5) a parabola peaks; 0 where a neighbour is missing."""
    if not 0 < peak < len(values) - 1:
        return 0.0
    before, at, after = (float(value) for value in values[peak - 1 : peak + 2])
    bend = before - 2.0 * at + after
    if not math.isfinite(bend) or bend >= 0.0:
        return 0.0
    return min(0.5, max(-0.5, 0.5 * (before - after) / bend))
