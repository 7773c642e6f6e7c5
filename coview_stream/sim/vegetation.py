"""Vegetation, boulders and fallen trunks; trunks are solid, foliage lets some rays pass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.sim.layout import Site
from coview_stream.sim.mesh import EMPTY, Mesh, copies, cylinder, ellipsoid, join, placed, prism

_TRUNK = cylinder(1.0, 1.0, 6, top=0.6)
_CROWN = ellipsoid(5, 8)
_CONE = cylinder(1.0, 1.0, 7, top=0.08)
_BUSH = ellipsoid(4, 6)

TREE_COLUMNS = ("x", "y", "height", "spread", "conifer", "lean_x", "lean_y", "seed")


class TreeMix(NamedTuple):
    """Sizes and shapes of a scene's trees."""

    height: tuple[float, float]  # range, metres
    spread: tuple[float, float] = (0.16, 0.28)  # range of the crown's radius, as a share of the height
    conifers: float = 0.0  # share of the trees


def draw_tree(rng: np.random.Generator, x: float, y: float, species: TreeMix) -> Floats:
    """Draw one tree as a row of ``TREE_COLUMNS``."""
    height = rng.uniform(*species.height)
    conifer = float(rng.random() < species.conifers)
    spread = rng.uniform(*species.spread) * (0.6 if conifer else 1.0)
    lean = rng.normal(0.0, 0.03, 2)
    return np.array([x, y, height, spread * height, conifer, *lean, rng.uniform(0, 1e6)])


def trunks(trees: Floats, ground: Floats) -> Mesh:
    """Return tapering, slightly leaning trunks of trees (N, 8) on ground heights (N,)."""
    if not len(trees):
        return EMPTY
    x, y, height, _, _, lean_x, lean_y, seed = trees.T
    radius = np.maximum(height * (0.008 + 0.008 * _noise(seed, 0)), 0.06)
    v = np.repeat(_TRUNK.vertices[None], len(trees), axis=0)
    v[:, :, :2] *= radius[:, None, None]
    v[:, :, 2] *= 0.85 * height[:, None] + 0.5
    v[:, :, 0] += x[:, None] + v[:, :, 2] * lean_x[:, None]
    v[:, :, 1] += y[:, None] + v[:, :, 2] * lean_y[:, None]
    v[:, :, 2] += ground[:, None] - 0.5
    return copies(_TRUNK, v)


def crowns(trees: Floats, ground: Floats) -> Mesh:
    """Return the foliage of trees (N, 8): lumpy crowns, and three-storey cones for conifers."""
    conifer = trees[:, 4] > 0.5
    return join([_broadleaf(trees[~conifer], ground[~conifer]), _conifers(trees[conifer], ground[conifer])])


def _broadleaf(trees: Floats, ground: Floats) -> Mesh:
    if not len(trees):
        return EMPTY
    parts = []
    for lump, share in enumerate((1.0, 0.62, 0.55)):  # a main crown and two boughs
        seed = trees[:, 7] + 17 * lump
        reach = 0.0 if lump == 0 else 0.65
        angle = 2 * np.pi * _noise(seed, 1)
        spread, height = trees[:, 3] * share, trees[:, 2]
        v = np.repeat(_CROWN.vertices[None], len(trees), axis=0)
        v *= 1.0 + 0.22 * (_noise(seed[:, None], 2 + np.arange(v.shape[1])[None])[:, :, None] - 0.5) * 2
        v[:, :, :2] *= spread[:, None, None]
        v[:, :, 2] *= (height * (0.22 + 0.1 * _noise(seed, 60)) * share)[:, None]
        middle = height * (0.7 if lump == 0 else 0.55 + 0.2 * lump * _noise(seed, 61))
        v[:, :, 0] += (trees[:, 0] + reach * trees[:, 3] * np.cos(angle) + trees[:, 5] * height)[:, None]
        v[:, :, 1] += (trees[:, 1] + reach * trees[:, 3] * np.sin(angle) + trees[:, 6] * height)[:, None]
        v[:, :, 2] += (ground + middle)[:, None]
        parts.append(copies(_CROWN, v))
    return join(parts)


