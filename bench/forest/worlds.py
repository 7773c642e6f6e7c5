"""Where learned re-localization is judged: worlds of the training simulator that it never saw, and worlds on disk.

Of a drawn world the frames of each submap are kept, not the submap: what the product makes of them is measured too.
Beside them, what all forest benchmarks share: progress, the weights, and what their results depend on.
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness.files import fingerprint, folder, remembered
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, exp_so3, inverse, pose_from
from coview_stream.report.evaluation import driven
from coview_stream.training.recipe import Recipe

BEHIND = 12.0  # metres of a recorded run that a query is made of, and ...
EVERY = 10.0
"""... and between two queries of it."""

_SPACING = 0.25  # metres between the frames of a recorded run that are read
_LEANING = 3  # random stream


WORLDS = (*(f"coview_stream/{part}" for part in ("geometry", "clouds", "sim", "training")), "bench/forest/worlds.py")
"""What makes worlds, and the runs and queries in them."""

ANSWERS = (
    *WORLDS,
    *(f"coview_stream/{part}" for part in ("config", "descriptors", "odometry", "basemap", "localization")),
    "coview_kernels",
    *(f"bench/forest/{part}.py" for part in ("methods", "query")),
)
"""What answers to single queries depend on as well, but for the weights. Whole runs depend on all of the product."""

_PARTS = ("base.laz", "base.las", "truth.tum", "world.json", "run/odometry.tum")


def place() -> Path:
    """Where worlds and answers are kept."""
    return folder() / "forest"


def say(text: str) -> None:
    """Report progress."""
    print(f"{time.strftime('%H:%M:%S')} {text}", file=sys.stderr, flush=True)


def weights() -> str:
    """Say which weights the package has, by both networks' hashes."""
    from coview_stream.descriptors.network import weights_directory, weights_name

    total = hashlib.sha256()
    for view in ("aerial", "ground"):
        file = weights_directory() / weights_name(view)
        total.update(file.read_bytes() if file.is_file() else b"")
    return total.hexdigest()[:10]


def code() -> str:
    """Hash of all that answers depend on but the weights."""
    return fingerprint(*ANSWERS)


def noted(text: str, command: str) -> str:
    """Return a table with the command that made it, which knows no paths of a machine."""
    return f"{text}\n\n`python -m bench {command}`. Weights {weights()}, code {code()}, {time.strftime('%Y-%m-%d')}."


def on_disk(world: Path) -> dict[str, Any]:
    """Say what lies in a world's folder: a hash of its files' names, sizes and times."""
    files = [world / part for part in _PARTS] + sorted((world / "run" / "frames").glob("*"))
    total = hashlib.sha256()
    for file in files:
        if file.is_file():
            stat = file.stat()
            total.update(f"{file.relative_to(world)} {stat.st_size} {stat.st_mtime_ns}\n".encode())
    return {"world": str(world.resolve()), "files": total.hexdigest()[:16]}


@dataclass(frozen=True)
class Drive:
    """What a robot has seen up to now.

    Attributes:
        sensor: its name.
        travelled: metres, by odometry.
        odometry: (F, 4, 4) odometry <- body of each frame, oldest first; metres.
        clouds: (N, 3) of each frame, body frame, metres.
        truth: (4, 4) map <- body of the newest frame, in the frame of the map's source.
    """

    sensor: str
    travelled: float
    odometry: Floats
    clouds: tuple[Points, ...]
    truth: Pose


@dataclass(frozen=True)
class Place:
    """A map's cloud and the drives through the place.

    Attributes:
        name: of the world.
        kind: what it is, in words.
        base: file of the map's cloud.
        drives: each a query.
    """

    name: str
    kind: str
    base: Path
    drives: list[Drive]


def drawn(folder: Path, seed: int, queries: int, recipe: Recipe | None = None) -> Place:
    """Return the world of a seed, simulated now unless ``folder`` has it.

    Raises:
        DependencyError: Open3D cannot be loaded.
    """
    recipe = replace(recipe or Recipe(), submaps=queries)
    out = folder / f"drawn-{seed}-{queries}"
    spec = {"seed": seed, "recipe": recipe.to_dict(), "code": fingerprint(*WORLDS)}
    kind = str(remembered(out / "drawn.json", spec, lambda: _simulate(out, seed, recipe))["kind"])
    return Place(f"seed {seed}", kind, out / "base.npy", _read(out / "drives.npz"))


def _simulate(out: Path, seed: int, recipe: Recipe) -> dict[str, Any]:
    from coview_stream.training.worlds import base_scan, draw_world

    out.mkdir(parents=True, exist_ok=True)
    world = draw_world(seed, recipe)
    np.save(out / "base.npy", base_scan(world, seed, recipe)[0])
    _write(out / "drives.npz", list(_drives(world, seed, recipe)))
    return {"kind": world.kind}


