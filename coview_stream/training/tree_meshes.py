"""Meshes of trees: crowns of several families and undergrowth let some rays pass, wood stops all."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Bools, Floats, Ints
from coview_stream.sim.mesh import Mesh, copies, cylinder, ellipsoid, join
from coview_stream.training.trees import Terrain, Trees, waves


class MeshCopies(NamedTuple):
    """Copies of a mesh."""

    template: Mesh  # all copies have its triangles
    vertices: Floats  # (M, V, 3) metres
    owner: Ints  # (M,) index of the tree, bush or other object of each copy


def join_standing(parts: Iterable[MeshCopies], there: Bools, shift: Floats | None = None) -> Mesh:
    """Join the copies of the owners (N,) that are ``there``, moved by their ``shift`` (N, 2), metres."""
    meshes = []
    for part in parts:
        kept = there[part.owner]
        vertices = part.vertices[kept]
        if shift is not None:
            vertices[:, :, :2] += shift[part.owner[kept]][:, None]
        if len(vertices):
            meshes.append(copies(part.template, vertices))
    return join(meshes)


def scaled_copies(
    rng: np.random.Generator, template: Mesh, centre: Floats, semi: Floats, rough: float, owner: Ints
) -> MeshCopies:
    """Copy a template to centres (M, 3), scaled by (M, 3), with vertices displaced by ``rough`` (a share), 1 sigma."""
    size = (len(centre), len(template.vertices), 1)
    vertices = template.vertices[None] * (1.0 + np.clip(rng.normal(0, rough, size), -0.6, 0.6))
    return MeshCopies(template, vertices * semi[:, None] + centre[:, None], owner)


_MAIN = ellipsoid(4, 7)
_LUMP = ellipsoid(3, 5)
_CONE = cylinder(1.0, 1.0, 7, top=0.08)
_BUSH = ellipsoid(3, 6)
_ROCK = ellipsoid(4, 6)
_TETRAHEDRON = Mesh(
    np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]),
    np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]),
)
_MAX_CLUMPS = 110_000  # in a stand


def crowns(rng: np.random.Generator, trees: Trees) -> list[MeshCopies]:
    """Draw the leaves of all trees by their families."""
    parts: list[MeshCopies] = []
    for family, draw in enumerate((_lumpy, _cone, _storeys, _umbrella, _clumps, _column)):  # in the order of FAMILIES
        of = np.flatnonzero(trees.family == family)
        if len(of):
            parts += draw(rng, trees, of)
    return parts


def _lumpy(rng: np.random.Generator, trees: Trees, of: Ints) -> list[MeshCopies]:
    depth, wide = (trees.height - trees.base)[of] / 2, trees.crown[of]
    semi = np.column_stack([wide, wide, depth])
    rough = rng.uniform(0.05, 0.25)
    parts = [scaled_copies(rng, _MAIN, trees.crown_axis(trees.base[of] + depth, of), semi, rough, of)]
    for _ in range(int(rng.integers(0, 5))):  # boughs off the centre
        share, angle = rng.uniform(0.35, 0.65, len(of)), rng.uniform(0, 2 * np.pi, len(of))
        centre = trees.crown_axis(trees.base[of] + depth * rng.uniform(0.5, 1.5, len(of)), of)
        out = 0.7 * wide * rng.uniform(0.6, 1.2, len(of))
        centre[:, :2] += out[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        parts.append(scaled_copies(rng, _LUMP, centre, semi * share[:, None], rough, of))
    return parts


def _cone(rng: np.random.Generator, trees: Trees, of: Ints) -> list[MeshCopies]:
    centre = trees.crown_axis(trees.base[of], of)
    semi = np.column_stack([trees.crown[of], trees.crown[of], (trees.height - trees.base)[of]])
    return [_leaning(scaled_copies(rng, _CONE, centre, semi, rng.uniform(0, 0.1), of), trees)]


def _storeys(rng: np.random.Generator, trees: Trees, of: Ints) -> list[MeshCopies]:
    count = int(rng.integers(2, 6))
    deep, parts = (trees.height - trees.base)[of], []
    for k in range(count):
        low = trees.base[of] + deep * k / count
        wide = trees.crown[of] * (1 - 0.8 * k / count) * rng.uniform(0.75, 1.15, len(of))
        tall = deep / count * rng.uniform(1.1, 1.6)
        tall = np.minimum(tall, trees.height[of] - low)
        semi = np.column_stack([wide, wide, tall])
        parts.append(_leaning(scaled_copies(rng, _CONE, trees.crown_axis(low, of), semi, 0.06, of), trees))
    return parts


def _leaning(part: MeshCopies, trees: Trees) -> MeshCopies:
    """Shear copies by the lean of their trees, from the lowest vertex up."""
    low = part.vertices[:, :, 2].min(axis=1, keepdims=True)
    up = (part.vertices[:, :, 2] - low)[:, :, None]
    part.vertices[:, :, :2] += up * trees.lean[part.owner][:, None]
    return part


def _umbrella(rng: np.random.Generator, trees: Trees, of: Ints) -> list[MeshCopies]:
    parts, flat = [], rng.uniform(0.08, 0.3)
    for k in range(int(rng.integers(1, 4))):
        thick = np.maximum(flat * (trees.height - trees.base)[of], 0.3)
        wide = trees.crown[of] * (1.25 if k == 0 else rng.uniform(0.4, 0.9))
        up = trees.height[of] - thick * (1 + 2.2 * k)
        centre = trees.crown_axis(np.maximum(up, trees.base[of]), of)
        if k:
            centre[:, :2] += rng.normal(0, 0.4, (len(of), 2)) * trees.crown[of][:, None]
        parts.append(scaled_copies(rng, _MAIN, centre, np.column_stack([wide, wide, thick]), 0.12, of))
    return parts


def _column(rng: np.random.Generator, trees: Trees, of: Ints) -> list[MeshCopies]:
    depth, wide = (trees.height - trees.base)[of] / 2, trees.crown[of] * rng.uniform(0.4, 0.7)
    semi = np.column_stack([wide, wide, depth])
    return [scaled_copies(rng, _MAIN, trees.crown_axis(trees.base[of] + depth, of), semi, 0.12, of)]


def _clumps(rng: np.random.Generator, trees: Trees, of: Ints) -> list[MeshCopies]:
    """Draw small tetrahedra of leaves in a profile: pointed, round or a shell."""
    size, layers = rng.uniform(0.2, 0.5), rng.uniform(1.2, 3.5)
    wanted = layers * np.pi * trees.crown[of] ** 2 / (4 * size**2)
    wanted *= min(1.0, _MAX_CLUMPS / max(wanted.sum(), 1.0))
    size *= np.sqrt(max(1.0, layers * np.pi * (trees.crown[of] ** 2).sum() / (4 * size**2) / _MAX_CLUMPS))
    owner = np.repeat(of, np.maximum(8, rng.poisson(wanted)))
    u = rng.beta(1.3, rng.uniform(1.0, 2.0), len(owner))
    pointed, inner = rng.uniform(0, 1), rng.uniform(0.0, 0.7)
    profile = pointed * (1 - u) + (1 - pointed) * np.sqrt(np.clip(4 * u * (1 - u), 0.05, 1))
    out = trees.crown[owner] * profile * np.sqrt(rng.uniform(inner, 1, len(owner)))
    angle = rng.uniform(0, 2 * np.pi, len(owner))
    centre = trees.crown_axis(trees.base[owner] + u * (trees.height - trees.base)[owner], owner)
    centre[:, :2] += out[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    semi = size * rng.uniform(0.5, 1.5, (len(owner), 1)) * np.array([[1.0, 1.0, rng.uniform(0.3, 1.0)]])
    return [scaled_copies(rng, _TETRAHEDRON, centre, semi * rng.choice([-1.0, 1.0], semi.shape), 0.3, owner)]


def bushes(rng: np.random.Generator, terrain: Terrain, density: float) -> MeshCopies:
    """Draw the understory in patches, up to 3 m high, ``density`` per square metre, each bush its own owner."""
    xy = rng.uniform(-terrain.half, terrain.half, (int(1.7 * density * (2 * terrain.half) ** 2), 2))
    patchy = rng.uniform(0, 3) * waves(rng, rng.uniform(15, 60))(*xy.T)
    xy = xy[rng.random(len(xy)) < 1 / (1 + np.exp(-0.4 - patchy))]
    count = len(xy)
    tall = rng.uniform(0.3, rng.uniform(0.6, 3.0), count)
    wide = tall * rng.uniform(0.2, 0.6, count)
    semi = np.column_stack([wide, wide, 0.55 * tall])
    centre = np.column_stack([xy, terrain.z(*xy.T) + 0.45 * tall])
    return scaled_copies(rng, _BUSH, centre, semi, 0.2, np.arange(count))


def tubes(begin: Floats, end: Floats, radius: Floats, top: Floats, sides: int, owner: Ints) -> MeshCopies:
    """Return tubes between points (M, 3) that taper from ``radius`` to ``top`` (M,), metres."""
    axis = end - begin
    axis = axis / np.maximum(np.linalg.norm(axis, axis=1), 1e-9)[:, None]
    aside = np.where(np.abs(axis[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    u = np.cross(axis, aside)
    u /= np.linalg.norm(u, axis=1)[:, None]
    v = np.cross(axis, u)
    angle = np.arange(sides) * 2 * np.pi / sides
    ring = np.cos(angle)[:, None] * u[:, None] + np.sin(angle)[:, None] * v[:, None]
    low, high = begin[:, None] + ring * radius[:, None, None], end[:, None] + ring * top[:, None, None]
    i = np.arange(sides)
    j = (i + 1) % sides
    side = [np.column_stack([i, j, j + sides]), np.column_stack([i, j + sides, i + sides])]
    cap = np.column_stack([np.full(sides - 2, sides), i[1:-1] + sides, i[2:] + sides])  # the far end is closed
    template = Mesh(np.zeros((2 * sides, 3)), np.concatenate([*side, cap]))
    return MeshCopies(template, np.concatenate([low, high], axis=1), owner)


def stems(trees: Trees) -> MeshCopies:
    """Return leaning, tapering stems from half a metre below the ground to near the top."""
    top = trees.axis(0.93 * trees.height)
    foot = trees.axis(np.full(len(trees.x), -0.5))
    return tubes(foot, top, trees.radius, 0.25 * trees.radius, 6, np.arange(len(trees.x)))


def branches(rng: np.random.Generator, trees: Trees, count: Ints) -> MeshCopies:
    """Draw ``count`` (N,) branches of each tree inside its crown, and some dead branches below."""
    owner = np.repeat(np.arange(len(trees.x)), count)
    low, height = 0.7 * trees.base[owner], trees.height[owner]
    at = low + (0.95 * height - low) * rng.random(len(owner))
    begin = trees.axis(at, owner)
    length = trees.crown[owner] * rng.uniform(0.4, 1.1, len(owner)) * (1.1 - 0.7 * at / height)
    angle, rise = rng.uniform(0, 2 * np.pi, len(owner)), rng.uniform(-0.3, 0.8, len(owner))
    along = np.column_stack([np.cos(angle), np.sin(angle), rise])
    thick = np.clip(0.2 * trees.radius[owner] * rng.uniform(0.5, 1.2, len(owner)), 0.01, 0.09)
    return tubes(begin, begin + along * length[:, None], thick, 0.4 * thick, 3, owner)


def logs(rng: np.random.Generator, terrain: Terrain, count: int) -> MeshCopies:
    """Draw fallen stems."""
    xy = rng.uniform(-terrain.half + 8, terrain.half - 8, (count, 2))
    angle, length = rng.uniform(0, 2 * np.pi, count), rng.uniform(3, 14, count)
    reach = 0.5 * length[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    radius = rng.uniform(0.08, 0.35, count)
    ends = [np.column_stack([p, terrain.z(*p.T) + 0.8 * radius]) for p in (xy - reach, xy + reach)]
    return tubes(ends[0], ends[1], radius, 0.6 * radius, 5, np.zeros(count, dtype=np.int64))


def rocks(rng: np.random.Generator, terrain: Terrain, count: int) -> MeshCopies:
    """Draw boulders, half buried."""
    xy = rng.uniform(-terrain.half, terrain.half, (count, 2))
    semi = rng.uniform(0.2, 1.4, (count, 1)) * rng.uniform(0.6, 1.2, (count, 3))
    centre = np.column_stack([xy, terrain.z(*xy.T) + 0.2 * semi[:, 2]])
    return scaled_copies(rng, _ROCK, centre, semi, 0.15, np.zeros(count, dtype=np.int64))
