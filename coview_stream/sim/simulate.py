"""A simulated world on disk: a base map, a run of a robot, and the truth.

OUT/base.laz                   airborne scan, map frame; for a depot also terrestrial scans of its hall
OUT/run/frames/000000.pcd ...  deskewed frames, sensor frame (body frame without a mount)
OUT/run/odometry.tum           odom <- body, drifting
OUT/sweeps                     in a world with motion, a ROS recording with the raw sweeps and more odometry
OUT/truth.tum                  map <- body
OUT/world.json                 the configuration, and counts of points and frames
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from coview_stream.clouds.files import write_cloud
from coview_stream.clouds.progress import Progress, progress_bar
from coview_stream.clouds.trajectory import write_tum
from coview_stream.config.checks import within
from coview_stream.config.mount import Mount
from coview_stream.errors import ConfigError, InputError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, pose_from, transform
from coview_stream.sim.airborne import airborne_scan
from coview_stream.sim.dirt.config import Dirt
from coview_stream.sim.dirt.scan import Recording, Scanner, Stream, seasonal_caster, stream
from coview_stream.sim.dirt.scene import aged, drawn_parts
from coview_stream.sim.dirt.survey import Thinning, spoilt_strips
from coview_stream.sim.kinds import KINDS
from coview_stream.sim.odometry import OdometryConfig, drifting_odometry, drive
from coview_stream.sim.scenes import Footprint, Scene, build_scene
from coview_stream.sim.sensors import FRAME_PERIOD, SENSORS, Caster, MeshCaster


@dataclass(frozen=True)
class SimulationConfig:
    """Configuration of a world and a drive through it.

    Raises:
        ConfigError: unknown scene or sensor, or a value out of its range.
    """

    scene: str = "town"  # town, campus, village, industrial, depot or forest
    sensor: str = "vlp16"  # vlp16, vlp16-inclined, os64, os64-2048, mid360, bpearl or blk360
    seed: int = 1  # of all random numbers; equal configurations give equal files
    size: float = 240.0  # side of the square map, metres
    length: float = 80.0  # distance driven, metres
    density: float = 20.0  # airborne pulses per square metre
    changed: float = 0.0  # share of the trees, cars and poles that were replaced since the map was made
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)  # added to all map coordinates, metres (a UTM-like offset)
    speed: float = 1.5  # of the robot, metres per second
    height: float = 1.5  # of the body above the ground, metres; a mount adds its z for the sensor
    odometry: OdometryConfig = field(default_factory=OdometryConfig)  # errors of the odometry
    dirt: Dirt = field(default_factory=Dirt)  # further imperfections; none by default
    drive_seed: int = 0  # of the drive, its scans and its odometry; another seed is another run in the same world
    mount: Mount = field(default_factory=Mount)  # of the sensor on the body

    def __post_init__(self) -> None:
        for name, choices in (("scene", KINDS), ("sensor", SENSORS)):
            value = getattr(self, name)
            if value not in choices:
                raise ConfigError(f"{name}: {value!r} is unknown; use one of {', '.join(choices)}")
        within(
            self,
            seed=(0, 2**31 - 1),
            drive_seed=(0, 2**31 - 1),
            size=(80.0, 2000.0),
            length=(0.0, 10_000.0),
            density=(0.5, 200.0),
            changed=(0.0, 1.0),
            speed=(0.1, 30.0),
            height=(0.3, 5.0),
        )
        if len(self.origin) != 3 or not all(abs(value) <= 1e7 for value in self.origin):
            raise ConfigError(f"origin: {self.origin!r} is not an offset; give x y z in metres, up to 10,000 km")

    def to_dict(self) -> dict[str, Any]:
        """Return all fields as plain values, for JSON; ``dirt``, ``drive_seed`` and ``mount`` only if set."""
        values = asdict(self) | {"dirt": self.dirt.to_dict()}
        if not self.dirt.kinds:
            del values["dirt"]
        if not self.drive_seed:
            del values["drive_seed"]
        if self.mount == Mount():
            del values["mount"]
        return values


_FIRST_STAMP = 1000.0  # seconds
_AIRBORNE, _DRIVE, _SENSOR, _ODOMETRY, _INDOORS = range(100, 105)  # random streams; the scene uses lower numbers


@dataclass(frozen=True)
class Simulated:
    """World written by :func:`simulate`: directory, base points, frames of the run, and metres driven."""

    directory: Path
    base_points: int
    frames: int
    distance: float


def simulate(
    out: str | os.PathLike[str],
    config: SimulationConfig | None = None,
    *,
    progress: bool = False,
    overwrite: bool = False,
) -> Simulated:
    """Write a simulated world to the directory ``out``, atomically.

    ``progress`` draws a bar on stderr. ``overwrite`` replaces an earlier simulated world, but no directory with other
    files.

    Raises:
        InputError: ``out`` exists and is not empty, or cannot be written.
    """
    config = config or SimulationConfig()
    out = Path(out)
    with _staging(out, overwrite) as staging:
        scene = scene_of(config)
        with progress_bar("airborne scan", progress) as step:
            base = base_map(scene, config, step)
        write_cloud(staging / "base.laz", base, origin=config.origin)
        stamps, truth, odometry = trajectories(scene, config)
        (staging / "run" / "frames").mkdir(parents=True)
        still = config.dirt.motion is None or SENSORS[config.sensor]().stop
        with (
            nullcontext() if still else Recording(staging / "sweeps") as recording,
            progress_bar("drive", progress, "frame") as step,
        ):
            for k, points in enumerate(frames(scene, config, truth, odometry, recording)):
                write_cloud(staging / "run" / "frames" / f"{k:06d}.pcd", points)
                step(k + 1, len(truth))
        write_tum(staging / "run" / "odometry.tum", stamps, odometry)
        in_map = truth.copy()
        in_map[:, :3, 3] += config.origin
        write_tum(staging / "truth.tum", stamps, in_map)
        distance = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
        facts = {"base_points": len(base), "frames": len(truth), "distance": round(distance, 2)}
        (staging / "world.json").write_text(json.dumps(config.to_dict() | facts, indent=1) + "\n")
    return Simulated(out, len(base), len(truth), distance)


def scene_of(config: SimulationConfig) -> Scene:
    """Draw the scene, with the changes since the survey."""
    scene = build_scene(config.scene, config.seed, config.size, config.changed)
    years = config.dirt.years
    return scene if years is None else aged(scene, years, _dirt_stream(config, Stream.YEARS))[0]


def base_map(scene: Scene, config: SimulationConfig, step: Progress | None = None) -> Floats:
    """Scan the scene from the air: (N, 3) float64 metres, scene frame (without ``config.origin``)."""
    dirt = config.dirt
    caster: MeshCaster = Caster(scene.mapped)
    if dirt.seasons is not None:
        caster = seasonal_caster(drawn_parts(scene)[0], scene, dirt.seasons)
    density = config.density if dirt.density is None else dirt.density.most
    scanned = airborne_scan(caster, config.size, density, _stream(config, _AIRBORNE))
    if dirt.strips is not None or dirt.density is not None:
        uneven = _dirt_stream(config, Stream.DENSITY)
        thinning = None if dirt.density is None else Thinning(dirt.density, uneven)
        scanned = spoilt_strips(scanned, dirt.strips, thinning, _dirt_stream(config, Stream.STRIPS))
    strips = []
    for done, points in scanned:
        strips.append(points)
        if step is not None:
            step(int(100 * done), 100)
    if scene.passage is not None:
        strips.append(_indoors(scene, scene.passage, _stream(config, _INDOORS)))
    return np.concatenate(strips)


def _indoors(scene: Scene, hall: Footprint, rng: np.random.Generator) -> Floats:
    """Scan a hall from inside and in front of its gates, as walls have two sides: (N, 3) float64, scene frame."""
    scanner, caster = SENSORS["blk360"](), Caster(scene.mapped)
    ahead = np.array([np.cos(hall.yaw), np.sin(hall.yaw)])
    clouds = []
    for along in [-0.5 * hall.w - 8.0, *(np.arange(-0.4, 0.41, 0.2) * hall.w), 0.5 * hall.w + 8.0]:
        x, y = (hall.x, hall.y) + along * ahead
        T = pose_from(np.eye(3), [x, y, scene.site.height(x, y) + 1.5])
        cloud = transform(T, scanner.scan(caster, T, 0, rng).astype(np.float64))
        clouds.append(cloud[hall.holds(cloud[:, :2], 1.0)])
    return np.concatenate(clouds)


def trajectories(scene: Scene, config: SimulationConfig) -> tuple[Floats, Floats, Floats]:
    """Return stamps (N,) in seconds, true poses ``T_scene_body`` (N, 4, 4) and odometry ``T_odom_body`` (N, 4, 4).

    A robot that stops to scan has one of each per stop.
    """
    moving = _seconds(config)[0]
    truth = drive(scene, config.length, config.speed, config.height, _stream(config, _DRIVE), moving)
    odometry = drifting_odometry(truth, config.odometry, _stream(config, _ODOMETRY))
    stamps = _stamps(config, len(truth))
    dirt = config.dirt
    if dirt.odometry is not None:
        odometry = dirt.odometry.apply(odometry, _dirt_stream(config, Stream.ODOMETRY))
    if dirt.slip is not None:
        odometry = dirt.slip.apply(odometry, _dirt_stream(config, Stream.SLIP))
    if dirt.gravity is not None:
        odometry = dirt.gravity.apply(odometry, stamps, _dirt_stream(config, Stream.GRAVITY))
    return stamps, truth, odometry


def frames(
    scene: Scene,
    config: SimulationConfig,
    truth: Floats,
    odometry: Floats | None = None,
    recording: Recording | None = None,
) -> Iterator[Points]:
    """Scan the present scene from each true pose; (N, 3) float32 metres, sensor frame.

    ``odometry`` (N, 4, 4), else the truth, deskews raw sweeps; ``recording`` gets the raw sweeps if there is motion.
    """
    sensor = SENSORS[config.sensor]()
    if config.dirt.on_sensor:
        scanner = Scanner(scene, sensor, config.dirt, config.height, partial(_dirt_stream, config), config.mount)
        stamps = _stamps(config, len(truth))
        yield from scanner.frames(stamps, truth, truth if odometry is None else odometry, recording)
        return
    caster, rng = Caster(scene.now), _stream(config, _SENSOR)
    T: Pose
    for k, T in enumerate(truth):
        yield sensor.scan(caster, T @ config.mount.T_body_sensor, k, rng)


def _seconds(config: SimulationConfig) -> tuple[float, float]:
    """Return the seconds that the robot drives and stands between frames."""
    sensor = SENSORS[config.sensor]()
    return (sensor.stop / config.speed, sensor.stand) if sensor.stop else (FRAME_PERIOD, 0.0)


def _stamps(config: SimulationConfig, count: int) -> Floats:
    return _FIRST_STAMP + sum(_seconds(config)) * np.arange(count, dtype=np.float64)


def _dirt_stream(config: SimulationConfig, purpose: Stream) -> np.random.Generator:
    return stream(config.seed, config.dirt.seed, purpose)


def _stream(config: SimulationConfig, purpose: int) -> np.random.Generator:
    of_map = purpose in (_AIRBORNE, _INDOORS)
    apart = [config.drive_seed] if config.drive_seed and not of_map else []
    return np.random.default_rng([config.seed, purpose, *apart])


@contextmanager
def _staging(out: Path, overwrite: bool) -> Iterator[Path]:
    """Yield a directory next to ``out``, renamed to ``out`` on success and removed on an error."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; name a new directory")
    ours = (out / "world.json").is_file()
    if out.exists() and any(out.iterdir()) and not (overwrite and ours):
        remedy = "pass --overwrite to replace it" if ours else "name a new or empty directory"
        raise InputError(f"{out}: is not empty; {remedy}")
    staging = out.with_name(f".{out.resolve().name}.{os.getpid()}.tmp")
    try:
        staging.mkdir(parents=True)
        yield staging
        if out.exists():
            shutil.rmtree(out)
        staging.rename(out)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{out}: cannot be written ({reason}); check the path and the disk") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)
