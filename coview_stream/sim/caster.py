"""Ray casting into a scene: solid surfaces stop rays, foliage lets some pass."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from coview_stream.clouds.open3d_loader import open3d
from coview_stream.geometry.arrays import Bools, Floats32, Indices
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


class Caster:
    """Ray caster for one state of a scene, on ``threads`` cores.

    Leaves are hit ``leaf_depth`` metres on average below the surface of their foliage.

    Raises:
        DependencyError: Open3D cannot be loaded.
    """

    def __init__(self, scene: SceneState, threads: int = _THREADS, leaf_depth: float = _LEAF_DEPTH) -> None:
        self._o3d: Any = open3d()
        self._threads, self._leaf_depth = threads, leaf_depth
        self._scene = self._o3d.t.geometry.RaycastingScene(nthreads=threads)
        self._foliage = -1
        for name in ("solid", "foliage"):
            mesh = getattr(scene, name)
            if len(mesh.triangles):
                vertices = self._o3d.core.Tensor(mesh.vertices.astype(np.float32))
                triangles = self._o3d.core.Tensor(mesh.triangles.astype(np.uint32))
                number = int(self._scene.add_triangles(vertices, triangles))
                self._foliage = number if name == "foliage" else self._foliage

    def cast(self, origins: Floats32, rays: Floats32, rng: np.random.Generator, porosity: float) -> Hits:
        """Return the first hits of (N, 3) unit rays from (N, 3) origins, scene frame, metres.

        Each surface of foliage lets a ray pass with probability ``porosity``.
        """
        parts = [
            self._cast_block(origins[i : i + BLOCK], rays[i : i + BLOCK], rng, porosity)
            for i in range(0, len(rays), BLOCK)
        ]
        if not parts:
            return Hits(np.zeros(0, np.float32), np.zeros(0, np.float32))
        return Hits(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _cast_block(self, origins: Floats32, rays: Floats32, rng: np.random.Generator, porosity: float) -> Hits:
        count = len(rays)
        distance, incidence = np.full(count, np.inf, np.float32), np.zeros(count, np.float32)
        alive: Indices = np.arange(count, dtype=np.intp)
        start = np.zeros(count, np.float32)
        for layer in range(_MAX_LAYERS):
            from_here = origins[alive] + rays[alive] * start[alive, None]
            t, cosine, leaf = self._query(from_here, rays[alive])
            t += start[alive]
            depth = (rng.exponential(self._leaf_depth, len(t)) * leaf).astype(np.float32)
            distance[alive], incidence[alive] = t + depth, np.where(leaf, 1.0, cosine)
            if layer + 1 == _MAX_LAYERS:
                break
            through = leaf & (rng.random(len(t)) < porosity)
            alive = alive[through]
            start[alive] = t[through] + _STEP
            if not len(alive):
                break
        return Hits(distance, incidence)

    def _query(self, origins: Floats32, rays: Floats32) -> tuple[Floats32, Floats32, Bools]:
        packed = np.ascontiguousarray(np.concatenate([origins, rays], axis=1), dtype=np.float32)
        answer = self._scene.cast_rays(self._o3d.core.Tensor(packed), nthreads=self._threads)
        cosine = np.abs(np.einsum("ij,ij->i", answer["primitive_normals"].numpy(), rays))
        # copies: the arrays belong to the tensors of the answer
        return answer["t_hit"].numpy().copy(), cosine, answer["geometry_ids"].numpy() == self._foliage
