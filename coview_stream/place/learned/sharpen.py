"""From a place to within a few metres, to a pose: by keypoints that agree."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from coview_stream.geometry import wrap_angle
from coview_stream.place.learned.alignment import Alignment, align
from coview_stream.place.learned.clique import maximum_clique
from coview_stream.place.learned.consistency import consistency
from coview_stream.place.learned.keypoints import Keypoints
from coview_stream.place.learned.match_config import LearnedMatchConfig
from coview_stream.place.learned.matching import Pairs, nearest_pairs

Start = tuple[float, float, float]
"""x and y (metres) and heading (radians) of the query's frame in the map."""


@dataclass(frozen=True)
class Match:
    """``p_map = R(yaw) p_query + (x, y)``, and what it rests on."""

    x: float
    y: float
    yaw: float
    """Radians in (-pi, pi]."""
    inliers: int
    """Pairs of keypoints that agree with the pose."""
    exact: bool
    """Whether it is proved that no more pairs agree with each other."""
    rms: float
    """Root mean square of their residuals in the plane, metres."""


def sharpen(
    query: Keypoints, known: Keypoints, start: Start, config: LearnedMatchConfig | None = None
) -> Match | None:
    """Match the keypoints of a query with those of the map around ``start``.

    Args:
        query: keypoints in the query's frame, whose origin is the middle of what it has seen.
        known: keypoints of the map, or of its part that matters, in the map's frame.
        start: where the query's frame lies in the map, more or less.
        config: tolerances and what a match has to be.

    Returns:
        None where too few pairs agree, or agree on something too far from ``start``.
    """
    config = config or LearnedMatchConfig()
    near = known.around(start[:2], config.reach + config.most_shift)
    possible = _meeting(query, near, start, config)
    pairs, _ = nearest_pairs(query.descriptors, near.descriptors, most=config.pairs, possible=possible)
    if len(pairs) < config.least_inliers:
        return None
    left, right = query.where(pairs[:, 0]), near.where(pairs[:, 1])
    clique = maximum_clique(consistency(left.xy, right.xy, config), config.nodes)
    members = pairs[clique.members]
    while len(members) >= config.least_inliers:
        found = _aligned(query, near, members)
        fits = found.residuals < config.tolerance
        if fits.all():
            return _match(found, len(members), clique.exact) if _close(found, start, config) else None
        # distances alone do not tell a place from its mirror image, and a long clique may bend
        members = members[found.residuals < max(config.tolerance, float(np.median(found.residuals)))]
    return None


def _meeting(
    query: Keypoints, known: Keypoints, start: Start, config: LearnedMatchConfig
) -> npt.NDArray[np.bool_]:
    """Mask (N, M) of the pairs that lie on each other in some pose that would be accepted."""
    c, s = math.cos(start[2]), math.sin(start[2])
    there = query.xy @ np.array([[c, s], [-s, c]]) + start[:2]
    gap = np.hypot(there[:, None, 0] - known.xy[None, :, 0], there[:, None, 1] - known.xy[None, :, 1])
    swing = 2.0 * math.sin(0.5 * min(config.most_turn, math.pi)) * np.hypot(query.xy[:, 0], query.xy[:, 1])
    return np.asarray(gap <= config.most_shift + config.tolerance + swing[:, None])


def _aligned(query: Keypoints, known: Keypoints, members: Pairs) -> Alignment:
    """Lay the members (P, 2) on each other, the certain ones more firmly."""
    left, right = query.where(members[:, 0]), known.where(members[:, 1])
    weights = 1.0 / (left.sigma.astype(np.float64) ** 2 + right.sigma.astype(np.float64) ** 2)
    return align(left.xy, right.xy, weights)


def _close(found: Alignment, start: Start, config: LearnedMatchConfig) -> bool:
    shift = math.hypot(found.x - start[0], found.y - start[1])
    return shift <= config.most_shift and abs(wrap_angle(found.yaw - start[2])) <= config.most_turn


def _match(found: Alignment, inliers: int, exact: bool) -> Match:
    return Match(found.x, found.y, found.yaw, inliers, exact, found.rms)