def _conifers(trees: Floats, ground: Floats) -> Mesh:
    if not len(trees):
        return EMPTY
    parts = []
    for low, length, share in ((0.18, 0.42, 1.0), (0.42, 0.36, 0.7), (0.66, 0.34, 0.45)):
        v = np.repeat(_CONE.vertices[None], len(trees), axis=0)
        wide = trees[:, 3] * share * (0.85 + 0.3 * _noise(trees[:, 7], int(100 * low)))
        v[:, :, :2] *= wide[:, None, None]
        v[:, :, 2] = v[:, :, 2] * (length * trees[:, 2])[:, None] + (low * trees[:, 2])[:, None]
        v[:, :, 0] += trees[:, :1] + v[:, :, 2] * trees[:, 5:6]
        v[:, :, 1] += trees[:, 1:2] + v[:, :, 2] * trees[:, 6:7]
        v[:, :, 2] += ground[:, None]
        parts.append(copies(_CONE, v))
    return join(parts)


def undergrowth(rng: np.random.Generator, site: Site, count: int, extent: float) -> Mesh:
    """Draw bushes off the road within +-``extent`` metres."""
    xy = rng.uniform(-extent, extent, (count, 2))
    radius = rng.uniform(0.3, 1.1, count)
    off_road = site.road_distance(*xy.T) > site.layout.half_width + radius
    xy, radius = xy[off_road], radius[off_road]
    v = np.repeat(_BUSH.vertices[None], len(xy), axis=0) * radius[:, None, None]
    v *= 1.0 + rng.normal(0, 0.12, (*v.shape[:2], 1))
    v[:, :, :2] += xy[:, None]
    v[:, :, 2] += (site.z(*xy.T) + 0.5 * radius)[:, None]
    return copies(_BUSH, v) if len(xy) else EMPTY


def strip(site: Site, line: Floats, thickness: float, height: float) -> Mesh:
    """Return a hedge, wall or fence that follows the ground along a polyline (K, 2)."""
    z = site.z(*line.T)
    parts = []
    for k in range(len(line) - 1):
        along = line[k + 1] - line[k]
        side = np.array([-along[1], along[0]]) * thickness / (2 * max(float(np.hypot(*along)), 1e-9))
        xy = np.array([line[k] - side, line[k + 1] - side, line[k + 1] + side, line[k] + side])
        base = z[[k, k + 1, k + 1, k]]
        bottom, top = (np.column_stack([xy, base + lift]) for lift in (-0.5, height))
        parts.append(prism(bottom, top))
    return join(parts)


def logs(rng: np.random.Generator, site: Site, count: int, extent: float) -> Mesh:
    """Draw fallen trunks off the road."""
    parts = []
    for _ in range(count):
        x, y = rng.uniform(-extent, extent, 2)
        yaw, length, radius = rng.uniform(0, np.pi), rng.uniform(3, 9), rng.uniform(0.12, 0.3)
        if site.claim(x, y, length, 0.6, yaw, 0.3):
            half = np.array([np.cos(yaw), np.sin(yaw)]) * length / 2
            line = np.array([-half, half]) + np.array([x, y])
            parts.append(strip(site, line, 2 * radius, 2 * radius))
    return join(parts)


def rocks(rng: np.random.Generator, site: Site, count: int, extent: float) -> Mesh:
    """Draw boulders off the road."""
    parts = []
    for _ in range(count):
        x, y = rng.uniform(-extent, extent, 2)
        radius = rng.uniform(0.4, 1.6)
        if site.claim(x, y, 2 * radius, 2 * radius, 0.0, 0.3):
            v = _BUSH.vertices * radius * (1.0 + rng.normal(0, 0.15, (len(_BUSH.vertices), 1)))
            parts.append(placed(Mesh(v, _BUSH.triangles), x, y, site.height(x, y) + 0.2 * radius))
    return join(parts)


def _noise(seed: Floats, k: int | Ints) -> Floats:
    """Return repeatable numbers in [0, 1) from the trees' seeds, so that a tree keeps its shape."""
    value = np.sin(seed * 12.9898 + np.asarray(k) * 78.233) * 43758.5453
    return np.asarray(value - np.floor(value))