def _drives(world: Any, seed: int, recipe: Recipe) -> Iterator[Drive]:
    from coview_stream.training.worlds import drives

    rng = np.random.default_rng([seed, _LEANING])
    for sensor, frames in drives(world, seed, recipe):
        lean = np.radians(recipe.draw(rng, "gravity_error")) * rng.normal(size=2)
        leaning = pose_from(exp_so3(np.array([*lean, 0.0])), np.zeros(3))
        yield Drive(sensor, frames.travelled, leaning @ frames.odometry, frames.clouds, frames.truth[-1])


def _write(file: Path, drives: list[Drive]) -> None:
    clouds = [cloud for drive in drives for cloud in drive.clouds]
    np.savez(
        file,
        sensor=np.array([drive.sensor for drive in drives]),
        travelled=np.array([drive.travelled for drive in drives]),
        truth=np.array([drive.truth for drive in drives]),
        frames=np.array([len(drive.clouds) for drive in drives]),
        odometry=np.concatenate([drive.odometry for drive in drives]),
        counts=np.array([len(cloud) for cloud in clouds]),
        points=np.concatenate(clouds).astype(np.float32),
    )


def _read(file: Path) -> list[Drive]:
    with np.load(file, allow_pickle=False) as kept:
        of = dict(kept)
    clouds = np.split(of["points"], np.cumsum(of["counts"])[:-1])
    ends = np.cumsum(of["frames"])
    return [
        Drive(str(of["sensor"][k]), float(of["travelled"][k]), of["odometry"][end - count : end],
              tuple(clouds[end - count : end]), of["truth"][k])
        for k, (end, count) in enumerate(zip(ends, of["frames"], strict=True))
    ]  # fmt: skip


def base_of(directory: Path) -> Path:
    """Return the map's cloud of a world on disk.

    Raises:
        InputError: there is neither base.laz nor base.las.
    """
    for name in ("base.laz", "base.las"):
        if (directory / name).is_file():
            return directory / name
    raise InputError(f"{directory}: no base.laz or base.las; name a folder as 'coview-stream simulate' makes it")


def recorded(directory: Path, most: int | None = None) -> Place:
    """Read a world on disk (base, run/frames, run/odometry.tum, truth.tum); at most ``most`` queries, spread over it.

    Raises:
        InputError, RunError, CloudError: a part is missing or cannot be read.
    """
    from coview_stream.clouds import read_tum
    from coview_stream.recordings.open_run import open_run

    run = open_run(directory / "run")
    stamps, poses = read_tum(directory / "truth.tum")
    told = run.poses
    way = driven(told)
    drives = []
    for end in ends_of(way, most):
        nearest = int(np.abs(stamps - run.stamps[end]).argmin())
        if abs(stamps[nearest] - run.stamps[end]) > 0.051:
            continue
        chosen = frames_behind(way, end)
        clouds = tuple(run.read(k).points for k in chosen)
        drives.append(Drive(_sensor(directory), float(way[end] - way[chosen[0]]), told[chosen], clouds, poses[nearest]))
    return Place(directory.name, "on disk", base_of(directory), drives)


def ends_of(way: Floats, most: int | None) -> list[int]:
    """Frames at which queries end: every ten of the metres (N,) that were driven, the first after twelve."""
    marks = np.arange(min(BEHIND, way[-1]), way[-1] + 1e-6, EVERY)
    ends = np.unique(np.minimum(np.searchsorted(way, marks - 1e-6), len(way) - 1))
    if most is not None and len(ends) > most:
        ends = ends[np.unique(np.linspace(0, len(ends) - 1, most).round().astype(int))]
    return [int(end) for end in ends]


def frames_behind(way: Floats, end: int) -> list[int]:
    """Return frames of the last twelve metres, a quarter of a metre apart or more; the last one is ``end``."""
    chosen = [end]
    for k in range(end - 1, -1, -1):
        if way[end] - way[k] > BEHIND + 1e-3:
            break
        if way[chosen[-1]] - way[k] >= _SPACING:
            chosen.append(k)
    return chosen[::-1]


def _sensor(directory: Path) -> str:
    file = directory / "world.json"
    return str(json.loads(file.read_text()).get("sensor", "unknown")) if file.is_file() else "unknown"


def in_odometry(drive: Drive) -> tuple[Floats, Pose]:
    """Odometry (F, 4, 4) about the newest position, and the true pose (4, 4) of that frame: map <- odometry."""
    told = drive.odometry.copy()
    told[:, :3, 3] -= drive.odometry[-1, :3, 3]
    return told, drive.truth @ inverse(told[-1])
