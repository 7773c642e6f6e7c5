"""A run: a localizer gets frames and odometry until its first fix or the drive's end; runs in several processes."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.harness.files import data, remembered, thread_settings
from bench.integrity import surveys
from bench.integrity.kinds import built, draw, surveyed
from bench.integrity.plan import FAMILIES, STATED, Run, Site
from bench.integrity.sites import beside_border, lane, rebuilt, shifted
from coview_stream import BaseMap, Localizer
from coview_stream.clouds.trajectory import read_tum
from coview_stream.config import LocalizerConfig
from coview_stream.errors import CloudError, InputError, RunError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, exp_so3, inverse, pose_from, rotation_angle
from coview_stream.localization.registration.clouds import LocalMaps
from coview_stream.localization.result import Fix
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.recognizers import SearchIndex
from coview_stream.recordings.open_run import open_run
from coview_stream.sim.odometry import OdometryConfig, drifting_odometry
from coview_stream.sim.odometry import drive as poses_along
from coview_stream.sim.scenes import Scene
from coview_stream.sim.sensors import FRAME_PERIOD, SENSORS, Caster

Result = dict[str, Any]

SPEED = 8.0  # metres per second: a frame every 0.8 m
HEIGHT = 1.5  # metres, of the sensor above the ground
FIRST_STAMP = 1000.0  # seconds
LENGTH = 60.0  # metres after which a run ends without a fix
SHIFT = 4.0  # metres, of all buildings
NEAR_METRES, NEAR_DEGREES = 3.0, 5.0  # errors from which on a first fix is false
_DRIVE, _ODOMETRY, _SENSOR = range(200, 203)  # random streams
_ALTERATION = 240


class World(NamedTuple):
    """The robot's world, as a change of the mapped scene."""

    poses: Callable[[Floats], Floats] = lambda poses: poses  # (N, 4, 4) scene <- body, to poses with z up for odometry
    cloud: Callable[[Points], Points] = lambda points: points  # (K, 3) body frame, scene to world


def altered(family: str, sign: float, share: float, heading: float) -> World:
    """Return the world in which a family of runs drives; ``sign``, ``share`` and ``heading`` are drawn."""
    if family == "mirrored":
        world, body = np.diag([-1.0, 1.0, 1.0, 1.0]), np.diag([1.0, -1.0, 1.0, 1.0])  # two mirrors: a rotation again
        mirror = np.array([1, -1, 1], dtype=np.float32)
        return World(lambda scene: world @ scene @ body, lambda points: points * mirror)
    if family == "scaled":  # the map is 3 to 5 % too large or small; the scaled pose is right
        factor, size = 1.0 + sign * (0.03 + 0.02 * share), np.ones((4, 4))
        size[:3, 3] = 1.0 / factor
        return World(lambda scene: scene * size, lambda points: points / np.float32(factor))
    if family == "tilted":  # by 2 to 4 degrees about a level axis; the tilted pose is right
        axis = np.radians(2.0 + 2.0 * share) * np.array([np.cos(heading), np.sin(heading), 0.0])
        T = pose_from(exp_so3(axis), np.zeros(3))
        return World(lambda scene: T @ scene)
    return World()


@dataclass(frozen=True)
class Drive:
    """Poses, odometry, truth and clouds of a drive."""

    poses: Floats  # (N, 4, 4) scene <- body
    odometry: Floats  # (N, 4, 4) odom <- body
    truth: Floats | None  # (N, 4, 4) map <- body; None where every fix is false
    frame: Callable[[int], Points]  # number -> cloud (K, 3), body frame, metres; call in ascending order
    times: Floats | None = None  # (N,) seconds; None for a frame every FRAME_PERIOD

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def stamps(self) -> Floats:
        """(N,) seconds."""
        if self.times is not None:
            return self.times
        return FIRST_STAMP + FRAME_PERIOD * np.arange(len(self), dtype=np.float64)

    @property
    def driven(self) -> Floats:
        """(N,) metres since the first frame."""
        steps = np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])


def _recorded(run: Run) -> Drive:
    """Return a part of a recorded run: forwards from a frame, or backwards, with time running on."""
    recorded, (stamps, truth) = open_run(data() / run.kind / "run"), read_tum(data() / run.kind / "truth.tum")
    first = round(run.number * len(recorded) / 8)
    order = np.arange(first, len(recorded)) if run.number % 2 == 0 else np.arange(first, -1, -1)
    times = FIRST_STAMP + np.abs(stamps[order] - stamps[first])
    return Drive(
        truth[order], recorded.poses[order], truth[order], lambda k: recorded.read(int(order[k])).points, times
    )


