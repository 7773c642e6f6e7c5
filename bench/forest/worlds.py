"""Where learned re-localization is judged: worlds of the training simulator that it never saw, and worlds on disk.

Of a drawn world the frames of each submap are kept, not the submap: what the product makes of them is measured too.
Whole runs are written as ``coview-stream simulate`` writes them: the simulator's own forests have a track that the
robot follows; in the stands of the training simulator it finds its way between the trees, and the inclined rotating
lidar can be driven as well. Their seeds were never trained on.
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.harness.files import fingerprint, folder, remembered
from coview_stream.errors import InputError
from coview_stream.geometry.rotations import exp_so3
from coview_stream.geometry.transforms import Points, Pose, inverse, pose_from
from coview_stream.sim import SimulationConfig
from coview_stream.training.recipe import Recipe

Floats = npt.NDArray[np.float64]
BEHIND = 12.0  # metres of a recorded run that a query is made of, and ...
EVERY = 10.0
"""... and between two queries of it."""

_SPACING = 0.25  # metres between the frames of a recorded run that are read
_LEANING = 3  # random stream


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
    raise InputError(
        f"{directory}: no base.laz or base.las; name a folder as 'coview-stream simulate' makes it"
    )


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
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(told[:, :3, 3], axis=0), axis=1))])
    drives = []
    for end in ends_of(way, most):
        nearest = int(np.abs(stamps - run.stamps[end]).argmin())
        if abs(stamps[nearest] - run.stamps[end]) > 0.051:
            continue
        chosen = frames_behind(way, end)
        clouds = tuple(run.read(k).points for k in chosen)
        drives.append(
            Drive(_sensor(directory), float(way[end] - way[chosen[0]]), told[chosen], clouds, poses[nearest])
        )
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


_STAND = Recipe(built=0.0, size=(200.0, 200.0), slope=(0.0, 15.0), stems=(200.0, 600.0))
_SPEED, _EVERY = 1.2, 2  # metres per second; of the sensor's frames
_PATH = 7  # random stream


@dataclass(frozen=True)
class Through:
    """A run of ``length`` metres with a sensor: through the simulator's forest, or a drawn stand (``drawn``)."""

    sensor: str
    seed: int
    length: float
    drawn: bool = False
    recipe: Recipe = field(default=_STAND)

    @property
    def name(self) -> str:
        """Directory of the world."""
        return f"{'stand' if self.drawn else 'track'}-{self.sensor}-{self.seed}"


RUNS = (
    Through("vlp16", 21_001, 300.0),
    Through("os64", 21_002, 100.0),
    Through("mid360", 21_003, 100.0),
    Through("vlp16", 21_101, 60.0, drawn=True),
    Through("os64", 21_102, 60.0, drawn=True),
    Through("mid360", 21_103, 60.0, drawn=True),
    Through("vlp16-inclined", 21_104, 60.0, drawn=True),
)
"""The usual ones."""


def world_of(folder: Path, run: Through) -> Path:
    """Return the directory of a run's world, simulated now unless it is there.

    Raises:
        DependencyError: Open3D cannot be loaded.
    """
    out = folder / run.name
    spec = {"run": asdict(run), "code": fingerprint(*WORLDS)}

    def make() -> dict[str, Any]:
        from coview_stream.sim import simulate

        if run.drawn:
            return drawn_run(out, run)
        size = 240.0 if run.length <= 150.0 else 320.0
        config = SimulationConfig("forest", run.sensor, run.seed, size, run.length, changed=0.1, speed=2.0)
        return {"driven": simulate(out, config, overwrite=True).distance}

    remembered(folder / f"{run.name}.json", spec, make)
    return out


def drawn_run(out: Path, run: Through) -> dict[str, Any]:
    """Write a drive through a drawn stand; the way is shorter than asked where the trees leave none."""
    import json

    from coview_stream.clouds import write_cloud, write_tum
    from coview_stream.sim.caster import Caster
    from coview_stream.sim.odometry import OdometryConfig, drifting_odometry
    from coview_stream.sim.sensors import FRAME_PERIOD
    from coview_stream.training.sensors import trained_sensor
    from coview_stream.training.worlds import base_scan, draw_world

    world, rng = draw_world(run.seed, run.recipe), np.random.default_rng([run.seed, _PATH])
    (out / "run" / "frames").mkdir(parents=True, exist_ok=True)
    for old in (out / "run" / "frames").iterdir():
        old.unlink()
    write_cloud(out / "base.laz", base_scan(world, run.seed, run.recipe)[0].astype(np.float64))
    path = longest(world, rng, run.length)
    step = _SPEED * FRAME_PERIOD * _EVERY
    truth = poses(path, step, world.ground, rng)
    caster, sensor = Caster(world.now, threads=1, leaf_depth=0.3), trained_sensor(run.sensor)
    for k, T in enumerate(truth):
        write_cloud(out / "run" / "frames" / f"{k:06d}.pcd", sensor.scan(caster, T, _EVERY * k, rng))
    stamps: Floats = 1000.0 + FRAME_PERIOD * _EVERY * np.arange(len(truth), dtype=np.float64)
    write_tum(out / "run" / "odometry.tum", stamps, drifting_odometry(truth, OdometryConfig(), rng))
    write_tum(out / "truth.tum", stamps, truth)
    (out / "world.json").write_text(json.dumps({"scene": world.kind, "sensor": run.sensor, "seed": run.seed}))
    return {"driven": step * (len(truth) - 1), "kind": world.kind}


def longest(world: Any, rng: np.random.Generator, length: float) -> Floats:
    """Return the longest of a few ways (N, 2) up to ``length`` metres."""
    ways: Sequence[Floats] = [world.path(rng, world.size / 2 - 30.0, length) for _ in range(8)]
    return max(ways, key=len)


def poses(path: Floats, step: float, ground: Any, rng: np.random.Generator, height: float = 1.5) -> Floats:
    """Poses (K, 4, 4) along a path (N, 2), ``step`` metres apart, ``height`` above the ground, swaying a little."""
    from coview_stream.geometry.rotations import exp_so3
    from coview_stream.geometry.transforms import pose_from, rot_z

    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.arange(0.0, way[-1], step)
    x, y = (np.interp(at, way, path[:, k]) for k in range(2))
    heading = np.arctan2(np.gradient(y), np.gradient(x))
    z = ground(x, y) + height
    sway = rng.normal(0.0, np.radians(0.5), (len(at), 2))
    slope = np.gradient(z) / step
    made = []
    for k in range(len(at)):
        lean = exp_so3(np.array([sway[k, 0], sway[k, 1] - np.arctan(slope[k]), 0.0]))
        made.append(pose_from(rot_z(float(heading[k])) @ lean, np.array([x[k], y[k], z[k]])))
    return np.array(made)


def shortened(run: Through, length: float) -> Through:
    """Return the same run, no longer than ``length`` metres."""
    return replace(run, length=min(run.length, length))


WORLDS = (
    *(f"coview_stream/{part}" for part in ("geometry", "clouds", "sim", "training")),
    "bench/forest/worlds.py",
)
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
