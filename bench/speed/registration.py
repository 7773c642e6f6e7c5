"""Registration beside small_gicp: 10,000 points against a tile of the map.

Places along a drive with a simulated 64-beam lidar in an airborne town map. Every way gets the same 10,000 points of
the last five metres' frames (thinned to 0.25 m within 50 m), the same tile and the same starts: up to 0.5 m off in each
direction and 3 degrees of heading ("search"), a tenth of that ("tracking"), or 2 m and 8 degrees ("far").

* ours: the engine's settings, which take a share of the points for the coarse scales (0.8 m while tracking, 1.5 and
  0.8 m from the far starts), then all for the last one (0.4 m).
* small_gicp: of voxels of 0.5 to 2 m, 10 and 20 neighbours, correspondences within 1 and 2 m, thinned or not, the
  fastest settings at equal error: the source thinned to 0.5 m, 10 neighbours; VGICP voxels of 1 m, within 2 m; GICP
  within 1 m. The tile is prepared before, as ours is; the source's covariances, which ours does not need, are part of
  the time.

A row compares median times; the sides take turns at every start. It holds where we are 1.5 times as fast at equal
error: our root mean square, in metres and in degrees, at most 5 % above the peer's, with COVIEW_THREADS threads. Of
the far starts the share counts that ends within 0.3 m and one degree.
"""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np

from bench.harness.rows import Row, against, informs, listed
from bench.harness.worlds import opened
from coview_kernels import nearest, runtime, transform_unique, warm_up
from coview_stream.config import RegistrationConfig
from coview_stream.errors import require_library
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.geometry.transforms import (
    Points,
    Pose,
    inverse,
    pose_from,
    rot_z,
    rotation_angle,
    to_local,
    transform,
)
from coview_stream.localization.registration.clouds import LocalMap, LocalMaps, RegistrationCloud, height_above_lowest
from coview_stream.localization.registration.register import register
from coview_stream.sim import SimulationConfig

POINTS, VOXEL, REACH, WINDOW = 10_000, 0.25, 50.0, 5.0
LEAST, EQUAL = 1.5, 1.05  # times as fast; errors this far apart are equal: two runs with other noise differ by more
STARTS = {"tracking": (0.05, np.radians(0.3)), "search": (0.5, np.radians(3.0)), "far": (2.0, np.radians(8.0))}
CONFIG = RegistrationConfig()
SCALES = {"tracking": (0.8, 0.4), "search": (1.5, 0.8, 0.4), "far": CONFIG.search}
FOUND = 0.3, 1.0  # metres and degrees
WAYS: dict[Literal["GICP", "VGICP"], float] = {"GICP": 1.0, "VGICP": 2.0}  # correspondences within, metres
_CLEAR = 0.5  # metres above the ground, as the engine's registration has it


def small_gicp() -> Any:
    """Import it, or raise ``DependencyError`` with the remedy."""
    return require_library("small_gicp", "small-gicp>=1.0.1", "the comparison with small_gicp")


class SmallGicp:
    """small_gicp 1.0 (MIT): GICP or VGICP (voxels of 1 m, covariances of 10 points) to a prepared cloud."""

    def __init__(self, points: Points, way: Literal["GICP", "VGICP"], voxel: float, near: float, threads: int) -> None:
        """Prepare the target, thinned to ``voxel`` metres; correspondences count within ``near`` metres."""
        self._library = small_gicp()
        self._threads = threads
        self._target, tree = self.prepared(points, voxel)
        self._about: dict[str, Any] = {"max_correspondence_distance": near, "num_threads": threads}
        if way == "VGICP":
            voxels = self._library.GaussianVoxelMap(1.0)
            voxels.insert(self._target)
            self._target = voxels
        else:
            self._about["target_tree"] = tree

    def prepared(self, points: Points, voxel: float) -> Any:
        """Thin a cloud and estimate its covariances; with its search tree."""
        return self._library.preprocess_points(
            points.astype(np.float64), downsampling_resolution=voxel, num_neighbors=10, num_threads=self._threads
        )

    def align(self, source: Any, start: Pose) -> Any:
        """Align a prepared cloud to the target from a pose nearby."""
        return self._library.align(self._target, source, init_T_target_source=start, **self._about)


Peers = dict[tuple[str, int], SmallGicp]  # by way and tile


class Place(NamedTuple):
    """A scan (N, 3) in the odometry frame, where the robot is in it, the truth and the map around it."""

    source: RegistrationCloud
    position: Floats
    truth: Pose
    target: LocalMap


