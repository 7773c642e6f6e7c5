"""Surfaces of a scene by what beams do to them: ground with its cover, windows, signs, leaves and bare twigs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Bools, Floats, Floats32
from coview_stream.sim import furniture, vegetation
from coview_stream.sim.caster import MeshCaster
from coview_stream.sim.dirt.change import Seasons, drawn_parts
from coview_stream.sim.dirt.glass import Glass, panes, windows
from coview_stream.sim.dirt.ground_cover import Cover
from coview_stream.sim.mesh import join
from coview_stream.sim.scenes import Parts, Scene
from coview_stream.sim.sensors import POROSITY

GROUND, SOLID, GLAZED, SIGN, LEAVES = range(5)
"""What a beam meets: indices of the meshes of :class:`Surfaces`."""

_CONIFER = vegetation.TREE_COLUMNS.index("conifer")


class Echoes(NamedTuple):
    """What (N,) beams come back from.

    Attributes:
        distance: (N,) metres that the beam counts; inf without a return.
        strength: (N,) cosine of the incidence, less what was lost at glass.
        signs: (N,) whether it is a retro-reflecting sign.
    """

    distance: Floats
    strength: Floats
    signs: Bools


class Surfaces:
    """Scene as the robot's beams meet it, with what lies on its ground and with windows in some of its walls."""

    def __init__(self, scene: Scene, cover: Cover | None, glass: Glass | None, rng: np.random.Generator) -> None:
        """Take the scene as it is now; the buildings with windows are drawn from ``rng``.

        Raises:
            DependencyError: Open3D cannot be loaded.
        """
        self._site, self._cover, self._glass = scene.site, cover, glass
        parts = drawn_parts(scene)[1]
        with_windows = rng.random(len(scene.houses)) < (0.0 if glass is None else glass.share)
        glazed = {house for house, drawn in zip(scene.houses, with_windows, strict=True) if drawn}
        below = scene.site.z(parts.trees[:, 0], parts.trees[:, 1])
        street = [furniture.cars(parts.cars, scene.site), furniture.poles(parts.poles, scene.site)]
        walls = [mesh for k, mesh in enumerate(parts.built) if k not in glazed]
        meshes = [
            scene.site.mesh(None if cover is None else cover.depth),
            join([*walls, *parts.fixed, *street, vegetation.trunks(parts.trees, below)]),
            join(mesh for k, mesh in enumerate(parts.built) if k in glazed),
            furniture.sign_plates(parts.poles, scene.site),
            join([*parts.bushes, vegetation.crowns(parts.trees, below)]),
        ]
        self._caster = MeshCaster(meshes, {LEAVES: None})

    def echoes(self, origins: Floats32, rays: Floats32, rng: np.random.Generator) -> Echoes:
        """Cast (N, 3) unit rays from (N, 3) origins, scene frame, metres."""
        found = self._caster.trace(origins, rays, rng, POROSITY)
        distance, strength = found.distance.astype(np.float64), found.incidence.astype(np.float64)
        if self._cover is not None:
            ground = np.flatnonzero(found.mesh == GROUND)
            at = origins[ground] + rays[ground] * found.distance[ground, None]
            x, y = at[:, 0].astype(np.float64), at[:, 1].astype(np.float64)
            distance[ground] += self._cover.sink(x, y, strength[ground], rng)
        if self._glass is not None:
            self._look_through(self._glass, origins, rays, found.normal, distance, strength, found.mesh == GLAZED, rng)
        return Echoes(distance, strength, found.mesh == SIGN)

    def _look_through(
        self,
        glass: Glass,
        origins: Floats32,
        rays: Floats32,
        normals: Floats32,
        distance: Floats,
        strength: Floats,
        glazed: Bools,
        rng: np.random.Generator,
    ) -> None:
        """Put what is seen in or behind windows in the place of the windows, in ``distance`` and ``strength``."""
        hit = np.flatnonzero(glazed)
        points = origins[hit].astype(np.float64) + distance[hit, None] * rays[hit]
        normal = normals[hit].astype(np.float64)
        is_pane = windows(points, normal, points[:, 2] - self._site.z(points[:, 0], points[:, 1]))
        hit, points, normal = hit[is_pane], points[is_pane], normal[is_pane]
        _, on = panes(glass, points, rays[hit].astype(np.float64), normal, rng)
        beyond = self._caster.trace(on.origins, on.rays, rng, POROSITY)
        which = hit[on.which]
        distance[which] += beyond.distance.astype(np.float64)
        strength[which] = glass.strength * beyond.incidence


def seasonal_caster(parts: Parts, scene: Scene, seasons: Seasons) -> MeshCaster:
    """Return the caster of a survey in winter: broad-leaved trees and bushes are bare."""
    below = scene.site.z(parts.trees[:, 0], parts.trees[:, 1])
    conifers = parts.trees[:, _CONIFER] > 0.5
    green = vegetation.crowns(parts.trees[conifers], below[conifers])
    twigs = join([*parts.bushes, vegetation.crowns(parts.trees[~conifers], below[~conifers])])
    solid = parts.state(scene.site).solid
    return MeshCaster((solid, green, twigs), {1: None, 2: seasons.bare})
