"""A run: a localizer gets frames and odometry until its first fix or the drive's end; runs in several processes."""

from __future__ import annotations

import fcntl
import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.harness.files import fingerprint, remembered, thread_settings
from bench.integrity.kinds import built, draw, size_of, surveyed
from bench.integrity.plan import STATED, Run, Site
from bench.integrity.sites import beside_border, lane, rebuilt, shifted
from coview_stream import BaseMap, Localizer
from coview_stream.config import LocalizerConfig
from coview_stream.errors import CloudError, RunError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, inverse, pose_from, rotation_angle
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.result import Fix
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.recognizers import SearchIndex
from coview_stream.sim.odometry import OdometryConfig, drifting_odometry
from coview_stream.sim.odometry import drive as poses_along
from coview_stream.sim.scenes import Scene
from coview_stream.sim.sensors import FRAME_PERIOD, SENSORS, Caster

Result = dict[str, Any]

SPEED = 4.0
SPEEDS = {"storey": 1.5}
"""Metres per second: a frame every 0.4 m; slower inside a building."""

HEIGHT = 1.5  # metres, of the sensor above the ground
FIRST_STAMP = 1000.0  # seconds
LENGTH = 60.0
"""Metres after which a run ends without a fix."""

_DRIVE, _ODOMETRY, _SENSOR = range(200, 203)  # random streams
_MIRROR_WORLD, _MIRROR_BODY = np.diag([-1.0, 1.0, 1.0]), np.array([1.0, -1.0, 1.0])


class World(NamedTuple):
    """The robot's world, as a change of the mapped scene."""

    poses: Callable[[Floats], Floats] = lambda poses: poses  # (N, 4, 4) scene <- body, to poses with z up for odometry
    cloud: Callable[[Points], Points] = lambda points: points  # (K, 3) body frame, scene to world
    right: bool = True  # the scene's pose is right on the map; False: every pose is wrong


AS_MAPPED = World()


def mirrored() -> World:
    """Return the mirrored world: no pose on the map is right."""

    def poses(scene: Floats) -> Floats:
        out = scene.copy()
        out[:, :3, :3] = _MIRROR_WORLD @ scene[:, :3, :3] * _MIRROR_BODY  # two mirrors: a rotation again
        out[:, :3, 3] = scene[:, :3, 3] @ _MIRROR_WORLD
        return out

    return World(poses, lambda points: (points * _MIRROR_BODY).astype(np.float32), right=False)


def scaled(factor: float) -> World:
    """Return a world whose map is ``factor`` times too large; the scaled pose is right."""

    def poses(scene: Floats) -> Floats:
        out = scene.copy()
        out[:, :3, 3] /= factor
        return out

    return World(poses, lambda points: points / np.float32(factor))


def tilted(angle: float, heading: float) -> World:
    """Return a world whose map is tilted by ``angle`` radians about a level axis; the tilted pose is right."""
    axis = np.array([np.cos(heading), np.sin(heading), 0.0])
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    T = np.eye(4)
    T[:3, :3] += np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    return World(lambda scene: T @ scene)


@dataclass(frozen=True)
class Drive:
    """Poses, odometry, truth and clouds of a drive."""

    poses: Floats  # (N, 4, 4) scene <- body
    odometry: Floats  # (N, 4, 4) odom <- body
    truth: Floats | None  # (N, 4, 4) map <- body; None where every fix is false
    frame: Callable[[int], Points]  # number -> cloud (K, 3), body frame, metres; call in ascending order

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def stamps(self) -> Floats:
        """(N,) seconds."""
        return FIRST_STAMP + FRAME_PERIOD * np.arange(len(self), dtype=np.float64)

    @property
    def driven(self) -> Floats:
        """(N,) metres since the first frame."""
        steps = np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])


def through(
    scene: Scene,
    sensor: str,
    seed: int,
    length: float = LENGTH,
    route: Floats | None = None,
    world: World = AS_MAPPED,
    known: bool = True,
) -> Drive:
    """Drive on a scene's route, or another closed ``route`` (N, 2), from anywhere on it, in either direction.

    Without ``known`` the map is of another place: no pose is right.
    """

    def rng(stream: int) -> np.random.Generator:
        return np.random.default_rng([seed, stream])

    on = scene if route is None else replace(scene, route=route)
    poses = poses_along(on, length, SPEEDS.get(scene.kind, SPEED), HEIGHT, rng(_DRIVE))
    odometry = drifting_odometry(world.poses(poses), OdometryConfig(), rng(_ODOMETRY))
    lidar, noise, casters = SENSORS[sensor](), rng(_SENSOR), list[Caster]()

    def frame(k: int) -> Points:
        if not casters:
            casters.append(Caster(scene.now, threads=1))
        return world.cloud(lidar.scan(casters[0], poses[k], k, noise))

    return Drive(poses, odometry, poses if known and world.right else None, frame)


