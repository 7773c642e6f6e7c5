"""Ray casting into a scene: solid surfaces stop rays, foliage lets some pass."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from coview_stream.clouds.filters import open3d
from coview_stream.geometry.arrays import Floats32, Indices
from coview_stream.sim.mesh import Mesh
from coview_stream.sim.scenes import SceneState

BLOCK = 200_000
"""Rays cast at a time, set by hand: bounds the memory to about 30 MB."""

_THREADS = 2
_MAX_LAYERS = 6  # surfaces of foliage that a ray may pass; set by hand
_LEAF_DEPTH = 0.12  # metres, set by hand; mean depth below the hull of a crown at which a leaf is hit
_STEP = 2e-3  # metres beyond a leaf at which the ray goes on


class Hits(NamedTuple):
    """First hits of (N,) rays.

    Attributes:
        distance: (N,) metres; inf without a hit.
        incidence: (N,) absolute cosines of the angles of incidence; 1 on foliage.
    """

    distance: Floats32
    incidence: Floats32


class Struck(NamedTuple):
    """First hits of (N,) rays, and what was hit.

    Attributes:
        distance: (N,) metres; inf without a hit.
        incidence: (N,) absolute cosines of the angles of incidence; 1 on foliage.
        mesh: (N,) index of the mesh that was hit; -1 without a hit.
        normal: (N, 3) unit normals of the surfaces, on either side.
    """

    distance: Floats32
    incidence: Floats32
    mesh: Indices
    normal: Floats32


class MeshCaster:
    """Ray caster for meshes, on ``threads`` cores.

    ``foliage`` names those that let some rays pass, by their index, each with the probability that a ray passes one
    of its surfaces; None for the probability that :meth:`trace` is given. Leaves are hit ``leaf_depth`` metres on
    average below the surface of their foliage.

    Raises:
        DependencyError: Open3D cannot be loaded.
    """

    def __init__(
        self,
        meshes: Sequence[Mesh],
        foliage: Mapping[int, float | None],
        threads: int = _THREADS,
        leaf_depth: float = _LEAF_DEPTH,
    ) -> None:
        self._o3d: Any = open3d()
        self._threads, self._leaf_depth = threads, leaf_depth
        self._scene = self._o3d.t.geometry.RaycastingScene(nthreads=threads)
        self._foliage = dict(foliage)
        self._added: list[int] = []  # Open3D's number of a mesh -> ours
        for index, mesh in enumerate(meshes):
            if len(mesh.triangles):
                vertices = self._o3d.core.Tensor(mesh.vertices.astype(np.float32))
                triangles = self._o3d.core.Tensor(mesh.triangles.astype(np.uint32))
                self._scene.add_triangles(vertices, triangles)
                self._added.append(index)

    def trace(self, origins: Floats32, rays: Floats32, rng: np.random.Generator, porosity: float) -> Struck:
        """Return the first hits of (N, 3) unit rays from (N, 3) origins, scene frame, metres."""
        parts = [
            self._trace_block(origins[i : i + BLOCK], rays[i : i + BLOCK], rng, porosity)
            for i in range(0, len(rays), BLOCK)
        ]
        if not parts:
            nothing = np.zeros(0, np.float32)
            return Struck(nothing, nothing, np.zeros(0, np.intp), np.zeros((0, 3), np.float32))
        return Struck(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _trace_block(self, origins: Floats32, rays: Floats32, rng: np.random.Generator, porosity: float) -> Struck:
        count = len(rays)
        distance, incidence = np.full(count, np.inf, np.float32), np.zeros(count, np.float32)
        struck, normals = np.full(count, -1, np.intp), np.zeros((count, 3), np.float32)
        passing = np.full(max(self._foliage, default=-1) + 2, np.nan)  # by mesh; the last place is the sky's
        for index, own in self._foliage.items():
            passing[index] = porosity if own is None else own
        alive: Indices = np.arange(count, dtype=np.intp)
        start = np.zeros(count, np.float32)
        for layer in range(_MAX_LAYERS):
            from_here = origins[alive] + rays[alive] * start[alive, None]
            t, normal, mesh = self._query(from_here, rays[alive])
            through = passing[np.where(mesh < len(passing), mesh, -1)]
            leaf = np.isfinite(through)
            t += start[alive]
            depth = (rng.exponential(self._leaf_depth, len(t)) * leaf).astype(np.float32)
            cosine = np.abs(np.einsum("ij,ij->i", normal, rays[alive]))
            distance[alive], incidence[alive] = t + depth, np.where(leaf, 1.0, cosine)
            struck[alive], normals[alive] = mesh, normal
            if layer + 1 == _MAX_LAYERS:
                break
            passed = leaf & (rng.random(len(t)) < through)
            alive = alive[passed]
            start[alive] = t[passed] + _STEP
            if not len(alive):
                break
        return Struck(distance, incidence, struck, normals)

    def _query(self, origins: Floats32, rays: Floats32) -> tuple[Floats32, Floats32, Indices]:
        packed = np.ascontiguousarray(np.concatenate([origins, rays], axis=1), dtype=np.float32)
        answer = self._scene.cast_rays(self._o3d.core.Tensor(packed), nthreads=self._threads)
        number = answer["geometry_ids"].numpy()
        # a ray without a hit has a number beyond all
        mesh = np.array([*self._added, -1], dtype=np.intp)[np.minimum(number, len(self._added))]
        # copies: the arrays belong to the tensors of the answer
        return answer["t_hit"].numpy().copy(), answer["primitive_normals"].numpy().copy(), mesh


class Caster(MeshCaster):
    """Ray caster for one state of a scene, on ``threads`` cores.

    Leaves are hit ``leaf_depth`` metres on average below the surface of their foliage.

    Raises:
        DependencyError: Open3D cannot be loaded.
    """

    def __init__(self, scene: SceneState, threads: int = _THREADS, leaf_depth: float = _LEAF_DEPTH) -> None:
        super().__init__((scene.solid, scene.foliage), {1: None}, threads, leaf_depth)

    def cast(self, origins: Floats32, rays: Floats32, rng: np.random.Generator, porosity: float) -> Hits:
        """Return the first hits of (N, 3) unit rays from (N, 3) origins, scene frame, metres.

        Each surface of foliage lets a ray pass with probability ``porosity``.
        """
        return Hits(*self.trace(origins, rays, rng, porosity)[:2])
