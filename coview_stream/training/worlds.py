"""Training worlds: a place at two times, the map's scan of it, and the robot's submaps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from coview_stream.clouds.filters import voxel_grid
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points
from coview_stream.sim.airborne import Flight, airborne_scan
from coview_stream.sim.caster import Caster
from coview_stream.sim.scenes import SceneState, build_scene
from coview_stream.training.paths import along_streets, between_trees
from coview_stream.training.recipe import Recipe
from coview_stream.training.stands import draw_stand, tags
from coview_stream.training.submaps import RADIUS, VOXEL, Frames, Submap, gathered, scanned

_PLACE, _FLIGHT, _DRIVES = range(3)  # random streams
_BEYOND = 8.0  # metres of forest beyond the map; set by hand


@dataclass(frozen=True)
class World:
    """A training world.

    Attributes:
        size: side of the square map about the origin, metres.
        kind: forest type or kind of scene, in words.
        mapped: the place when the map is scanned.
        now: the place when the robot drives.
        ground: heights (N,) of the ground at x and y (N,), metres.
        span: lowest and highest ground, metres.
        path: (random numbers, greatest distance from the origin in x and y, length) -> path (N, 2), metres.
        drawn: values that were drawn for it, for JSON.
    """

    size: float
    kind: str
    mapped: SceneState
    now: SceneState
    ground: Callable[[Floats, Floats], Floats]
    span: tuple[float, float]
    path: Callable[[np.random.Generator, float, float], Floats]
    drawn: dict[str, Any]


def draw_world(seed: int, recipe: Recipe) -> World:
    """Draw the world of a seed.

    Raises:
        DependencyError: Open3D cannot be loaded.
    """
    rng = np.random.default_rng([seed, _PLACE])
    size = 4.0 * round(recipe.draw(rng, "size") / 4.0)
    if rng.random() < recipe.built:
        return _built(rng, seed, recipe, size)
    stand = draw_stand(rng, recipe, size / 2 + _BEYOND)
    return World(
        size=size,
        kind=tags(stand.drawn),
        mapped=stand.mapped,
        now=stand.now,
        ground=stand.terrain.z,
        span=stand.terrain.span,
        path=lambda rng, extent, length: between_trees(rng, stand.obstacles, extent, length),
        drawn=stand.drawn,
    )


def _built(rng: np.random.Generator, seed: int, recipe: Recipe, size: float) -> World:
    kind, changed = str(rng.choice(recipe.kinds)), recipe.draw(rng, "changed")
    scene = build_scene(kind, seed, size, changed)
    axis: Floats = np.linspace(-size / 2, size / 2, 50)
    heights = scene.site.z(*(each.ravel() for each in np.meshgrid(axis, axis)))
    return World(
        size=size,
        kind=kind,
        mapped=scene.mapped,
        now=scene.now,
        ground=scene.site.z,
        span=(float(heights.min()), float(heights.max())),
        path=lambda rng, extent, length: along_streets(rng, scene.site.layout, extent, length),
        drawn={"changed": changed},
    )


def base_scan(world: World, seed: int, recipe: Recipe) -> tuple[Points, dict[str, float]]:
    """Scan the map from the air: (N, 3) float32 metres, one point per voxel, and the values drawn for the flight."""
    rng = np.random.default_rng([seed, _FLIGHT])
    names = (
        "pulses",
        "altitude",
        "swath",
        "aerial_noise",
        "aerial_porosity",
        "leaf_depth",
        "strip_shift",
        "strip_lift",
    )
    drawn = {name: recipe.draw(rng, name) for name in names}
    swath = float(np.radians(drawn["swath"]))
    relief = max(abs(end) for end in world.span) + 30.0
    flight = Flight(
        altitude=drawn["altitude"],
        swath=swath,
        noise=drawn["aerial_noise"],
        porosity=drawn["aerial_porosity"],
        margin=max(5.0, float(relief * np.tan(swath))),
    )
    caster = Caster(world.mapped, threads=1, leaf_depth=drawn["leaf_depth"])
    strips = []
    for _, strip in airborne_scan(caster, world.size, drawn["pulses"], rng, flight):
        bias = rng.normal(size=3) * (drawn["strip_shift"], drawn["strip_shift"], drawn["strip_lift"])
        strips.append((strip + bias).astype(np.float32))
    return voxel_grid(np.concatenate(strips), VOXEL), drawn


def drives(world: World, seed: int, recipe: Recipe) -> Iterator[tuple[str, Frames]]:
    """Drive through the world ``recipe.submaps`` times; yields the sensor's name and its frames."""
    rng = np.random.default_rng([seed, _DRIVES])
    caster = Caster(world.now, threads=1, leaf_depth=recipe.draw(rng, "leaf_depth"))
    porosity = recipe.draw(rng, "ground_porosity")
    extent = world.size / 2 - RADIUS
    drive = partial(scanned, rng, recipe, caster, world.ground, porosity=porosity)
    for k in range(recipe.submaps):
        sensor = recipe.sensors[k % len(recipe.sensors)]
        short = rng.random() < recipe.standing
        length = rng.uniform(0, min(3.0, recipe.travel[1])) if short else recipe.draw(rng, "travel")
        length = 0.0 if short and rng.random() < 0.5 else length
        yield sensor, drive(path=world.path(rng, extent, length), sensor=sensor)


def submaps(world: World, seed: int, recipe: Recipe) -> Iterator[tuple[str, Submap]]:
    """Yield the submaps of :func:`drives`, with the sensor's name."""
    for sensor, frames in drives(world, seed, recipe):
        yield sensor, gathered(frames)
