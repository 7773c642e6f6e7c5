"""What has changed on a site since its survey: other buildings, or all of them a few metres off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bench.tracking.worlds import earlier, owners
from coview_stream.geometry.arrays import Floats
from coview_stream.sim.scenes import Scene


def rebuilt(scene: Scene, seed: int, share: float) -> Scene:
    """Return the scene with a ``share`` of its buildings others now: gone, smaller, or turned round and shifted.

    It is :func:`bench.tracking.worlds.earlier` the other way round: the survey stays as it was.
    """
    other = earlier(replace(scene, mapped=scene.now, now=scene.now), seed, share)
    return replace(scene, now=other.mapped)


def shifted(scene: Scene, shift: Floats) -> Scene:
    """Return the scene with all buildings moved by (2,) metres now; ground, trees, cars and poles stay."""
    solid = scene.now.solid
    vertices = solid.vertices.copy()
    vertices[owners(scene) >= 0, :2] += np.asarray(shift)
    return replace(scene, now=replace(scene.now, solid=solid._replace(vertices=vertices)))
