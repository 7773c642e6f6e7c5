"""Whole runs through a forest, on disk as ``coview-stream simulate`` writes them: its own forests, and drawn stands.

The simulator's forests have a track that the robot follows. In the stands of the training simulator it finds its way
between the trees, and the inclined rotating lidar can be driven as well; their seeds were never trained on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.forest.common import WORLDS
from bench.harness.worlds import fingerprint, remembered
from coview_stream.learn.recipe import Recipe
from coview_stream.sim import SimulationConfig

Floats = npt.NDArray[np.float64]

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
    from coview_stream.learn.rotating import trained_sensor
    from coview_stream.learn.worlds import base_scan, draw_world
    from coview_stream.sim.caster import Caster
    from coview_stream.sim.odometry import OdometryConfig, drifting_odometry
    from coview_stream.sim.sensors import FRAME_PERIOD

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
    from coview_stream.geometry import pose_from, rot_z
    from coview_stream.rotation import exp_so3

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
