"""Wood, which stops every ray: stems, branches, logs, rocks."""

from __future__ import annotations

import numpy as np

from coview_stream.learn.parts import Ints, Part, shaped
from coview_stream.learn.terrain import Terrain
from coview_stream.learn.trees import Trees
from coview_stream.sim.mesh import Floats, Mesh, ellipsoid

_ROCK = ellipsoid(4, 6)


def _tube(sides: int) -> Mesh:
    """Triangles of a tube of two rings, closed at its far end."""
    i = np.arange(sides)
    j = (i + 1) % sides
    side = [np.column_stack([i, j, j + sides]), np.column_stack([i, j + sides, i + sides])]
    cap = np.column_stack([np.full(sides - 2, sides), i[1:-1] + sides, i[2:] + sides])
    return Mesh(np.zeros((2 * sides, 3)), np.concatenate([*side, cap]))


def tubes(begin: Floats, end: Floats, radius: Floats, top: Floats, sides: int, owner: Ints) -> Part:
    """Tubes between (M, 3) points, their radius falling from ``radius`` to ``top`` (M,), metres."""
    axis = end - begin
    axis = axis / np.maximum(np.linalg.norm(axis, axis=1), 1e-9)[:, None]
    aside = np.where(np.abs(axis[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    u = np.cross(axis, aside)
    u /= np.linalg.norm(u, axis=1)[:, None]
    v = np.cross(axis, u)
    angle = np.arange(sides) * 2 * np.pi / sides
    ring = np.cos(angle)[:, None] * u[:, None] + np.sin(angle)[:, None] * v[:, None]
    low, high = begin[:, None] + ring * radius[:, None, None], end[:, None] + ring * top[:, None, None]
    return Part(_tube(sides), np.concatenate([low, high], axis=1), owner)


def stems(trees: Trees) -> Part:
    """Leaning, tapering stems, from half a metre below the ground to near the top."""
    top = trees.axis(0.93 * trees.height)
    foot = trees.axis(np.full(len(trees.x), -0.5))
    return tubes(foot, top, trees.radius, 0.25 * trees.radius, 6, np.arange(len(trees.x)))


def branches(rng: np.random.Generator, trees: Trees, count: Ints) -> Part:
    """Draw ``count`` (N,) branches of each tree: within its crown, some dead ones below."""
    owner = np.repeat(np.arange(len(trees.x)), count)
    low, height = 0.7 * trees.base[owner], trees.height[owner]
    at = low + (0.95 * height - low) * rng.random(len(owner))
    begin = trees.axis(at, owner)
    length = trees.crown[owner] * rng.uniform(0.4, 1.1, len(owner)) * (1.1 - 0.7 * at / height)
    angle, rise = rng.uniform(0, 2 * np.pi, len(owner)), rng.uniform(-0.3, 0.8, len(owner))
    along = np.column_stack([np.cos(angle), np.sin(angle), rise])
    thick = np.clip(0.2 * trees.radius[owner] * rng.uniform(0.5, 1.2, len(owner)), 0.01, 0.09)
    return tubes(begin, begin + along * length[:, None], thick, 0.4 * thick, 3, owner)


def logs(rng: np.random.Generator, terrain: Terrain, count: int) -> Part:
    """Fallen stems."""
    xy = rng.uniform(-terrain.half + 8, terrain.half - 8, (count, 2))
    angle, length = rng.uniform(0, 2 * np.pi, count), rng.uniform(3, 14, count)
    reach = 0.5 * length[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    radius = rng.uniform(0.08, 0.35, count)
    ends = [np.column_stack([p, terrain.z(*p.T) + 0.8 * radius]) for p in (xy - reach, xy + reach)]
    return tubes(ends[0], ends[1], radius, 0.6 * radius, 5, np.zeros(count, dtype=np.int64))


def rocks(rng: np.random.Generator, terrain: Terrain, count: int) -> Part:
    """Boulders, half buried."""
    xy = rng.uniform(-terrain.half, terrain.half, (count, 2))
    semi = rng.uniform(0.2, 1.4, (count, 1)) * rng.uniform(0.6, 1.2, (count, 3))
    centre = np.column_stack([xy, terrain.z(*xy.T) + 0.2 * semi[:, 2]])
    return shaped(rng, _ROCK, centre, semi, 0.15, np.zeros(count, dtype=np.int64))
