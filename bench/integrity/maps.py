"""Base maps of sites: airborne scans, and terrestrial ones of storeys."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from coview_stream import BaseMap
from coview_stream.descriptors.network import VIEW_NAMES, network
from coview_stream.errors import CoViewError
from coview_stream.geometry.arrays import Floats
from coview_stream.sim.airborne import airborne_scan
from coview_stream.sim.caster import Caster
from coview_stream.sim.scenes import Scene

SIZE = 180.0
SIZES = {"boxes": 520.0, "avenue": 260.0}
"""Metres, the side of a site; those of kinds that need more."""

_DENSITY = 10.0  # pulses per square metre, set by hand
_DENSITIES = {"boxes": 6.0}
_STRIPS = {"boxes": 30.0, "avenue": 40.0}  # metres from a street, beyond which the map has only what is high
_HIGH = 5.0  # metres
_SCAN = 210  # random stream
_TRIPODS, _RAYS, _REACH, _NOISE = 4.0, 15_000, 30.0, 0.01  # of a storey's scan: metres apart, number, metres, metres


def size_of(kind: str) -> float:
    """Return the side of a site of some kind, metres."""
    return SIZES.get(kind, SIZE)


def surveyed(scene: Scene, seed: int) -> Floats:
    """Scan a scene as it was: (N, 3) metres, scene frame."""
    rng = np.random.default_rng([seed, _SCAN])
    caster = Caster(scene.mapped, threads=1)
    if scene.kind == "storey":
        return _from_tripods(scene, caster, rng)
    flown = airborne_scan(caster, scene.size, _DENSITIES.get(scene.kind, _DENSITY), rng)
    points = np.concatenate([each for _, each in flown])
    if scene.kind in _STRIPS:
        near = scene.site.road_distance(*points[:, :2].T) < _STRIPS[scene.kind]
        points = points[near | (points[:, 2] > _HIGH)]
    return points


def _from_tripods(scene: Scene, caster: Caster, rng: np.random.Generator) -> Floats:
    """Scan from many places within the walls, a full sphere each, 1.6 m above the floor."""
    walls = scene.mapped.solid.vertices[scene.mapped.solid.vertices[:, 2] > 1.0, :2]
    reach = np.abs(walls).max()
    at = np.arange(-reach, reach, _TRIPODS)
    clouds = []
    for x, y in np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2):
        rays = rng.normal(size=(_RAYS, 3))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        origin = np.array([x, y, 1.6])
        t = caster.cast(np.tile(origin, (_RAYS, 1)).astype(np.float32), rays.astype(np.float32), rng, 0.0).distance
        if np.mean(t[rays[:, 2] > 0.2] < _REACH) > 0.95:  # below the ceiling
            near = t < _REACH
            far = t[near].astype(np.float64) + rng.normal(0, _NOISE, int(near.sum()))
            clouds.append(origin + rays[near] * far[:, None])
    return np.concatenate(clouds)


def built(points: Floats) -> BaseMap:
    """Build a map as the command line does: with learned features where the networks can be loaded."""
    with TemporaryDirectory() as scratch:
        file = Path(scratch) / "base.npy"
        np.save(file, points)
        return BaseMap.build(file, learned=_networks())


@cache
def _networks() -> bool:
    try:
        for view in VIEW_NAMES:
            network(view)
    except CoViewError:
        return False
    return True
