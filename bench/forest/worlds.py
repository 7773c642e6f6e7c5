"""Where learned re-localization is judged: worlds of the training simulator that it never saw, and worlds on disk.

Of a drawn world the frames of each submap are kept, not the submap: what the product makes of them is measured too.
Beside them, what all forest benchmarks share: progress, the weights, and what their results depend on.
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness.files import fingerprint, folder, remembered
from coview_stream.clouds import read_tum
from coview_stream.descriptors.network import weights_directory, weights_name
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, exp_so3, inverse, pose_from
from coview_stream.recordings.open_run import open_run
from coview_stream.report.evaluation import MAX_STAMP_GAP, driven
from coview_stream.training.recipe import Recipe
from coview_stream.training.worlds import base_scan, draw_world, drives

BEHIND, EVERY = 12.0, 10.0  # metres of a recorded run that a query is made of, and between two queries
_SPACING = 0.25  # metres between the frames of a recorded run that are read
_LEANING = 3  # random stream

WORLDS = (*(f"coview_stream/{part}" for part in ("geometry", "clouds", "sim", "training")), "bench/forest/worlds.py")
"""What makes worlds, and the runs and queries in them."""

ANSWERS = (
    *WORLDS,
    *(f"coview_stream/{part}" for part in ("config", "descriptors", "odometry", "basemap", "localization")),
    "coview_kernels",
    "bench/forest/forest.py",
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
    total = hashlib.sha256()
    for view in ("aerial", "ground"):
        file = weights_directory() / weights_name(view)
        total.update(file.read_bytes() if file.is_file() else b"")
    return total.hexdigest()[:10]


def code() -> str:
    """Hash of all that answers depend on but the weights."""
    return fingerprint(*ANSWERS)


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
    """Frames that a robot has seen so far."""

    sensor: str
    travelled: float  # metres, by odometry
    odometry: Floats  # (F, 4, 4) odometry <- body of each frame, oldest first; metres
    clouds: tuple[Points, ...]  # (N, 3) of each frame, body frame, metres
    truth: Pose  # (4, 4) map <- body of the newest frame, in the frame of the map's source


@dataclass(frozen=True)
class Place:
    """A world's name, its kind in words, the file of its map's cloud, and the drives through it: each a query."""

    name: str
    kind: str
    base: Path
    drives: list[Drive]


def drawn(folder: Path, seed: int, queries: int) -> Place:
    """Return the world of a seed, simulated now unless ``folder`` has it."""
    recipe, out = Recipe(submaps=queries), folder / f"drawn-{seed}-{queries}"
    spec = {"seed": seed, "recipe": asdict(recipe), "code": fingerprint(*WORLDS)}
    kind = str(remembered(out / "drawn.json", spec, lambda: _simulate(out, seed, recipe))["kind"])
    return Place(f"seed {seed}", kind, out / "base.npy", [_read(out / f"drive-{k}.npz") for k in range(queries)])


def _simulate(out: Path, seed: int, recipe: Recipe) -> dict[str, Any]:
    out.mkdir(parents=True, exist_ok=True)
    world, rng = draw_world(seed, recipe), np.random.default_rng([seed, _LEANING])
    np.save(out / "base.npy", base_scan(world, seed, recipe)[0])
    for k, (sensor, frames) in enumerate(drives(world, seed, recipe)):
        lean = np.radians(recipe.draw(rng, "gravity_error")) * rng.normal(size=2)
        leaning = pose_from(exp_so3(np.array([*lean, 0.0])), np.zeros(3))
        clouds = [cloud.astype(np.float32) for cloud in frames.clouds]
        about = {"sensor": sensor, "travelled": frames.travelled, "truth": frames.truth[-1]}
        np.savez(out / f"drive-{k}.npz", *clouds, odometry=leaning @ frames.odometry, **about)
    return {"kind": world.kind}


def _read(file: Path) -> Drive:
    with np.load(file, allow_pickle=False) as of:
        odometry = of["odometry"]
        clouds = tuple(of[f"arr_{k}"] for k in range(len(odometry)))
        return Drive(str(of["sensor"]), float(of["travelled"]), odometry, clouds, of["truth"])


def base_of(directory: Path) -> Path:
    """Return the map's cloud of a world on disk; ``InputError`` without one."""
    for name in ("base.laz", "base.las"):
        if (directory / name).is_file():
            return directory / name
    raise InputError(f"{directory}: no base.laz or base.las; name a folder as 'coview-stream simulate' makes it")


def recorded(directory: Path, most: int) -> Place:
    """Read a world on disk (base, run/frames, run/odometry.tum, truth.tum); at most ``most`` queries, spread."""
    run = open_run(directory / "run")
    stamps, poses = read_tum(directory / "truth.tum")
    way = driven(run.poses)
    about = directory / "world.json"
    sensor = json.loads(about.read_text()).get("sensor", "unknown") if about.is_file() else "unknown"
    found = []
    for end in _ends(way, most):
        nearest = int(np.abs(stamps - run.stamps[end]).argmin())
        if abs(stamps[nearest] - run.stamps[end]) < MAX_STAMP_GAP:
            chosen = _frames_behind(way, end)
            clouds = tuple(run.read(k).points for k in chosen)
            travelled = float(way[end] - way[chosen[0]])
            found.append(Drive(str(sensor), travelled, run.poses[chosen], clouds, poses[nearest]))
    return Place(directory.name, "on disk", base_of(directory), found)


def _ends(way: Floats, most: int) -> list[int]:
    """Frames at which queries end: every ten of the metres (N,) that were driven, the first after twelve."""
    marks = np.arange(min(BEHIND, way[-1]), way[-1] + 1e-6, EVERY)
    ends = np.unique(np.minimum(np.searchsorted(way, marks - 1e-6), len(way) - 1))
    if len(ends) > most:
        ends = ends[np.unique(np.linspace(0, len(ends) - 1, most).round().astype(int))]
    return [int(end) for end in ends]


def _frames_behind(way: Floats, end: int) -> list[int]:
    """Frames of the last twelve metres, a quarter of a metre apart or more; the last one is ``end``."""
    chosen = [end]
    for k in range(end - 1, -1, -1):
        if way[end] - way[k] > BEHIND + 1e-3:
            break
        if way[chosen[-1]] - way[k] >= _SPACING:
            chosen.append(k)
    return chosen[::-1]


def in_odometry(drive: Drive) -> tuple[Floats, Pose]:
    """Odometry (F, 4, 4) about the newest position, and the true pose (4, 4) of that frame: map <- odometry."""
    told = drive.odometry.copy()
    told[:, :3, 3] -= drive.odometry[-1, :3, 3]
    return told, drive.truth @ inverse(told[-1])