def rows(asked: Namespace) -> Iterator[Row]:
    """Compare with each of small_gicp's ways, from each kind of start."""
    small_gicp()  # before the world is made
    found = list(places(11 if asked.quick else 31))
    warm_up()
    peers: Peers = {}
    threads = runtime.workers()
    for target in {id(place.target): place.target for place in found}.values():
        peers |= {(w, id(target)): SmallGicp(target.points, w, 0.05, near, threads) for w, near in WAYS.items()}
        nearest(target.grid, target.points[:1], 1.0)  # sorts the tile
    for kind in STARTS:
        results = _trials(found, kind, peers)
        ours = results["ours"]
        for way in WAYS if kind != "far" else ():
            theirs = results[way]
            row = against(f"registration/{kind}: {way}", ours["ms"], theirs["ms"], "ms", LEAST)
            holds = bool(row.holds) and all(ours[key] <= EQUAL * theirs[key] for key in ("cm", "deg"))
            yield replace(row, target=f">= {LEAST:g} at equal error", holds=holds)
        about = {"starts": kind, "threads": threads}
        figures = [about | {"way": way} | of for way, of in results.items()]
        yield informs(f"registration/{kind}: starts found", ours["found"], "%", {"figures": figures})


COLUMNS = (
    ("starts", "starts", None), ("threads", "threads", 0), ("", "way", None), ("ms, median", "ms", 0),
    ("position, rms cm", "cm", 2), ("rotation, rms deg", "deg", 3), ("found %", "found", 1),
)  # fmt: skip


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """One line for each kind of start and each way."""
    return {"": listed(COLUMNS, [of for row in rows for of in row.details.get("figures", ())])}


def places(count: int) -> Iterator[Place]:
    """Spread ``count`` places over a run through a simulated town."""
    config = SimulationConfig("town", "os64", seed=4005, size=200.0, length=60.0)
    base_map, run, (stamps, poses) = opened(config)
    maps, frames = LocalMaps(base_map, 60.0, max_bytes=10**10), list(run)
    wanted = set(np.linspace(0, len(frames) - 1, count + 1).astype(int)[1:].tolist())
    recent: list[tuple[Floats, Floats32]] = []
    for index, frame in enumerate(frames):
        T = to_local(frame.T_odom_body, frames[0].T_odom_body[:3, 3])
        recent.append((T[:3, 3], transform(T, frame.points)))
        recent = [r for r in recent if np.linalg.norm(r[0] - T[:3, 3]) < WINDOW]
        if index in wanted:
            T_map_body = to_local(poses[np.abs(stamps - frame.stamp).argmin()], base_map.origin)
            target = maps.around(T_map_body[:3, 3])
            points = np.concatenate([points for _, points in reversed(recent)])  # newest first, as the engine's
            thin, _ = transform_unique(points, np.eye(4), VOXEL, 0.0, REACH, T[:3, 3])
            height = height_above_lowest(thin)
            some = np.random.default_rng(1).permutation(len(thin))[:POINTS]
            some = some[np.lexsort(np.floor(thin[some, :2] / 2.0).T)]  # the engine's order: by place
            source = RegistrationCloud(thin[some], height[some] > _CLEAR, height[some])
            if target is not None and len(some) >= POINTS // 2:
                yield Place(source, T[:3, 3], T_map_body @ inverse(T), target)


def _trials(found: list[Place], kind: str, peers: Peers) -> dict[str, dict[str, float]]:
    """Return figures of every way, of two starts at each place.

    Median milliseconds, root mean squares of centimetres and degrees, and the share of the starts that are found, %.
    """

    def ours(place: Place, begin: Pose) -> Pose | None:
        answer = register(place.source, begin, place.target, CONFIG, SCALES[kind], centre=place.position)
        return None if answer is None else answer.T_map_source

    def theirs(way: str, place: Place, begin: Pose) -> Pose:
        peer = peers[way, id(place.target)]
        return np.array(peer.align(peer.prepared(place.source.points, 0.5)[0], begin).T_target_source)

    sides: dict[str, Callable[[Place, Pose], Pose | None]] = {"ours": ours}
    sides |= {way: partial(theirs, way) for way in WAYS}
    values: dict[str, list[tuple[float, float, float]]] = {name: [] for name in sides}
    order, (metres, radians) = list(sides), STARTS[kind]
    for seed in (0, *range(2 * len(found))):  # the first one warms up
        place, rng = found[seed // 2], np.random.default_rng([seed, len(kind)])
        robot = transform(place.truth, place.position[None])[0]
        turn = rot_z(radians * rng.choice([-1, 1]) * rng.uniform(0.3, 1))
        shift = metres * rng.uniform(-1, 1, 3) * [1, 1, 0.4]
        begin = pose_from(turn, robot + shift) @ pose_from(np.eye(3), -robot) @ place.truth
        for name in order:
            clock = time.perf_counter()
            T = sides[name](place, begin)
            took, error, degrees = 1e3 * (time.perf_counter() - clock), 99.0, 180.0  # a failure is far off
            if T is not None:
                error = float(np.linalg.norm(transform(T, place.position[None])[0] - robot))
                degrees = float(np.degrees(rotation_angle(inverse(place.truth) @ T)))
            values[name].append((took, error, degrees))
        order.reverse()
    out: dict[str, dict[str, float]] = {}
    for name, value in values.items():
        array = np.array(value[1:])
        metres, degrees = np.sqrt(np.mean(array[:, 1:] ** 2, axis=0)).tolist()
        share = 100.0 * float(np.mean((array[:, 1:] < FOUND).all(axis=1)))
        out[name] = {"ms": float(np.median(array[:, 0])), "cm": 100.0 * metres, "deg": degrees, "found": share}
    return out
