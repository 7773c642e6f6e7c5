"""Kinds of sites by name: the simulator's, two more of its sort, and made-up ones; and which may be fitted on."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np

from bench.integrity import made_up
from coview_stream import BaseMap
from coview_stream.descriptors.network import VIEW_NAMES, network
from coview_stream.errors import CoViewError
from coview_stream.geometry.arrays import Floats
from coview_stream.sim import KINDS, buildings
from coview_stream.sim.airborne import airborne_scan
from coview_stream.sim.kinds import Kind, Plot
from coview_stream.sim.layout import grid_layout, loop_layout
from coview_stream.sim.scenes import Scene, build_scene
from coview_stream.sim.sensors import Caster
from coview_stream.sim.vegetation import TreeMix

MORE: dict[str, Kind] = {
    "suburb": Kind(
        streets=lambda rng, size, half: loop_layout(rng, size, half, 2.8, branches=6, waviness=0.12),
        relief=1.2,
        roughness=0.04,
        ditch=0.0,
        plots=(Plot(buildings.house, 1.0, (7.0, 12.0), (7.0, 11.0)),),
        setback=(3.0, 8.0),
        gap=(3.0, 8.0),
        vacant=0.08,
        infill=0.0006,
        trees=0.005,
        species=TreeMix((3.0, 10.0), conifers=0.3),
        undergrowth=0.008,
        cars=0.35,
        pole_spacing=32.0,
        hedges=0.8,
    ),
    "harbour": Kind(
        streets=lambda rng, size, half: grid_layout(rng, size, half, (58.0, 82.0), 5.2, bend=0.0),
        relief=0.15,
        roughness=0.01,
        ditch=0.0,
        plots=(
            Plot(buildings.hall, 0.7, (24.0, 45.0), (13.0, 22.0)),
            Plot(buildings.containers, 1.0, (16.0, 36.0), (8.0, 14.0)),
            Plot(buildings.tanks, 0.3, (18.0, 30.0), (9.0, 14.0)),
            Plot(buildings.barn, 0.3, (16.0, 28.0), (9.0, 13.0)),
        ),
        setback=(1.5, 5.0),
        gap=(2.5, 10.0),
        vacant=0.08,
        infill=0.0004,
        trees=0.0002,
        species=TreeMix((4.0, 8.0)),
        cars=0.25,
        pole_spacing=36.0,
        hedges=0.2,
    ),
}
"""Made of the simulator's parts; all numbers are set by hand."""

DRAWN: dict[str, Callable[[int, float, float], Scene]] = {
    "terraces": made_up.terraces,
    "plantation": made_up.plantation,
    "yard": made_up.yard,
    "rows": made_up.rows,
    "boxes": made_up.boxes,
    "avenue": made_up.avenue,
    "court": made_up.court,
    "storey": made_up.storey,
}
"""(seed, size, changed) -> scene."""

CALIBRATION = frozenset({"town", "campus", "terraces", "plantation"})
"""Kinds that anything may be fitted on, and that are never reported."""

REPORTED = frozenset({*KINDS, *MORE, *DRAWN}) - CALIBRATION


def draw(kind: str, seed: int, size: float, changed: float) -> Scene:
    """Draw a site; ``changed`` is the share of what may change that is another now."""
    if kind in DRAWN:
        return DRAWN[kind](seed, size, changed)
    with patch.dict(KINDS, MORE):
        return build_scene(kind, seed, size, changed)


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
        t = caster.trace(np.tile(origin, (_RAYS, 1)).astype(np.float32), rays.astype(np.float32), rng, 0.0).distance
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
