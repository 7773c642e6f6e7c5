"""Keypoint registration: from a place good to a few metres to a pose, by keypoints that agree."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from coview_stream.config.search import LearnedMatchConfig
from coview_stream.geometry.arrays import Bools, Floats, Ints
from coview_stream.geometry.transforms import wrap_angle
from coview_stream.localization.search.learned.consistent_pairs import consistency_graph, maximum_clique
from coview_stream.localization.search.learned.keypoints import Keypoints, nearest_pairs

Start = tuple[float, float, float]
"""x and y (metres) and heading (radians) of the query's frame in the map."""


@dataclass(frozen=True)
class RigidFit2D:
    """Pose ``p_map = R(yaw) p_query + (x, y)`` of a least-squares fit.

    Attributes:
        x: metres.
        y: metres.
        yaw: radians in (-pi, pi].
        residuals: (N,) metres, in the plane.
    """

    x: float
    y: float
    yaw: float
    residuals: Floats


def refine_by_keypoints(
    query: Keypoints, known: Keypoints, start: Start, config: LearnedMatchConfig | None = None
) -> RigidFit2D | None:
    """Match the keypoints of a query with those of the map around ``start``.

    Args:
        query: keypoints in the query's frame, whose origin is the middle of what it has seen.
        known: keypoints of the map, or of its part that matters, in the map's frame.
        start: where the query's frame lies in the map, approximately.
        config: tolerances and what a match has to be.

    Returns:
        The fit of the pairs that agree; None where they are too few, or too far from ``start``.
    """
    config = config or LearnedMatchConfig()
    near = known.around(start[:2], config.reach + config.max_shift)
    possible = _possible_pairs(query, near, start, config)
    pairs, _ = nearest_pairs(query.descriptors, near.descriptors, max_pairs=config.pairs, possible=possible)
    if len(pairs) < config.min_inliers:
        return None
    left, right = query.select(pairs[:, 0]), near.select(pairs[:, 1])
    members = pairs[maximum_clique(consistency_graph(left.xy, right.xy, config), config.nodes).members]
    while len(members) >= config.min_inliers:
        found = _fit(query, near, members)
        fits = found.residuals < config.tolerance
        if fits.all():
            return found if _close(found, start, config) else None
        # distances alone do not tell a place from its mirror image, and a long clique may bend
        members = members[found.residuals < max(config.tolerance, float(np.median(found.residuals)))]
    return None


def _possible_pairs(query: Keypoints, known: Keypoints, start: Start, config: LearnedMatchConfig) -> Bools:
    """Mask (N, M) the pairs that coincide in some pose that would be accepted."""
    c, s = math.cos(start[2]), math.sin(start[2])
    there = query.xy @ np.array([[c, s], [-s, c]]) + start[:2]
    gap = np.hypot(there[:, None, 0] - known.xy[None, :, 0], there[:, None, 1] - known.xy[None, :, 1])
    swing = 2.0 * math.sin(0.5 * min(config.max_turn, math.pi)) * np.hypot(query.xy[:, 0], query.xy[:, 1])
    return np.asarray(gap <= config.max_shift + config.tolerance + swing[:, None])


def _fit(query: Keypoints, known: Keypoints, members: Ints) -> RigidFit2D:
    """Fit the members (P, 2), weighted by their certainty."""
    left, right = query.select(members[:, 0]), known.select(members[:, 1])
    weights = 1.0 / (left.sigma.astype(np.float64) ** 2 + right.sigma.astype(np.float64) ** 2)
    return fit_rigid_2d(left.xy, right.xy, weights)


def _close(found: RigidFit2D, start: Start, config: LearnedMatchConfig) -> bool:
    shift = math.hypot(found.x - start[0], found.y - start[1])
    return shift <= config.max_shift and abs(wrap_angle(found.yaw - start[2])) <= config.max_turn


def fit_rigid_2d(query: Floats, known: Floats, weights: Floats | None = None) -> RigidFit2D:
    """Fit the rotation about the vertical and the translation that take points to their partners: least squares.

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
    return RigidFit2D(float(x), float(y), yaw, np.hypot(missed[:, 0], missed[:, 1]))
