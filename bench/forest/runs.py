"""Whole runs in forests, searched by the paper's descriptors, by learned features, and by both; and outside the map.

In the usual worlds, whose seeds were never trained on, or in those that ``--world`` names, each also on the map of the
next. The simulator's own forests have a track; in the training simulator's stands the robot finds its way.
"""

from __future__ import annotations

import json
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench.accuracy.scores import Track, errors, rms
from bench.forest.forest import NEAR
from bench.forest.worlds import WORLDS, base_of, code, on_disk, place, say, weights
from bench.harness.files import fingerprint, remembered
from bench.harness.rows import Row, failed, informs, listed
from coview_stream import BaseMap
from coview_stream.clouds import read_tum, write_cloud, write_tum
from coview_stream.config import LocalizerConfig, Reloc
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import exp_so3, pose_from, rot_z
from coview_stream.localization.offline import locate
from coview_stream.recordings.open_run import open_run
from coview_stream.report.evaluation import driven
from coview_stream.sim import SimulationConfig, simulate
from coview_stream.sim.odometry import OdometryConfig, drifting_odometry
from coview_stream.sim.sensors import FRAME_PERIOD, Caster
from coview_stream.training.recipe import Recipe
from coview_stream.training.sensors import trained_sensor
from coview_stream.training.worlds import base_scan, draw_world

Run = dict[str, Any]

MODES: tuple[Reloc, ...] = ("coview", "learned", "auto")

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

    @property
    def name(self) -> str:
        """Name of the world's directory."""
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


def world_of(run: Through) -> Path:
    """Return the directory of a run's world, simulated now unless it is there."""
    out = place() / run.name

    def make() -> None:
        if run.drawn:
            _drive_stand(out, run)
        else:
            size = 240.0 if run.length <= 150.0 else 320.0
            config = SimulationConfig("forest", run.sensor, run.seed, size, run.length, changed=0.1, speed=2.0)
            simulate(out, config, overwrite=True)

    spec = {"run": asdict(run), "code": fingerprint(*WORLDS, "bench/forest/runs.py")}
    remembered(place() / f"{run.name}.json", spec, make)
    return out


def _drive_stand(out: Path, run: Through) -> None:
    """Write a drive through a drawn stand; the way is shorter than asked where the trees leave none."""
    world, rng = draw_world(run.seed, _STAND), np.random.default_rng([run.seed, _PATH])
    frames = out / "run" / "frames"
    frames.mkdir(parents=True, exist_ok=True)
    for old in frames.iterdir():
        old.unlink()
    write_cloud(out / "base.laz", base_scan(world, run.seed, _STAND)[0].astype(np.float64))
    ways: list[Floats] = [world.path(rng, world.size / 2 - 30.0, run.length) for _ in range(8)]
    truth = _poses(max(ways, key=len), _SPEED * FRAME_PERIOD * _EVERY, world.ground, rng)
    caster, sensor = Caster(world.now, threads=1, leaf_depth=0.3), trained_sensor(run.sensor)
    for k, T in enumerate(truth):
        write_cloud(frames / f"{k:06d}.pcd", sensor.scan(caster, T, _EVERY * k, rng))
    stamps: Floats = 1000.0 + FRAME_PERIOD * _EVERY * np.arange(len(truth), dtype=np.float64)
    write_tum(out / "run" / "odometry.tum", stamps, drifting_odometry(truth, OdometryConfig(), rng))
    write_tum(out / "truth.tum", stamps, truth)
    (out / "world.json").write_text(json.dumps({"scene": world.kind, "sensor": run.sensor, "seed": run.seed}))