NEAR_METRES, NEAR_DEGREES = 3.0, 5.0
"""Errors from which on a first fix is false; the project's for all runs."""

SHIFT = 4.0  # metres, of all buildings
_ALTERATION, _REBUILT = 240, 241  # random streams


def drive_of(run: Run) -> Drive | None:
    """Return the drive of a run, with its truth; None where its site has no such way."""
    kind, seed = (run.driven, run.drive_seed) if run.driven else (run.kind, run.seed)
    scene = draw(kind, seed, size_of(kind), run.changed)
    if run.rebuilt:
        scene = rebuilt(scene, run.drive_seed, run.rebuilt)
    scene, world = _altered(run, scene)
    route = None
    if run.family == "edge":
        route = beside_border(scene, run.drive_seed, run.beyond)
        if route is None:
            return None
    elif run.kind == "boxes":
        route = lane(scene, run.drive_seed, across=bool((run.seed // 2 + run.number) % 2))
    known = not run.driven and run.family != "storey"
    return through(scene, run.sensor, run.drive_seed, route=route, world=world, known=known)


def _altered(run: Run, scene: Scene) -> tuple[Scene, World]:
    rng = np.random.default_rng([run.drive_seed, _ALTERATION])
    sign, angle = rng.choice([-1.0, 1.0]), rng.uniform(0.0, 2 * np.pi)
    if run.family == "shifted":
        return shifted(scene, SHIFT * np.array([np.cos(angle), np.sin(angle)])), AS_MAPPED
    if run.family == "mirrored":
        return scene, mirrored()
    if run.family == "scaled":
        return scene, scaled(1.0 + sign * rng.uniform(0.03, 0.05))
    if run.family == "tilted":
        return scene, tilted(np.radians(rng.uniform(2.0, 4.0)), angle)
    return scene, AS_MAPPED


@dataclass(frozen=True)
class Robot:
    """A localizer, and the search that answers its requests and shows each keyframe's leader."""

    localizer: Localizer
    search: GlobalSearch
    origin: Floats  # (3,) of the map, metres

    @classmethod
    def on(cls, base: BaseMap, risk: float | None) -> Robot:
        """Return one on a map, with the usual integrity risk or another one."""
        config = LocalizerConfig()
        if risk is not None:
            config = replace(config, acceptance=replace(config.acceptance, risk=risk))
        maps, index = LocalMaps(base, config.registration.source_range), SearchIndex.of(base, config)
        localizer = Localizer(base, config, maps, index)
        localizer.prepare()
        return cls(localizer, GlobalSearch(base, config, maps, index), base.origin)

    def step(self, cloud: Points, T_odom_body: Pose, stamp: float) -> tuple[Fix, Leader | None]:
        """Do as :meth:`Localizer.step` does; return the search's leader as well, if there was a search."""
        request = self.localizer.add_frame(cloud, T_odom_body, stamp)
        leader = None
        if request is not None:
            result = self.search.update(request)
            self.localizer.apply_search_result(result)
            if result.leader is not None and result.evidence.confidence is not None:
                T = result.leader @ request.T_odom_body
                leader = Leader(1.0 - result.evidence.confidence, pose_from(T[:3, :3], T[:3, 3] + self.origin))
        return self.localizer.fix(), leader


class Leader(NamedTuple):
    """The most probable place of a keyframe, accepted or not: its stated error, and the robot's pose there."""

    error: float
    T_map_body: Pose


def first_fix(robot: Robot, drive: Drive) -> Result:
    """Follow a drive to its first fix; return outcome, last reason and stated errors.

    ``stated`` has for each limit of :data:`STATED` the first keyframe below it: its error, the metres driven, and
    whether its most probable place was right.
    """
    robot.localizer.reset()
    said, way, stated = "", drive.driven, dict[str, Result]()
    out: Result = {"outcome": "none", "state": robot.localizer.state.value, "stated": stated}
    for k, stamp in enumerate(drive.stamps):
        cloud = drive.frame(k)
        try:
            fix, leader = robot.step(cloud, drive.odometry[k], float(stamp))
        except (CloudError, RunError):
            continue
        truth = None if drive.truth is None else drive.truth[k]
        if leader is not None:
            right = judged(leader.T_map_body, truth)["outcome"] == "right"
            new = {"error": leader.error, "metres": round(float(way[k]), 2), "right": right}
            stated |= {f"{e:g}": new for e in STATED if leader.error < e and f"{e:g}" not in stated}
        said = fix.evidence.reason if fix.evidence is not None else said
        out |= {"state": fix.state.value, "reason": said, "metres": round(float(way[k]), 2), "frames": k + 1}
        if fix.T_map_body is not None:
            out |= judged(fix.T_map_body, truth)
            out |= {"risk": float(1.0 - fix.confidence), "seconds": round(float(stamp - drive.stamps[0]), 2)}
            break
    return out


def judged(T_map_body: Pose, truth: Pose | None) -> Result:
    """Compare a first fix with the only right pose, or with none."""
    if truth is None:
        return {"outcome": "false"}
    off = inverse(truth) @ T_map_body
    metres, degrees = float(np.linalg.norm(off[:3, 3])), float(np.degrees(rotation_angle(off)))
    right = metres < NEAR_METRES and degrees < NEAR_DEGREES
    errors = {"error_m": round(metres, 3), "error_deg": round(degrees, 3)}
    return {"outcome": "right" if right else "false", **errors}


def append(file: Path, result: Result) -> None:
    """Add a line; others may do so at the same time."""
    file.parent.mkdir(parents=True, exist_ok=True)
    line = json.dumps(result, allow_nan=False) + "\n"
    with file.open("a") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        stream.write(line)
        stream.flush()


def read(files: Iterable[Path], code: str) -> dict[str, Result]:
    """Return the newest result of each key that the code with this fingerprint made.

    A line that a killed process has left half-written is passed over.
    """
    found: dict[str, Result] = {}
    for file in files:
        for line in file.read_text().splitlines() if file.is_file() else ():
            try:
                result = json.loads(line)
            except ValueError:
                continue
            if code == result["code"]:
                found[result["key"]] = result
    return found


SITE_CODE = ("coview_stream/sim", "coview_stream/basemap", "coview_stream/clouds", "coview_stream/descriptors")
"""What makes a map, besides this benchmark."""


@dataclass(frozen=True)
class Task:
    """Settings of the runs and the file of their results."""

    results: Path
    code: str  # fingerprint in every result
    risk: float | None = None  # integrity risk; None: the product's own
    maps: Path | None = None  # folder that keeps the maps; None: they are deleted

    def key(self, run: Run) -> str:
        """Name of a run's result."""
        return run.key if self.risk is None else f"{run.key}@{self.risk:g}"


def everywhere(sites: Sequence[Site], task: Task, jobs: int) -> Iterator[Result]:
    """Yield results as they come, of ``jobs`` processes with one thread each; results are noted by then."""
    os.environ.update(thread_settings(1))  # what is started from now on inherits it
    with ProcessPoolExecutor(max(1, min(jobs, len(sites))), mp_context=get_context("spawn")) as pool:
        waiting = [pool.submit(on_site, site, task) for site in sites]
        try:
            for done in as_completed(waiting):
                yield from done.result()
        finally:
            pool.shutdown(cancel_futures=True)


def on_site(site: Site, task: Task) -> list[Result]:
    """Make all runs on one map; a run that raises is recorded as ``failed`` and made again next time."""
    begin, out = time.process_time(), list[Result]()
    robot, reason = None, ""
    try:
        robot = Robot.on(map_of(site[0], task.maps), task.risk)
    except Exception as error:  # whatever it is, the other sites go on
        reason = f"{type(error).__name__}: {error}"
    share = round((time.process_time() - begin) / len(site), 2)
    for run in site:
        begin = time.process_time()
        result: Result = {"outcome": "failed", "reason": reason}
        try:
            if robot is not None:
                result = _one(run, robot)
        except Exception as error:  # likewise
            result["reason"] = f"{type(error).__name__}: {error}"
        result = {"key": task.key(run), "code": task.code, "class": run.of_class, **asdict(run), **result}
        result |= {"asked_risk": task.risk, "site_s": share, "cost_s": round(time.process_time() - begin, 2)}
        append(task.results, result)
        out.append(result)
    return out


def _one(run: Run, robot: Robot) -> Result:
    drive = drive_of(run)
    return {"outcome": "no way", "reason": "no such street"} if drive is None else first_fix(robot, drive)


def map_of(run: Run, kept: Path | None = None) -> BaseMap:
    """Return the map that a run is made on, built now unless it is ``kept`` in a folder."""

    def build() -> BaseMap:
        return built(surveyed(draw(run.kind, run.seed, size_of(run.kind), 0.0), run.seed))  # changes come later

    if kept is None:
        return build()
    file = kept / f"{run.kind}-{run.seed}.coview"
    spec = {"site": [run.kind, run.seed], "code": fingerprint(*SITE_CODE, "bench/integrity")}
    remembered(file.with_suffix(".json"), spec, lambda: build().save(file))
    return BaseMap.load(file)
