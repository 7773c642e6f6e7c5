"""Training worlds: a site at two times, the map's scan, the robot's submaps, and their bird's-eye views on disk."""

from __future__ import annotations

import json
import os
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.basemap.site.executors import Executor, ProcessExecutor
from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.clouds.filters import voxel_grid
from coview_stream.descriptors.birds_eye_view import CELL, Image, birds_eye_view
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points
from coview_stream.sim.airborne import Flight, airborne_scan
from coview_stream.sim.scenes import SceneState, build_scene
from coview_stream.sim.sensors import Caster
from coview_stream.training.drives import RADIUS, VOXEL, Frames, Submap, along_streets, between_trees, gathered, scanned
from coview_stream.training.recipe import Recipe
from coview_stream.training.stands import draw_stand, tags

_PLACE, _FLIGHT, _DRIVES = range(3)  # random streams
_BEYOND = 8.0  # metres of forest beyond the map


@dataclass(frozen=True)
class World:
    """A training world."""

    size: float  # side of the square map about the origin, metres
    kind: str  # forest type or kind of scene, in words
    mapped: SceneState  # geometry when the map is scanned
    now: SceneState  # geometry when the robot drives
    ground: Callable[[Floats, Floats], Floats]  # ground heights (N,) at x and y (N,), metres
    span: tuple[float, float]  # lowest and highest ground, metres
    # (random numbers, greatest distance from the origin in x and y, length) -> path (N, 2), metres
    path: Callable[[np.random.Generator, float, float], Floats]
    drawn: dict[str, Any]  # values that were drawn for the world, for JSON


def draw_world(seed: int, recipe: Recipe) -> World:
    """Draw the world of a seed."""
    rng = np.random.default_rng([seed, _PLACE])
    size = 4.0 * round(recipe.draw(rng, "size") / 4.0)
    if rng.random() >= recipe.built:
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
    kind, changed = str(rng.choice(recipe.kinds)), recipe.draw(rng, "changed")
    scene = build_scene(kind, seed, size, changed)
    axis: Floats = np.linspace(-size / 2, size / 2, 50)
    heights = scene.site.z(*(grid.ravel() for grid in np.meshgrid(axis, axis)))
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
    """Scan the map from the air; return (N, 3) float32 metres, one point per voxel, and the flight's drawn values."""
    rng = np.random.default_rng([seed, _FLIGHT])
    names = "pulses altitude swath aerial_noise aerial_porosity leaf_depth strip_shift strip_lift"
    drawn = {name: recipe.draw(rng, name) for name in names.split()}
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
    """Drive through the world ``recipe.submaps`` times; yield the sensor's name and the drive's frames."""
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


QUERY_CELLS = 128
"""Rows and columns of a query's image."""

_CORNER = np.full(2, -QUERY_CELLS * CELL / 2)
_KEYS = ("aerial", "corner", "queries", "poses", "sensor", "kind", "travelled", "recipe")


@dataclass(frozen=True)
class WorldViews:
    """Bird's-eye views of a world."""

    aerial: Image  # (LAYERS, H, W) the map
    corner: Floats  # (2,) of the map's cell (0, 0), metres
    queries: npt.NDArray[np.uint8]  # (K, LAYERS, QUERY_CELLS, QUERY_CELLS), each centred on the robot
    poses: Floats  # (K, 3) x, y, yaw of the queries: p_world = R(yaw) p_query + (x, y), metres and radians
    sensor: npt.NDArray[np.str_]  # (K,) names
    kind: str  # of the world, in words
    travelled: Floats  # (K,) metres driven for each query
    recipe: dict[str, Any]  # the seed, the recipe, and the values drawn from it


def world_views(seed: int, recipe: Recipe) -> WorldViews:
    """Draw the views of a seed's world."""
    world = draw_world(seed, recipe)
    base, flight = base_scan(world, seed, recipe)
    cells, corner = round(world.size / CELL), np.full(2, -world.size / 2)
    driven = list(submaps(world, seed, recipe))
    shape = (QUERY_CELLS, QUERY_CELLS)
    return WorldViews(
        aerial=birds_eye_view(base, corner, (cells, cells)),
        corner=corner,
        queries=np.stack([birds_eye_view(submap.points, _CORNER, shape) for _, submap in driven]),
        poses=np.stack([submap.pose for _, submap in driven]),
        sensor=np.array([sensor for sensor, _ in driven]),
        kind=world.kind,
        travelled=np.array([submap.travelled for _, submap in driven]),
        recipe={"seed": seed, "recipe": asdict(recipe), "world": world.drawn, "flight": flight},
    )


def write_world(path: str | os.PathLike[str], seed: int, recipe: Recipe) -> None:
    """Write the views of a seed's world atomically; InputError if the file cannot be written."""
    views = world_views(seed, recipe)
    fields = {name: getattr(views, name) for name in _KEYS} | {"recipe": json.dumps(views.recipe)}
    try:
        with atomic_file(Path(path)) as file:
            np.savez_compressed(file, **fields)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another directory") from error


def read_world(path: str | os.PathLike[str]) -> WorldViews:
    """Read a file of :func:`write_world`.

    Raises:
        InputError: the file does not exist, or holds no views of a world.
    """
    try:
        with np.load(Path(path), allow_pickle=False) as file:
            fields: dict[str, Any] = {name: file[name] for name in _KEYS}
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not the views of a world ({error}); write it again") from error
    fields |= {"kind": str(fields["kind"]), "recipe": json.loads(str(fields["recipe"]))}
    return WorldViews(**fields)


def write_dataset(
    directory: str | os.PathLike[str],
    seeds: Iterable[int],
    recipe: Recipe,
    workers: int = 1,
    progress: Callable[[int, float], None] | None = None,
) -> list[Path]:
    """Write ``SEED.npz`` for each seed into a directory, and return the files in this order; existing files stay.

    ``progress`` is called after each file with its seed and the seconds it took.

    Raises:
        InputError: the directory or a file cannot be written.
    """
    directory = Path(directory)
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{directory}: cannot be made ({error.strerror}); choose another directory") from error
    paths = {int(seed): directory / f"{int(seed)}.npz" for seed in seeds}
    missing = [seed for seed, path in paths.items() if not path.exists()]
    report = progress or (lambda seed, seconds: None)
    write = partial(_timed, directory, recipe)
    # spawn processes: in a forked one Open3D may hang on the threads of its parent
    with closing(ProcessExecutor(workers) if workers > 1 else Executor()) as executor:
        for number, seconds in executor.run(write, missing):
            if isinstance(seconds, Exception):
                raise seconds
            report(missing[number], seconds)
    return list(paths.values())


def _timed(directory: Path, recipe: Recipe, seed: int) -> float:
    begin = time.perf_counter()
    write_world(directory / f"{seed}.npz", seed, recipe)
    return time.perf_counter() - begin
