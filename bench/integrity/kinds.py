"""Kinds of sites by name: the simulator's, two more of its sort, and made-up ones; and which may be fitted on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np

from bench.integrity import made_up
from coview_stream import BaseMap
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
        plots=(Plot(buildings.house, 1.0, (7.0, 12.0), (7.0, 11.0)),), species=TreeMix((3.0, 10.0), conifers=0.3),
        relief=1.2, roughness=0.04, ditch=0.0, setback=(3.0, 8.0), gap=(3.0, 8.0), vacant=0.08, infill=0.0006,
        trees=0.005, undergrowth=0.008, cars=0.35, pole_spacing=32.0, hedges=0.8,
    ),
    "harbour": Kind(
        streets=lambda rng, size, half: grid_layout(rng, size, half, (58.0, 82.0), 5.2, bend=0.0),
        plots=(
            Plot(buildings.hall, 0.7, (24.0, 45.0), (13.0, 22.0)),
            Plot(buildings.containers, 1.0, (16.0, 36.0), (8.0, 14.0)),
            Plot(buildings.tanks, 0.3, (18.0, 30.0), (9.0, 14.0)),
            Plot(buildings.barn, 0.3, (16.0, 28.0), (9.0, 13.0)),
        ), species=TreeMix((4.0, 8.0)),
        relief=0.15, roughness=0.01, ditch=0.0, setback=(1.5, 5.0), gap=(2.5, 10.0), vacant=0.08, infill=0.0004,
        trees=0.0002, cars=0.25, pole_spacing=36.0, hedges=0.2,
    ),
}  # fmt: skip
"""Made of the simulator's parts; all numbers are set by hand."""

DRAWN: dict[str, Callable[[int, float, float], Scene]] = {
    kind.__name__: kind
    for kind in (
        made_up.terraces, made_up.plantation, made_up.yard, made_up.rows, made_up.boxes, made_up.avenue, made_up.court,
    )
}  # fmt: skip
"""(seed, size, changed) -> scene."""

CALIBRATION = frozenset({"town", "campus", "terraces", "plantation"})
"""Kinds that anything may be fitted on, and that are never reported."""

REPORTED = frozenset({*KINDS, *MORE, *DRAWN}) - CALIBRATION - {"depot"}  # without its hall it is the industrial kind


def draw(kind: str, seed: int, changed: float) -> Scene:
    """Draw a site; this share of its trees, cars and poles is ``changed`` now."""
    size = SIZES.get(kind, SIZE)
    if kind in DRAWN:
        return DRAWN[kind](seed, size, changed)
    with patch.dict(KINDS, MORE):
        return build_scene(kind, seed, size, changed)


SIZE, SIZES = 180.0, {"boxes": 520.0, "avenue": 260.0}  # metres, the side of a site; of kinds that need more
_DENSITY, _DENSITIES = 10.0, {"boxes": 6.0}  # pulses per square metre
_STRIPS = {"boxes": 30.0, "avenue": 40.0}  # metres from a street beyond which the map has only high objects
_HIGH = 5.0  # metres
_SCAN = 210  # random stream


def surveyed(scene: Scene, seed: int) -> Floats:
    """Scan a scene as it was: (N, 3) metres, scene frame."""
    rng = np.random.default_rng([seed, _SCAN])
    flown = airborne_scan(Caster(scene.mapped, threads=1), scene.size, _DENSITIES.get(scene.kind, _DENSITY), rng)
    points = np.concatenate([each for _, each in flown])
    if scene.kind in _STRIPS:
        near = scene.site.road_distance(*points[:, :2].T) < _STRIPS[scene.kind]
        points = points[near | (points[:, 2] > _HIGH)]
    return points


def built(points: Floats) -> BaseMap:
    """Build a map as the command line does: with learned features."""
    with TemporaryDirectory() as scratch:
        file = Path(scratch) / "base.npy"
        np.save(file, points)
        return BaseMap.build(file, learned=True)
