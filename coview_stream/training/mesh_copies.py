"""Many deformed copies of one small mesh, each of which belongs to something that may stand or be gone."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Bools, Floats, Ints
from coview_stream.sim.mesh import Mesh, copies, join


class Part(NamedTuple):
    """Copies of a mesh.

    Attributes:
        template: whose triangles all copies have.
        vertices: (M, V, 3) metres.
        owner: (M,) index of the tree, bush or other thing that each copy is a part of.
    """

    template: Mesh
    vertices: Floats
    owner: Ints


def standing(parts: Iterable[Part], there: Bools, shift: Floats | None = None) -> Mesh:
    """One mesh of the parts of those owners (N,) that are ``there``, moved by their ``shift`` (N, 2), metres."""
    meshes = []
    for part in parts:
        kept = there[part.owner]
        vertices = part.vertices[kept]
        if shift is not None:
            vertices[:, :, :2] += shift[part.owner[kept]][:, None]
        if len(vertices):
            meshes.append(copies(part.template, vertices))
    return join(meshes)


def shaped(
    rng: np.random.Generator, template: Mesh, centre: Floats, semi: Floats, rough: float, owner: Ints
) -> Part:
    """Copy a template to (M, 3) centres, scaled by (M, 3), each vertex ``rough`` (a share) off."""
    size = (len(centre), len(template.vertices), 1)
    vertices = template.vertices[None] * (1.0 + np.clip(rng.normal(0, rough, size), -0.6, 0.6))
    return Part(template, vertices * semi[:, None] + centre[:, None], owner)
