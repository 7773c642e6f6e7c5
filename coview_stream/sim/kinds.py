"""Kinds of scene: streets, buildings and vegetation of towns, campuses, villages, industry, depots and forests.

All numbers are plausible, not measured.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from coview_stream.sim import buildings
from coview_stream.sim.layout import Layout, grid_layout, loop_layout
from coview_stream.sim.vegetation import TreeMix

Range = tuple[float, float]


class Plot(NamedTuple):
    """One type of building."""

    draw: buildings.Draw  # draws one building
    weight: float  # relative frequency
    frontage: Range  # length along the street, metres
    depth: Range  # metres


class Kind(NamedTuple):
    """Contents of a scene; lengths in metres, densities per square metre."""

    streets: Callable[[np.random.Generator, float, float], Layout]  # (rng, size, half) -> layout
    relief: float  # amplitude of the hills
    roughness: float  # amplitude of bumps off the road
    ditch: float  # depth of the ditches along the roads
    plots: tuple[Plot, ...]  # buildings along the streets
    setback: Range  # range of the distance from the footway to a building
    gap: Range  # range of the distance between neighbours
    vacant: float  # share of the plots that stay empty
    infill: float  # density of buildings away from streets
    trees: float  # density
    species: TreeMix  # sizes and shapes of the trees
    undergrowth: float = 0.0  # density of bushes
    rocks: float = 0.0  # density of boulders
    logs: float = 0.0  # density of fallen trunks
    cars: float = 0.0  # share of the parking places that are taken
    pole_spacing: float = 0.0  # mean distance between poles on one side of a street; 0 for none
    hedges: float = 0.0  # share of the plots with a hedge or fence in front
    passage: tuple[float, float] = (0.0, 0.0)  # length and width of a hall on the robots' route


_HOUSE = Plot(buildings.house, 1.0, (8.0, 15.0), (8.0, 13.0))
_INSTITUTE = Plot(buildings.institute, 1.0, (24.0, 48.0), (18.0, 36.0))

KINDS: dict[str, Kind] = {
    "town": Kind(
        streets=lambda rng, size, half: grid_layout(rng, size, half, (42.0, 72.0), 4.2, bend=4.0),
        relief=0.9,
        roughness=0.03,
        ditch=0.0,
        plots=(_HOUSE, Plot(buildings.institute, 0.12, (18.0, 30.0), (14.0, 20.0))),
        setback=(0.5, 5.0),
        gap=(0.8, 7.0),
        vacant=0.12,
        infill=0.0004,
        trees=0.0035,
        species=TreeMix((4.0, 12.0)),
        undergrowth=0.004,
        cars=0.45,
        pole_spacing=26.0,
        hedges=0.5,
    ),
    "campus": Kind(
        streets=lambda rng, size, half: loop_layout(rng, size, half, 3.2, branches=5, waviness=0.22),
        relief=1.6,
        roughness=0.05,
        ditch=0.0,
        plots=(_INSTITUTE, Plot(buildings.hall, 0.15, (20.0, 30.0), (15.0, 22.0))),
        setback=(3.0, 14.0),
        gap=(8.0, 30.0),
        vacant=0.3,
        infill=0.0004,
        trees=0.0045,
        species=TreeMix((5.0, 15.0), conifers=0.2),
        undergrowth=0.002,
        cars=0.2,
        pole_spacing=30.0,
        hedges=0.25,
    ),
    "village": Kind(
        streets=lambda rng, size, half: loop_layout(rng, size, half, 3.0, branches=4, waviness=0.3),
        relief=2.4,
        roughness=0.06,
        ditch=0.25,
        plots=(_HOUSE, Plot(buildings.barn, 0.35, (14.0, 26.0), (9.0, 14.0))),
        setback=(1.5, 9.0),
        gap=(4.0, 18.0),
        vacant=0.25,
        infill=0.0002,
        trees=0.006,
        species=TreeMix((3.5, 13.0), conifers=0.2),
        undergrowth=0.006,
        cars=0.15,
        pole_spacing=38.0,
        hedges=0.6,
    ),
    "industrial": Kind(
        streets=lambda rng, size, half: grid_layout(rng, size, half, (70.0, 105.0), 5.2, bend=0.0),
        relief=0.4,
        roughness=0.02,
        ditch=0.0,
        plots=(
            Plot(buildings.hall, 1.0, (25.0, 50.0), (18.0, 35.0)),
            Plot(buildings.tanks, 0.35, (18.0, 32.0), (10.0, 16.0)),
            Plot(buildings.containers, 0.45, (14.0, 30.0), (8.0, 16.0)),
        ),
        setback=(3.0, 9.0),
        gap=(4.0, 16.0),
        vacant=0.2,
        infill=0.0002,
        trees=0.001,
        species=TreeMix((4.0, 10.0)),
        undergrowth=0.001,
        cars=0.3,
        pole_spacing=32.0,
        hedges=0.6,
    ),
    "forest": Kind(
        streets=lambda rng, size, half: loop_layout(rng, size, half, 2.1, branches=3, waviness=0.3),
        relief=4.5,
        roughness=0.12,
        ditch=0.45,
        plots=(Plot(buildings.cabin, 1.0, (4.0, 8.0), (4.0, 6.0)),),
        setback=(2.0, 10.0),
        gap=(30.0, 120.0),
        vacant=0.6,
        infill=0.0,
        trees=0.036,
        species=TreeMix((7.0, 26.0), spread=(0.12, 0.2), conifers=0.5),
        undergrowth=0.02,
        rocks=0.0012,
        logs=0.0012,
    ),
}
KINDS["depot"] = KINDS["industrial"]._replace(passage=(48.0, 22.0))
"""Industry with a hall on the robots' route; the map has the hall's inside from a terrestrial scanner."""
