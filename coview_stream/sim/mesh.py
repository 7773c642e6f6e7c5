"""Triangle meshes of simple solids, as arrays.

Every solid stands on z = 0 around the origin, in metres; :func:`placed` rotates and moves it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats, Ints


class Mesh(NamedTuple):
    """Vertices (V, 3) float64 metres and triangles (T, 3) int64."""

    vertices: Floats
    triangles: Ints


EMPTY = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))

_BOX = np.array(
    [
        [[0, 1, 5], [0, 5, 4], [1, 2, 6], [1, 6, 5]],
        [[2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]],
        [[4, 5, 6], [4, 6, 7], [0, 2, 1], [0, 3, 2]],
    ]
).reshape(-1, 3)  # triangles of a prism, outward; corners 0 to 3 are the bottom's, 4 to 7 the top's


def join(meshes: Iterable[Mesh]) -> Mesh:
    """Join meshes."""
    parts = list(meshes)
    if not parts:
        return EMPTY
    starts = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    triangles = [part.triangles + start for part, start in zip(parts, starts, strict=True)]
    return Mesh(np.concatenate([part.vertices for part in parts]), np.concatenate(triangles))


def placed(mesh: Mesh, x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> Mesh:
    """Rotate a mesh about z by ``yaw`` radians, then move it."""
    c, s = np.cos(yaw), np.sin(yaw)
    v = mesh.vertices
    moved = np.column_stack([c * v[:, 0] - s * v[:, 1] + x, s * v[:, 0] + c * v[:, 1] + y, v[:, 2] + z])
    return Mesh(moved, mesh.triangles)


def prism(bottom: Floats, top: Floats) -> Mesh:
    """Return the solid between two quadrilaterals (4, 3) with corners in the same counter-clockwise order."""
    return Mesh(np.concatenate([bottom, top]), _BOX)


def rectangle(w: float, d: float, z: float) -> Floats:
    """Return the corners (4, 3), counter-clockwise, of a w x d rectangle at height ``z``."""
    return np.array([[-w, -d, 2 * z], [w, -d, 2 * z], [w, d, 2 * z], [-w, d, 2 * z]]) / 2.0


def box(w: float, d: float, h: float) -> Mesh:
    """Return a box of width (x), depth (y) and height."""
    return prism(rectangle(w, d, 0.0), rectangle(w, d, h))


def frustum(w: float, d: float, h: float, top_w: float, top_d: float) -> Mesh:
    """Return a box with a smaller top than base, for hipped roofs, bonnets and woodpiles."""
    return prism(rectangle(w, d, 0.0), rectangle(top_w, top_d, h))


def gable(w: float, d: float, rise: float) -> Mesh:
    """Return a saddle roof with its ridge along x."""
    ridge = np.array([[-w / 2, 0.0, rise], [w / 2, 0.0, rise]])
    vertices = np.concatenate([rectangle(w, d, 0.0), ridge])
    faces = [[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4], [0, 2, 1], [0, 3, 2]]
    return Mesh(vertices, np.array(faces))


def shed(w: float, d: float, rise: float) -> Mesh:
    """Return a single-pitch roof that rises towards +y, one tooth of a saw-tooth roof."""
    top = rectangle(w, d, 0.02)
    top[2:, 2] = rise
    return prism(rectangle(w, d, 0.0), top)


def cylinder(radius: float, h: float, sides: int = 10, top: float | None = None) -> Mesh:
    """Return an upright cylinder, or a cone frustum with the radius ``top``; closed above, open below."""
    angle = np.arange(sides) * 2 * np.pi / sides
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    low = np.column_stack([ring * radius, np.zeros(sides)])
    high = np.column_stack([ring * (radius if top is None else top), np.full(sides, h)])
    vertices = np.concatenate([low, high, [[0.0, 0.0, h]]])
    i = np.arange(sides)
    j = (i + 1) % sides
    cap = np.full(sides, 2 * sides)
    side = [np.column_stack([i, j, j + sides]), np.column_stack([i, j + sides, i + sides])]
    return Mesh(vertices, np.concatenate([*side, np.column_stack([i + sides, j + sides, cap])]))


def ellipsoid(rings: int = 5, sides: int = 8) -> Mesh:
    """Return a coarse unit sphere about the origin, the template of crowns and bushes."""
    polar = np.pi * np.arange(1, rings) / rings
    angle = np.arange(sides) * 2 * np.pi / sides
    P, A = np.meshgrid(polar, angle, indexing="ij")
    body = np.column_stack([(np.sin(P) * np.cos(A)).ravel(), (np.sin(P) * np.sin(A)).ravel(), np.cos(P).ravel()])
    vertices = np.concatenate([body, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    north, south, faces = len(body), len(body) + 1, []
    for k in range(sides):
        n = (k + 1) % sides
        faces.append([north, k, n])
        for row in range(rings - 2):
            a, b = row * sides + k, row * sides + n
            faces += [[a, a + sides, b + sides], [a, b + sides, b]]
        last = (rings - 2) * sides
        faces.append([south, last + n, last + k])
    return Mesh(vertices, np.array(faces))


def copies(template: Mesh, vertices: Floats) -> Mesh:
    """Return one mesh of deformed copies of a template; ``vertices`` is (copies, V, 3)."""
    count, size = vertices.shape[0], vertices.shape[1]
    offsets = (np.arange(count) * size)[:, None, None]
    return Mesh(vertices.reshape(-1, 3), (template.triangles[None] + offsets).reshape(-1, 3))


def height_field(axis: Floats, heights: Floats) -> Mesh:
    """Return the ground over the square grid ``axis`` x ``axis``; ``heights`` is indexed [x, y]."""
    n = len(axis)
    X, Y = np.meshgrid(axis, axis, indexing="ij")
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)[None]).ravel()
    faces = [np.column_stack([i, i + n, i + n + 1]), np.column_stack([i, i + n + 1, i + 1])]
    return Mesh(np.column_stack([X.ravel(), Y.ravel(), heights.ravel()]), np.concatenate(faces))