def drive_of(run: Run, length: float = LENGTH, speed: float = SPEED) -> Drive | None:
    """Return the drive of a run from anywhere on its route, in either direction; None where there is no such street."""
    if run.group == "runs":
        return _recorded(run)
    if (scene := _scene(run)) is None:
        return None

    def rng(stream: int) -> np.random.Generator:
        return np.random.default_rng([run.drive_seed, stream])

    draws = rng(_ALTERATION)
    sign, heading, share = draws.choice([-1.0, 1.0]), draws.uniform(0.0, 2 * np.pi), draws.random()
    world = altered(run.family, sign, share, heading)
    if run.family.endswith("shifted"):
        move = surveys.moved if run.group == "surveys" else shifted
        scene = move(scene, SHIFT * np.array([np.cos(heading), np.sin(heading)]))
    route: Floats | None = scene.route
    if run.family == "edge":
        route = beside_border(scene, run.drive_seed, run.beyond)
    elif run.kind == "boxes":
        route = lane(scene, run.drive_seed, across=bool((run.seed // 2 + run.number) % 2))
    if route is None:
        return None
    poses = poses_along(replace(scene, route=route), length, speed, HEIGHT, rng(_DRIVE))
    odometry = drifting_odometry(world.poses(poses), OdometryConfig(), rng(_ODOMETRY))
    lidar, noise, casters = SENSORS[run.sensor](), rng(_SENSOR), list[Caster]()

    def frame(k: int) -> Points:
        if not casters:
            casters.append(Caster(scene.now, threads=1))
        return world.cloud(lidar.scan(casters[0], poses[k], k, noise))

    return Drive(poses, odometry, None if run.driven or run.family == "mirrored" else poses, frame)


def _scene(run: Run) -> Scene | None:
    """Return the scene of a run's drive, now; None of a survey where there is no room to drive."""
    if run.group == "surveys":
        seed = run.drive_seed if run.driven else run.seed
        return surveys.world(seed, run.drive_seed if run.kind == "survey" else seed, run.seed if run.driven else None)
    kind, seed = (run.driven, run.drive_seed) if run.driven else (run.kind, run.seed)
    scene = draw(kind, seed, run.changed)
    return rebuilt(scene, run.drive_seed, run.rebuilt) if run.rebuilt else scene


class Searched(NamedTuple):
    """The most probable place of a searched keyframe."""

    error: float  # stated
    T_map_body: Pose


class Robot:
    """A localizer on a map, and the search that answers its requests and shows the leader of a keyframe."""

    def __init__(self, base: BaseMap) -> None:
        config = LocalizerConfig()
        maps, index = LocalMaps(base, config.registration.source_range), SearchIndex.of(base, config)
        self.localizer, self.origin = Localizer(base, config, maps, index), base.origin
        self.localizer.prepare()
        self.search = GlobalSearch(base, config, maps, index)

    def step(self, cloud: Points, T_odom_body: Pose, stamp: float) -> tuple[Fix, Searched | None]:
        """Step as :meth:`Localizer.step`; also return the most probable place where a keyframe was searched."""
        request, searched = self.localizer.add_frame(cloud, T_odom_body, stamp), None
        if request is not None:
            result = self.search.update(request)
            self.localizer.apply_search_result(result)
            if result.leader is not None and result.considered is not None:
                T, none = result.leader @ request.T_odom_body, result.considered.none
                error = max(none, 1.0 - (result.evidence.confidence or 0.0))
                searched = Searched(error, pose_from(T[:3, :3], T[:3, 3] + self.origin))
        return self.localizer.fix(), searched


def first_fix(robot: Robot, drive: Drive) -> Result:
    """Follow a drive to its first fix; return outcome, last reason and some of the searched keyframes.

    ``searched`` has the first, and the first with a stated error below each of :data:`STATED`: the metres driven, the
    stated error, and whether the most probable place was right.
    """
    robot.localizer.reset()
    robot.search.reset()  # a search that goes on pays for its earlier starts
    said, way, searched = "", drive.driven, list[tuple[float, float, bool]]()
    out: Result = {"outcome": "none", "state": robot.localizer.state.value, "searched": searched}
    for k, stamp in enumerate(drive.stamps):
        cloud = drive.frame(k)
        try:
            fix, place = robot.step(cloud, drive.odometry[k], float(stamp))
        except (CloudError, RunError):
            continue
        truth = None if drive.truth is None else drive.truth[k]
        if place is not None:
            right = judged(place.T_map_body, truth)["outcome"] == "right"
            if not searched or any(place.error < limit <= min(at[1] for at in searched) for limit in STATED):
                searched.append((round(float(way[k]), 2), place.error, right))
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
    return {"outcome": "right" if metres < NEAR_METRES and degrees < NEAR_DEGREES else "false"}


def everywhere(
    sites: Sequence[Site], below: Path, code: str, jobs: int, until: float
) -> Iterator[tuple[list[Result], bool]]:
    """Yield the results of sites as they come, with whether they were made now; they stay ``below``.

    ``jobs`` processes with one thread each begin no further site after ``until`` (``time.monotonic``). Sites that
    another call has begun come last, as it leaves them.
    """
    os.environ.update(thread_settings(1))  # processes that start from now on inherit it
    below.mkdir(parents=True, exist_ok=True)
    left = list(sites)
    with ProcessPoolExecutor(max(1, min(jobs, len(sites))), mp_context=get_context("spawn")) as pool:
        try:
            for wait in (False, True):
                waiting = {pool.submit(on_site, site, below, code, until, wait): site for site in left}
                left = []
                for done in as_completed(waiting):
                    results, new = done.result()
                    yield results, new
                    left += [] if results else [waiting[done]]
        finally:
            pool.shutdown(cancel_futures=True)


class _UnkeptError(Exception):
    """Results that are not kept: of a site with a failed run, or of one that was to begin after the time."""


def on_site(
    site: Site, below: Path, code: str, until: float = math.inf, wait: bool = False
) -> tuple[list[Result], bool]:
    """Make all runs on one map unless they are there; return them, and whether they were made now.

    Runs of a site with a ``failed`` one are made again next time. None is returned of a site that another process
    makes, unless we ``wait``, or that was to begin after ``until``.
    """
    about, new = [before(run) for run in site], []

    def one(run: Run, robot: Robot) -> Result:
        try:
            drive = drive_of(run)
            return {"outcome": "no way", "reason": "no such street"} if drive is None else first_fix(robot, drive)
        except InputError as error:  # no second square of a small survey is far enough from the first
            return {"outcome": "no way", "reason": str(error)}
        except Exception as error:  # the other runs go on
            return _failed(error)

    def make() -> dict[str, Any]:
        if time.monotonic() > until:
            raise _UnkeptError([])
        new.append(site)
        try:
            robot = Robot(map_of(site[0]))
        except BlockingIOError as error:  # no process can be started; it is not the lock of another one
            raise RuntimeError(str(error)) from error
        results = [
            run | {"place": place(case), "ground": ground(case)} | one(case, robot)
            for run, case in zip(about, site, strict=True)
        ]
        if any(result["outcome"] == "failed" for result in results):
            raise _UnkeptError(results)
        return {"runs": results}

    spec = {"runs": list(map(asdict, site)), "code": code}
    try:
        results: list[Result] = remembered(below / f"{site[0].kind}-{site[0].seed}.json", spec, make, wait)["runs"]
    except BlockingIOError:
        return [], False
    except _UnkeptError as error:
        results = error.args[0]
    except Exception as error:  # the other sites go on
        results = [run | _failed(error) for run in about]
    return results, bool(new)


def _failed(error: Exception) -> Result:
    return {"outcome": "failed", "reason": f"{type(error).__name__}: {error}"}


def before(run: Run) -> Result:
    """Return a result before the run."""
    return {"key": run.key, "class": FAMILIES[run.family], **asdict(run)}


def place(run: Run) -> str:
    """Return the real site that a run is on; empty for a simulated one."""
    if run.group == "surveys":
        return surveys.place_of(run.seed).stem
    return run.kind if run.group == "runs" else ""


def ground(run: Run) -> str:
    """Return the part of the earth, or of a simulator, that a run's map shows: squares of a survey may overlap."""
    return surveys.block_of(run.seed) if run.group == "surveys" else f"{run.kind}-{run.seed}"


def map_of(run: Run) -> BaseMap:
    """Build the map that a run is made on; changes come later."""
    return BaseMap.build(data() / run.kind / "base.laz") if run.group == "runs" else built(cloud_of(run))


def cloud_of(run: Run) -> Floats:
    """Return the survey (N, 3) that a run's map is made of, metres."""
    if run.group == "surveys":
        return surveys.surveyed(run.kind, run.seed)
    return surveyed(draw(run.kind, run.seed, 0.0), run.seed)
