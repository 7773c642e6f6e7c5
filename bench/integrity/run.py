"""A run: a localizer gets frames and odometry until its first fix or the drive's end; runs in several processes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.harness.files import remembered, thread_settings
from bench.integrity.kinds import built, draw, size_of, surveyed
from bench.integrity.plan import STATED, Run, Site
from bench.integrity.sites import beside_border, lane, rebuilt, shifted
from coview_stream import BaseMap, Localizer
from coview_stream.config import LocalizerConfig
from coview_stream.errors import CloudError, RunError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, exp_so3, inverse, pose_from, rotation_angle
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


class World(NamedTuple):
    """The robot's world, as a change of the mapped scene."""

    poses: Callable[[Floats], Floats] = lambda poses: poses  # (N, 4, 4) scene <- body, to poses with z up for odometry
    cloud: Callable[[Points], Points] = lambda points: points  # (K, 3) body frame, scene to world
    right: bool = True  # the scene's pose is right on the map; False: every pose is wrong


AS_MAPPED = World()


def mirrored() -> World:
    """Return the mirrored world: no pose on the map is right."""
    world = np.diag([-1.0, 1.0, 1.0, 1.0])
    body = np.diag([1.0, -1.0, 1.0, 1.0])  # two mirrors: a rotation again
    return World(
        lambda scene: world @ scene @ body, lambda points: points * np.array([1, -1, 1], dtype=np.float32), right=False
    )


def scaled(factor: float) -> World:
    """Return a world whose map is ``factor`` times too large; the scaled pose is right."""
    size = np.ones((4, 4))
    size[:3, 3] = 1.0 / factor
    return World(lambda scene: scene * size, lambda points: points / np.float32(factor))


def tilted(angle: float, heading: float) -> World:
    """Return a world whose map is tilted by ``angle`` radians about a level axis; the tilted pose is right."""
    T = pose_from(exp_so3(angle * np.array([np.cos(heading), np.sin(heading), 0.0])), np.zeros(3))
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


class Robot:
    """A localizer on a map, and the search that answers its requests and shows the leader of a keyframe."""

    def __init__(self, base: BaseMap) -> None:
        config = LocalizerConfig()
        maps, index = LocalMaps(base, config.registration.source_range), SearchIndex.of(base, config)
        self.localizer, self.origin = Localizer(base, config, maps, index), base.origin
        self.localizer.prepare()
        self.search = GlobalSearch(base, config, maps, index)

    def step(self, cloud: Points, T_odom_body: Pose, stamp: float) -> tuple[Fix, Leader | None]:
        """Step as :meth:`Localizer.step`; return the search's leader as well, if there was a search."""
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

    ``stated`` has for each limit of :data:`STATED` the first keyframe below it: its error, and whether its most
    probable place was right.
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
            new = {"error": leader.error, "right": right}
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


def everywhere(sites: Sequence[Site], below: Path, code: str, jobs: int) -> Iterator[Result]:
    """Yield results as they come, of ``jobs`` processes with one thread each; those of a site stay ``below``."""
    os.environ.update(thread_settings(1))  # processes that start from now on inherit it
    with ProcessPoolExecutor(max(1, min(jobs, len(sites))), mp_context=get_context("spawn")) as pool:
        waiting = [pool.submit(on_site, site, below, code) for site in sites]
        try:
            for done in as_completed(waiting):
                yield from done.result()
        finally:
            pool.shutdown(cancel_futures=True)


def on_site(site: Site, below: Path, code: str) -> list[Result]:
    """Make all runs on one map unless they are there; runs of a site with a ``failed`` one are made again next time."""
    file = below / f"{site[0].kind}-{site[0].seed}.json"

    def make() -> dict[str, Any]:
        robot = Robot(map_of(site[0]))
        return {"runs": [{"key": run.key, "class": run.of_class, **asdict(run), **made(run, robot)} for run in site]}

    try:
        results: list[Result] = remembered(file, {"runs": list(map(asdict, site)), "code": code}, make)["runs"]
    except Exception as error:  # the other sites go on
        failed = {"outcome": "failed", "reason": f"{type(error).__name__}: {error}"}
        return [{"key": run.key, "class": run.of_class, **asdict(run), **failed} for run in site]
    if any(result["outcome"] == "failed" for result in results):
        file.unlink()
    return results


def made(run: Run, robot: Robot) -> Result:
    """Make one run."""
    try:
        drive = drive_of(run)
        return {"outcome": "no way", "reason": "no such street"} if drive is None else first_fix(robot, drive)
    except Exception as error:  # the other runs go on
        return {"outcome": "failed", "reason": f"{type(error).__name__}: {error}"}


def map_of(run: Run) -> BaseMap:
    """Build the map that a run is made on; changes come later."""
    return built(surveyed(draw(run.kind, run.seed, size_of(run.kind), 0.0), run.seed))
