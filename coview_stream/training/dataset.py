"""Training data on disk: one file per world, with the bird's-eye views of its map and of its submaps."""

from __future__ import annotations

import json
import os
import time
import zipfile
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.descriptors.birds_eye_view import CELL, Image, birds_eye_view
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats
from coview_stream.training.recipe import Recipe
from coview_stream.training.worlds import base_scan, draw_world, submaps

QUERY_CELLS = 128
"""Rows and columns of a query's image."""

_CORNER = np.full(2, -QUERY_CELLS * CELL / 2)
_KEYS = ("aerial", "corner", "queries", "poses", "sensor", "kind", "travelled", "recipe")


@dataclass(frozen=True)
class WorldViews:
    """Bird's-eye views of a world.

    Attributes:
        aerial: (LAYERS, H, W) the map.
        corner: (2,) of the map's cell (0, 0), metres.
        queries: (K, LAYERS, QUERY_CELLS, QUERY_CELLS), each about the robot.
        poses: (K, 3) x, y, yaw of the queries: ``p_world = R(yaw) p_query + (x, y)``, metres and radians.
        sensor: (K,) names.
        kind: of the world, in words.
        travelled: (K,) metres driven for each query.
        recipe: the seed, the recipe, and the values drawn from it.
    """

    aerial: Image
    corner: Floats
    queries: npt.NDArray[np.uint8]
    poses: Floats
    sensor: npt.NDArray[np.str_]
    kind: str
    travelled: Floats
    recipe: dict[str, Any]


def world_views(seed: int, recipe: Recipe) -> WorldViews:
    """Draw the world of a seed, and its views.

    Raises:
        DependencyError: Open3D cannot be loaded.
    """
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
        recipe={"seed": seed, "recipe": recipe.to_dict(), "world": world.drawn, "flight": flight},
    )


def write_world(path: str | os.PathLike[str], seed: int, recipe: Recipe) -> None:
    """Write the world of a seed; the file is complete or not there.

    Raises:
        InputError: the file cannot be written.
        DependencyError: Open3D cannot be loaded.
    """
    path, views = Path(path), world_views(seed, recipe)
    fields = {name: getattr(views, name) for name in _KEYS} | {"recipe": json.dumps(views.recipe)}
    try:
        with atomic_file(path) as file:
            np.savez_compressed(file, **fields)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another directory") from error


def read_world(path: str | os.PathLike[str]) -> WorldViews:
    """Read a file of :func:`write_world`.

    Raises:
        InputError: there is no such file, or it holds no views of a world.
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
    """Write ``SEED.npz`` for each seed into a directory; existing files stay.

    Args:
        directory: created if it is missing.
        seeds: of the worlds.
        recipe: ranges to draw from.
        workers: processes.
        progress: called with the seed and the seconds it took, when a file is ready.

    Returns:
        The files, in the order of the seeds.

    Raises:
        InputError: the directory or a file cannot be written.
        DependencyError: Open3D cannot be loaded.
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
    if workers <= 1:
        for seed in missing:
            report(seed, write(seed))
    else:
        # Open3D in a forked process may hang on the threads of its parent
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            jobs = {pool.submit(write, seed): seed for seed in missing}
            try:
                for job in as_completed(jobs):
                    report(jobs[job], job.result())
            except BaseException:  # Ctrl-C too: else all pending worlds would be made first
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    return list(paths.values())


def _timed(directory: Path, recipe: Recipe, seed: int) -> float:
    begin = time.perf_counter()
    write_world(directory / f"{seed}.npz", seed, recipe)
    return time.perf_counter() - begin
