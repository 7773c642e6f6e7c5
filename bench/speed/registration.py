"""Registration beside small_gicp: of a simulated town, or ``python -m bench registration SITE RUN TRUTH``.

Places along a drive with a simulated 64-beam lidar in an airborne town map (or a map, run and truth of one's own).
Every way gets the same 10,000 points of the last five metres' frames (thinned to 0.25 m within 50 m), the same tile
of the map and the same starts: up to 0.5 m off in each direction and 3 degrees of heading ("search"), or a tenth of
that ("tracking").

* ours: the engine's settings and, as its search does it, every fifth point for the coarse scales (0.8 m while
  tracking, 1.5 and 0.8 m from the far starts), then all for the last one (0.4 m).
* small_gicp: GICP and VGICP, with settings chosen here. Tried from the far starts, on every other place, one
  thread (ms, rms of the error): for VGICP voxels of 0.5, 1 and 2 m (57, 33, 30 ms; 1.7, 1.7, 2.3 cm), covariances
  of 10 and 20 neighbours (33 and 42 ms; 1.7 and 1.9 cm), correspondences within 1 and 2 m (34 and 33 ms) and the
  source thinned to 0.5 m (23 ms, 1.8 cm); for GICP within 1 and 2 m (52 and 67 ms; 1.8 and 2.0 cm), thinned 52 and
  42 ms (1.7 and 1.9 cm). So VGICP gets 1 m, 10, 2 m and the thinned source, GICP 10, 1 m and the thinned source.
  Fewer points still serve either side, at errors within 5 %: at all places VGICP takes 22 ms of 28 with the source
  thinned to 0.75 m and 13 ms with every third point, ours 6.6 ms of 13.7 with every third. Those are not compared.
  The tile is prepared before, as ours is; the source's covariances, without which it cannot begin and which ours
  does not need, are part of the time. "align only" leaves them out, and has no target: a scan needs them.

A row compares the median times; the sides take turns at every start. It holds where we are 1.5 times as fast at
equal error: our root mean square, in metres and in degrees, at most 5 % above the peer's; rows of their own have both.
The time is taken with the threads that COVIEW_THREADS grants.
"""

from __future__ import annotations

import time
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.harness.files import folder
from bench.harness.rows import Row, against, informs
from bench.harness.tables import number, table
from bench.harness.worlds import map_of, prepare, world_name
from coview_kernels import nearest, runtime, transform_unique, warm_up
from coview_stream import BaseMap
from coview_stream.clouds import read_tum
from coview_stream.config import RegistrationConfig
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.geometry.transforms import Pose, inverse, norms, pose_from, rot_z, rotation_angle, transform
from coview_stream.localization.registration.local_map import LocalMap, LocalMaps
from coview_stream.localization.registration.prepare_scan import RegistrationCloud, height_above_lowest
from coview_stream.localization.registration.register import register
from coview_stream.recordings.open_run import open_run
from coview_stream.sim import SimulationConfig

POINTS, VOXEL, REACH, WINDOW = 10_000, 0.25, 50.0, 5.0
LEAST = 1.5
EQUAL = 1.05  # errors this far apart are equal: two runs with other noise differ by more
STARTS = {"tracking": (0.05, np.radians(0.3)), "search": (0.5, np.radians(3.0))}
COARSE = {"tracking": (0.8,), "search": (1.5, 0.8)}
FINE, NTH = (0.4,), 5
WAYS = ("GICP", "VGICP")
_CLEAR = 0.5  # metres above the ground, as the engine's registration has it


class Place(NamedTuple):
    """A scan (N, 3) in the odometry frame, where the robot is in it, the truth and the map around it."""

    source: RegistrationCloud
    position: Floats
    truth: Pose
    target: LocalMap


class Trials(NamedTuple):
    """Milliseconds, metres and degrees (n,) of one way from all starts."""

    ms: Floats
    metres: Floats
    degrees: Floats

    def rms(self) -> Floats:
        """Root mean squares (2,) of both errors, metres and degrees."""
        return np.asarray(np.sqrt(np.mean(np.square(self[1:]), axis=1)))

    def no_worse_than(self, other: Trials) -> bool:
        """Whether both errors' root mean squares equal the other's within 5 % or are smaller."""
        return bool((self.rms() <= EQUAL * other.rms()).all())

    def details(self) -> dict[str, list[float]]:
        """Root mean square, median and 95th percentile of each, and the share that is right, %."""
        right = 100 * float(((self.metres < 0.1) & (self.degrees < 0.5)).mean())
        metres, degrees = self.rms().tolist()
        cm, deg, ms = (np.percentile(v, [50, 95]).tolist() for v in (self.metres * 100, self.degrees, self.ms))
        return {"cm": [100 * metres, *cm], "deg": [degrees, *deg], "right": [right], "ms": ms}


