"""Distances from points to the nearest of others, tile by tile."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.geometry.transforms import Points

_TILE = 50.0  # metres; set by hand: a tree of points at a time of at most some 100,000


def distances(points: Points, around: Callable[[Floats, float], Points], reach: float) -> Floats32:
    """Return the distance (N,) of points (N, 3) to the nearest other one, infinity beyond ``reach``.

    ``around`` gives the others within a radius of a place (2,).
    """
    from scipy.spatial import cKDTree

    out = np.full(len(points), np.inf, dtype=np.float32)
    if not len(points):
        return out
    tiles = np.floor(points[:, :2].astype(np.float64) / _TILE).astype(np.int64)
    order = np.lexsort((tiles[:, 1], tiles[:, 0]))
    ends = np.flatnonzero((np.diff(tiles[order], axis=0) != 0).any(axis=1)) + 1
    for index in np.split(order, ends):
        centre = (tiles[index[0]] + 0.5) * _TILE
        others = around(centre, _TILE * 0.7072 + reach)
        if len(others):
            out[index] = cKDTree(others).query(points[index], distance_upper_bound=reach)[0]
    return out


def within(points: Points) -> Callable[[Floats, float], Points]:
    """Return a look-up of points (N, 3) around a place, for :func:`distances`."""
    order = np.argsort(points[:, 0], kind="stable")
    x = points[order, 0]

    def around(centre: Floats, radius: float) -> Points:
        begin, end = np.searchsorted(x, [centre[0] - radius, centre[0] + radius])
        near = points[order[begin:end]]
        return np.asarray(near[np.abs(near[:, 1] - centre[1]) <= radius])

    return around
