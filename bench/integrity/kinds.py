"""Kinds of sites by name: the simulator's, two more of its sort, and made-up ones; and which may be fitted on."""

from __future__ import annotations

from collections.abc import Callable
from unittest.mock import patch

from bench.integrity import enclosed, estates
from coview_stream.sim import KINDS, buildings
from coview_stream.sim.kinds import Kind, Plot
from coview_stream.sim.layout import grid_layout, loop_layout
from coview_stream.sim.scenes import Scene, build_scene
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
    "terraces": estates.terraces,
    "plantation": estates.plantation,
    "yard": estates.yard,
    "rows": estates.rows,
    "boxes": estates.boxes,
    "avenue": enclosed.avenue,
    "court": enclosed.court,
    "storey": enclosed.storey,
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