def options(parser: ArgumentParser) -> None:
    """Add data of one's own."""
    parser.add_argument("data", type=Path, nargs="*", help="map, run and truth: SITE.coview RUN TRUTH.tum")
    parser.add_argument("--places", type=int, default=31, help="along the run (31)")


def rows(asked: Namespace) -> Iterator[Row]:
    """Compare with each of small_gicp's ways, from each kind of start."""
    if asked.data:
        site, run, truth = asked.data
    else:
        config = SimulationConfig("town", "os64", seed=4005, size=200.0, length=60.0)
        prepare(folder(), config)
        world = folder() / world_name(config)
        site, run, truth = map_of(folder(), config), world / "run", world / "truth.tum"
    yield from compare(list(places(site, run, truth, 11 if asked.quick else asked.places)))


def places(site: Path, run: Path, truth: Path, count: int) -> Iterator[Place]:
    """Spread ``count`` places over a run."""
    base_map = BaseMap.load(site)
    maps = LocalMaps(base_map, 60.0, crops=1000)
    stamps, poses = read_tum(truth)
    frames = list(open_run(run))
    wanted = set(np.linspace(0, len(frames) - 1, count + 1).astype(int)[1:].tolist())
    recent: list[tuple[Floats, Floats32]] = []
    anchor = frames[0].T_odom_body[:3, 3]  # odometry may begin anywhere; float32 should not
    for index, frame in enumerate(frames):
        T = pose_from(frame.T_odom_body[:3, :3], frame.T_odom_body[:3, 3] - anchor)
        recent.append((T[:3, 3], transform(T, frame.points)))
        recent = [r for r in recent if np.linalg.norm(r[0] - T[:3, 3]) < WINDOW]
        if index not in wanted:
            continue
        k = int(np.argmin(np.abs(stamps - frame.stamp)))
        T_map_body = pose_from(poses[k][:3, :3], poses[k][:3, 3] - base_map.origin)
        target = maps.around(T_map_body[:3, 3])
        source = _source(np.concatenate([points for _, points in recent]), T[:3, 3])
        if target is not None and len(source.points) >= POINTS // 2:
            yield Place(source, T[:3, 3], T_map_body @ inverse(T), target)


def _source(points: Floats32, position: Floats) -> RegistrationCloud:
    near = points.compress(norms(points, position.astype(np.float32)) < REACH, axis=0)
    thin, _ = transform_unique(near, np.eye(4), VOXEL)
    height = height_above_lowest(thin)
    some = np.sort(np.random.default_rng(1).permutation(len(thin))[:POINTS])
    return RegistrationCloud(thin[some], height[some] > _CLEAR, height[some])


def start(place: Place, kind: str, seed: int) -> Pose:
    """Return the truth, moved and turned about the robot."""
    metres, radians = STARTS[kind]
    rng = np.random.default_rng([seed, len(kind)])
    about = transform(place.truth, place.position[None])[0]
    turn = rot_z(radians * rng.choice([-1, 1]) * rng.uniform(0.3, 1))
    shift = metres * rng.uniform(-1, 1, 3) * [1, 1, 0.4]
    there = pose_from(np.eye(3), about + shift)
    return there @ pose_from(turn, np.zeros(3)) @ pose_from(np.eye(3), -about) @ place.truth


def error(place: Place, T: Pose | None) -> tuple[float, float]:
    """Metres at the robot and degrees; a failure counts as far off."""
    if T is None:
        return 99.0, 180.0
    off = transform(T, place.position[None]) - transform(place.truth, place.position[None])
    return float(np.linalg.norm(off)), float(np.degrees(rotation_angle(inverse(place.truth) @ T)))


