"""Deformed copies of a small mesh, each with an owner (a tree, a bush) that may stand or be gone."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Bools, Floats, Ints
from coview_stream.sim.mesh import Mesh, copies, join


class MeshCopies(NamedTuple):
    """Copies of a mesh.

    Attributes:
        template: whose triangles all copies have.
        vertices: (M, V, 3) metres.
        owner: (M,) index of the tree, bush or other object that each copy belongs to.
    """

    template: Mesh
    vertices: Floats
    owner: Ints


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
    """Copy a template to (M, 3) centres, scaled by (M, 3), with vertices displaced by ``rough`` (a share), 1 sigma."""
    size = (len(centre), len(template.vertices), 1)
    vertices = template.vertices[None] * (1.0 + np.clip(rng.normal(0, rough, size), -0.6, 0.6))
    return MeshCopies(template, vertices * semi[:, None] + centre[:, None], owner)