def _poses(path: Floats, step: float, ground: Any, rng: np.random.Generator) -> Floats:
    """Poses (K, 4, 4) along a path (N, 2), ``step`` metres apart, 1.5 m above the ground, swaying a little."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.arange(0.0, way[-1], step)
    x, y = (np.interp(at, way, path[:, k]) for k in range(2))
    heading = np.arctan2(np.gradient(y), np.gradient(x))
    z = ground(x, y) + 1.5
    roll, pitch = rng.normal(0.0, np.radians(0.5), (len(at), 2)).T
    lean = exp_so3(np.column_stack([roll, pitch - np.arctan(np.gradient(z) / step), np.zeros(len(at))]))
    return np.array([pose_from(rot_z(h) @ R, p) for h, R, p in zip(heading, lean, np.stack([x, y, z], 1), strict=True)])


def _map_of(world: Path) -> Path:
    """Return the map of a world with learned features, built now unless it is there, in the benchmark's folder."""
    out = place() / f"{world.resolve().parent.name}-{world.name}.coview"
    spec = {"code": code(), "weights": weights(), **on_disk(world)}
    remembered(out.with_suffix(".built.json"), spec, lambda: BaseMap.build(base_of(world), learned=True).save(out))
    return out


def followed(world: Path, site: Path, reloc: Reloc) -> tuple[Track, Floats]:
    """Localize the run of a world on a map; return the track and the true poses (N, 4, 4)."""
    stamps, truth = read_tum(world / "truth.tum")
    located = locate(BaseMap.load(site), open_run(world / "run"), LocalizerConfig(reloc=reloc))
    track = Track.of(located.fixes, np.array([fix.stamp for fix in located.fixes]))
    return track, truth[np.abs(stamps[:, None] - track.stamps[None]).argmin(axis=0)]


def scored(track: Track, truth: Floats, outside: bool) -> Run:
    """Figures of one run; outside the map every pose is a false one."""
    error, known, way = errors(track, truth), track.tracking, driven(truth)
    wrong = known & ((error.metres > NEAR[0]) | (error.degrees > NEAR[1]) | outside)
    right, first = known & ~wrong, int(np.argmax(known)) if known.any() else None
    return {
        "first_fix_m": None if first is None else float(way[first]),
        "posed": 100 * float(known.mean()),
        "rmse_m": rms(error.metres[right]),
        "false": int(wrong.sum()),
    }


def options(parser: ArgumentParser) -> None:
    """Add worlds on disk."""
    parser.add_argument("--world", type=Path, nargs="+", default=[], metavar="DIR", help="instead of the usual runs")


Job = tuple[str, Callable[[], Path], Any]  # name, what opens the world, and what else its results depend on


def rows(asked: Namespace) -> Iterator[Row]:
    """Localize all runs in all modes, each also on the map of the next if there is one."""
    place().mkdir(parents=True, exist_ok=True)
    few = [replace(run, length=min(run.length, 40.0)) for run in RUNS[1:4:2]] if asked.quick else RUNS
    jobs: list[Job] = [(path.name, partial(Path, path), on_disk(path)) for path in asked.world]
    jobs = jobs or [(run.name, partial(world_of, run), asdict(run)) for run in few]
    for k, job in enumerate(jobs):
        for site in dict.fromkeys((k, (k + 1) % len(jobs))):
            label = job[0] if site == k else f"{job[0]} on {jobs[site][0]}"
            for reloc in MODES:
                name = f"forest_runs/{label}, {reloc}"
                wanted = {
                    "runs": [job[2], jobs[site][2]], "weights": weights(), "code": fingerprint(),
                    "bench": fingerprint(*WORLDS, "bench/forest/runs.py", "bench/accuracy/scores.py"),
                }  # fmt: skip
                file = place() / "runs" / f"{label.replace(' ', '-')}-{reloc}.json"
                try:
                    run = remembered(file, wanted, partial(measured, job, jobs[site], reloc))
                except Exception as error:  # the other runs are still worth having; the exit code tells
                    yield failed(name, f"{type(error).__name__}: {error}")
                    continue
                say(name)
                yield informs(f"{name}: false", run["false"], "", {"run": label, "reloc": reloc, **run})


def measured(world: Job, site: Job, reloc: Reloc) -> Run:
    """Localize the run of a world on the map of another, or its own, and score it."""
    return scored(*followed(world[1](), _map_of(site[1]()), reloc), outside=world is not site)


COLUMNS = (
    ("run", "run", None), ("reloc", "reloc", None), ("first fix m", "first_fix_m", 1), ("posed %", "posed", 0),
    ("RMSE m", "rmse_m", 3), ("false", "false", 0),
)  # fmt: skip


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """One line per run, map and mode."""
    return {"": listed(COLUMNS, [row.details for row in rows if row.details])}
