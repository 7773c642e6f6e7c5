"""Paths of a robot: smooth curves between trees, or along streets."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from coview_stream.geometry.arrays import Bools, Floats
from coview_stream.sim.layout import Layout, arc_lengths, directions

# all set by hand

CLEARANCE = 0.6
"""Metres between the robot's middle and a stem."""

STEP = 0.1
"""Metres between the points of a path."""

_CANDIDATES = 150  # random paths of which the longest free one is taken
_COARSE = 5  # steps between the points that are tested
_LANE = 0.7  # metres to either side of a street's middle


def between_trees(rng: np.random.Generator, obstacles: Floats, extent: float, length: float) -> Floats:
    """Draw a path (N, 2) of ``length`` metres, shorter where trees block it, that ends within +-``extent`` metres.

    ``obstacles`` (K, 3) are x, y and radius, metres.
    """
    count = int(length / STEP) + 1
    at = np.arange(count) * STEP
    end = rng.uniform(-extent, extent, (_CANDIDATES, 2))
    heading = rng.uniform(0, 2 * np.pi, (_CANDIDATES, 1))
    # curvature changes along the way: at most a turn of 90 degrees in 8 m
    bend = rng.normal(0, 0.06, (_CANDIDATES, 1)) + rng.normal(0, 0.1, (_CANDIDATES, 1)) * np.sin(
        2 * np.pi * at / rng.uniform(8, 25, (_CANDIDATES, 1)) + rng.uniform(0, 6, (_CANDIDATES, 1))
    )
    heading = heading + np.cumsum(np.clip(bend, -0.2, 0.2), axis=1) * STEP
    step = STEP * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    paths = end[:, None] + np.cumsum(step, axis=1) - step[:, :1]
    free = _clear(paths[:, ::_COARSE], obstacles) & (np.abs(paths[:, ::_COARSE]) < extent + 15).all(axis=2)
    reach = np.cumprod(free, axis=1).sum(axis=1)
    best = int(np.argmax(reach))  # the first of the longest
    kept = min(count, max(1, (int(reach[best]) - 1) * _COARSE + 1))
    return np.asarray(paths[best, :kept][::-1])


def _clear(points: Floats, obstacles: Floats) -> Bools:
    """Mask (...) the points (..., 2) that are clear of all obstacles."""
    if not len(obstacles):
        return np.ones(points.shape[:-1], dtype=bool)
    flat = points.reshape(-1, 2)
    clear = np.ones(len(flat), dtype=bool)
    thin = obstacles[:, 2] <= 0.5
    for some in (obstacles[thin], obstacles[~thin]):
        if len(some):
            far, nearest = cKDTree(some[:, :2]).query(flat, distance_upper_bound=8.0)
            radius = np.append(some[:, 2], 0.0)[nearest]
            clear &= far > radius + CLEARANCE
    return clear.reshape(points.shape[:-1])


def along_streets(rng: np.random.Generator, layout: Layout, extent: float, length: float) -> Floats:
    """Draw a path (N, 2) of up to ``length`` metres in a street, that ends within +-``extent`` metres."""
    streets = [line for line in (layout.route, *layout.streets) if (np.abs(line) < extent).all(axis=1).any()]
    line = streets[int(rng.integers(len(streets)))]
    line = line if rng.random() < 0.5 else line[::-1]
    arc = arc_lengths(line)
    inside = np.flatnonzero((np.abs(line) < extent).all(axis=1))
    newest = arc[int(rng.choice(inside))]
    at = newest - np.arange(int(length / STEP) + 1)[::-1] * STEP
    at = at[at >= 0] if newest > 0 else np.zeros(1)
    heading = np.interp(at, arc, np.unwrap(directions(line)))
    sideways = rng.uniform(-_LANE, _LANE) + 0.2 * np.sin(at / rng.uniform(4, 8) + rng.uniform(0, 6))
    x = np.interp(at, arc, line[:, 0]) - sideways * np.sin(heading)
    y = np.interp(at, arc, line[:, 1]) + sideways * np.cos(heading)
    return np.column_stack([x, y])