def compare(found: list[Place]) -> Iterator[Row]:
    """Yield the rows of all places."""
    warm_up()
    threads = runtime.workers()
    peers = [SmallGicp(place.target, threads) for place in {id(p.target): p for p in found}.values()]
    for peer in peers:
        nearest(peer.target.grid, peer.target.points[:1], 1.0)  # sorts the tile
    for kind in STARTS:
        results = _trials(found, kind, _sides(kind, {id(peer.target): peer for peer in peers}))
        ours = results["ours"]
        for way in WAYS:
            for name, least in ((way, LEAST), (f"{way}, align only", None)):
                took, took_them = (float(np.median(trials.ms)) for trials in (ours, results[name]))
                row = against(f"registration/{kind}: {name}", took, took_them, "ms", least)
                if least is not None:
                    holds = bool(row.holds) and ours.no_worse_than(results[name])
                    row = replace(row, target=f">= {LEAST:g} at equal error", holds=holds)
                yield row
        for name in ("ours", *WAYS):
            metres, degrees = results[name].rms()
            about = {"way": f"{kind}, {name}", "trials": results[name].details()}
            yield informs(f"registration/{kind}: {name}, rms of the position's error", 100 * metres, "cm", about)
            yield informs(f"registration/{kind}: {name}, rms of the rotation's error", degrees, "deg")


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Errors and times of all ways: root mean square, median, 95th percentile."""
    head = ("way", "cm rms", "p50", "p95", "deg rms", "p50", "p95", "right %", "ms p50", "p95")
    lines = []
    for each in (row.details for row in rows if row.details):
        cm, deg, right, ms = (each["trials"][key] for key in ("cm", "deg", "right", "ms"))
        texts = [(cm, 2), (deg, 3), (right, 0), (ms, 1)]
        lines.append([each["way"], *(number(value, digits) for part, digits in texts for value in part)])
    return {"errors": table(head, lines)} if lines else {}


Way = Callable[[Place, Pose], tuple[float, Pose | None]]


def _sides(kind: str, peers: dict[int, SmallGicp]) -> dict[str, Way]:
    def ours(place: Place, begin: Pose) -> tuple[float, Pose | None]:
        clock, config = time.perf_counter(), RegistrationConfig()
        about, target = place.position, place.target
        answer = register(place.source.every(NTH), begin, target, config, COARSE[kind], centre=about)
        if answer is not None:
            answer = register(place.source, answer.T_map_source, target, config, FINE, centre=about)
        return time.perf_counter() - clock, None if answer is None else answer.T_map_source

    def theirs(way: str, whole: bool) -> Way:
        return lambda place, begin: peers[id(place.target)].align(way, place.source.points, begin, whole)

    sides: dict[str, Way] = {"ours": ours}
    for way in WAYS:
        sides |= {way: theirs(way, True), f"{way}, align only": theirs(way, False)}
    return sides


def _trials(found: list[Place], kind: str, sides: dict[str, Way]) -> dict[str, Trials]:
    values: dict[str, list[tuple[float, float, float]]] = {name: [] for name in sides}
    order = list(sides)
    for name in order:
        sides[name](found[0], start(found[0], kind, 0))
    for seed, place in enumerate(found):
        for again in range(2):
            begin = start(place, kind, 2 * seed + again)
            for name in order:
                seconds, T = sides[name](place, begin)
                values[name].append((1e3 * seconds, *error(place, T)))
            order.reverse()
    return {name: Trials(*np.array(v).T) for name, v in values.items()}


class SmallGicp:
    """small_gicp with a tile prepared."""

    def __init__(self, target: LocalMap, threads: int) -> None:
        import small_gicp

        self.target, self._threads = target, threads
        self._library: Any = small_gicp
        self._map, self._tree = small_gicp.preprocess_points(
            target.points.astype(np.float64), downsampling_resolution=0.05, num_threads=threads
        )
        self._voxels = small_gicp.GaussianVoxelMap(1.0)
        self._voxels.insert(self._map)

    def align(self, way: str, points: Floats32, begin: Pose, whole: bool) -> tuple[float, Pose | None]:
        """Seconds, with the source's covariances or without, and the pose."""
        cloud = points.astype(np.float64)
        clock = time.perf_counter()
        source, _ = self._library.preprocess_points(cloud, downsampling_resolution=0.5, num_threads=self._threads)
        if not whole:
            clock = time.perf_counter()
        within = 2.0 if way == "VGICP" else 1.0
        about = {"num_threads": self._threads, "max_correspondence_distance": within}
        if way == "VGICP":
            answer = self._library.align(self._voxels, source, begin, about)
        else:
            answer = self._library.align(self._map, source, self._tree, begin, about)
        return time.perf_counter() - clock, np.array(answer.T_target_source)
