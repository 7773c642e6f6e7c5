"""Virtual scan: what a ground robot would see at a place of a map, made of the map's own points."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import RegistrationConfig
from coview_stream.geometry.arrays import Bools, Floats, Floats32
from coview_stream.geometry.rasters import min_filter
from coview_stream.geometry.transforms import Points, norms, pose_from
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.registration.prepare_scan import prepare_scan

EYE = 1.7
"""Metres of the sensor above the ground; set by hand."""

# set by hand
_RANGE = 40.0  # metres
_NEAREST = 1.0  # metres
_BEAM = np.radians(1.0)  # cell of the range image that hides what lies behind
_UP, _DOWN = 22, 22  # cells above and below the horizon: the field of view of common lidars
_AROUND = 360  # cells
_HOLES = ((7.0, 5), (16.0, 3))  # metres up to which a surface of quarter-metre voxels has gaps so many cells wide
_SLACK, _SLACK_SLOPE = 0.4, 0.03  # metres, plus so many per metre of range, behind the nearest: still in view
_NOISE = 0.03  # metres
_PATCH = 4.0  # metres: what stands in one of them changes together
_MOVED = (3.0, 6.0)  # metres by which it does
_TABLE = 64  # patches until their draws repeat


def virtual_scan(base_map: BaseMap, eye: Floats, changed: float, config: RegistrationConfig) -> ObservedScan | None:
    """Return what a sensor at ``eye`` (3,) sees of a map; odometry frame = map frame. None where it sees nothing.

    The map's points within 40 m are seen where nothing stands before them in cells of a degree, 22 degrees up and down.
    A share of the site has changed: in so many of its patches of 4 m, the same ones whenever they are seen, what is
    there stands 3 to 6 m beside where the map has it.

    Args:
        base_map: the map.
        eye: position, map frame, metres.
        changed: share of the patches, in [0, 1].
        config: how scans are thinned.
    """
    near = base_map.crop(eye, _RANGE + _MOVED[1])[0]
    seen = _in_view(_rearranged(near, changed) - eye.astype(np.float32))
    if not len(seen):
        return None
    seen += np.random.default_rng(0).normal(0.0, _NOISE, seen.shape).astype(np.float32)
    cloud = prepare_scan(seen + eye.astype(np.float32), eye, config)
    # a single return says nothing about a direction, where a lidar would have several
    return ObservedScan.of(cloud, np.repeat(seen, 2, axis=0), pose_from(np.eye(3), eye))


def _rearranged(points: Points, changed: float) -> Points:
    """Move what is in the changed patches: the same ones in every scan."""
    if changed <= 0.0:
        return points
    x, y = np.floor(points[:, :2] * np.float32(1.0 / _PATCH)).astype(np.int64).T
    draw, shift = _draws()
    patch = (x % _TABLE) * _TABLE + y % _TABLE
    moved = np.array(points)
    moved[:, :2] += shift[patch] * (draw[patch] < changed)[:, None]
    return moved


@lru_cache(maxsize=1)
def _draws() -> tuple[Floats32, Floats32]:
    """Return for each patch a number (P,) in [0, 1) and a shift (P, 2), metres."""
    rng = np.random.default_rng(20240)
    draw, turn = rng.random(_TABLE**2), rng.uniform(0.0, 2.0 * np.pi, _TABLE**2)
    distance = rng.uniform(*_MOVED, _TABLE**2)
    shift = np.column_stack([distance * np.cos(turn), distance * np.sin(turn)])
    return draw.astype(np.float32), shift.astype(np.float32)


def _in_view(points: Points) -> Points:
    """Return those of (N, 3) points, relative to the sensor, that it sees."""
    flat = np.hypot(points[:, 0], points[:, 1])
    steep = np.abs(points[:, 2]) < flat * np.float32(np.tan(_BEAM * max(_UP, _DOWN)))
    points = points[steep & (flat < _RANGE)]
    ranges = norms(points).astype(np.float32)
    row = np.floor(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])) / _BEAM).astype(np.int64) + _DOWN
    column = np.floor(np.arctan2(points[:, 1], points[:, 0]) / _BEAM).astype(np.int64) % _AROUND
    inside: Bools = (ranges > _NEAREST) & (row >= 0) & (row < _UP + _DOWN)
    points, ranges, cell = points[inside], ranges[inside], (row * _AROUND + column)[inside]
    nearest = np.full((_UP + _DOWN) * _AROUND, np.inf, dtype=np.float32)
    np.minimum.at(nearest, cell, ranges)
    limit = _without_holes(nearest.reshape(-1, _AROUND)).ravel()[cell]
    return np.asarray(points[ranges < limit + _SLACK + _SLACK_SLOPE * ranges])


def _without_holes(nearest: Floats32) -> Floats32:
    """Let near surfaces, of which a cell may have no point, hide what is behind them."""
    out = nearest
    for reach, window in _HOLES:
        near = np.where(nearest < reach, nearest, np.float32(np.inf))
        out = np.minimum(out, min_filter(near, window))
    return out
