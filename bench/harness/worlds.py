"""Simulated worlds for the benchmarks, made once, and places along a run.

A place is the end of a drive of eight metres by a robot that was just switched on. The localizer gets the five
keyframes of that drive one after the other, other libraries the same points at once, as one gravity-aligned submap.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from bench.harness.files import fingerprint, folder, remembered
from coview_stream import BaseMap
from coview_stream.clouds import read_tum
from coview_stream.config import KeyframeConfig, MapConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, inverse, pose_from, rotation_angle, to_local
from coview_stream.localization.calibration.calibration import RawScan
from coview_stream.localization.registration.clouds import voxelized
from coview_stream.localization.search.keyframes import KeyframeBuffer
from coview_stream.localization.search.request import RequestSpec, SearchRequest
from coview_stream.recordings.open_run import open_run
from coview_stream.recordings.run import Run
from coview_stream.report.evaluation import driven
from coview_stream.sim import SimulationConfig, simulate
from coview_stream.sim.dirt import KINDS_OF_DIRT, REAL

TUNED_SEEDS = frozenset(range(1, 21))
"""Seeds of ``coview_stream.sim`` on which defaults were chosen, including those of the unit tests."""

KINDS = ("town", "campus", "village", "industrial")
LIDARS = ("vlp16", "os64", "mid360")
UTM = (512_000.0, 5_403_000.0, 120.0)

SIMULATOR = ("coview_stream/sim",)
MAPPER = (*(f"coview_stream/{part}" for part in ("sim", "basemap", "clouds", "descriptors", "localization/search")),
          "coview_kernels")  # fmt: skip
"""Code that makes worlds, and code that makes their maps."""


def world_name(config: SimulationConfig) -> str:
    """Return the name of a world's directory below the benchmark's folder."""
    dirt = REAL if config.dirt.kinds == KINDS_OF_DIRT else "+".join(config.dirt.kinds)
    drive = f"-drive{config.drive_seed}" if config.drive_seed else ""
    return f"{config.scene}-{config.sensor}-{config.seed}{drive}" + (f"-{dirt}" if dirt else "")


def map_of(below: Path, config: SimulationConfig) -> Path:
    """Return where :func:`prepare` puts a world's map."""
    return below / world_name(config) / "site.coview"


def prepared_run(below: Path, config: SimulationConfig) -> Path:
    """Return a world's directory, simulated if missing."""
    out = below / world_name(config)
    world = {"world": config.to_dict(), "code": fingerprint(*SIMULATOR)}
    remembered(out / "simulated.json", world, lambda: simulate(out, config, overwrite=True))
    return out


def prepare(below: Path, config: SimulationConfig) -> Path:
    """Return a world's directory, simulated and with its map built if missing."""
    out, site = prepared_run(below, config), map_of(below, config)
    made = {"map": asdict(MapConfig()), "code": fingerprint(*MAPPER)}
    remembered(out / "built.json", made, lambda: BaseMap.build(out / "base.laz").save(site))
    return out


def opened(config: SimulationConfig) -> tuple[BaseMap, Run, tuple[Floats, Floats]]:
    """Map, run and truth (stamps, and poses of each frame) of a world, which is made now unless it is there."""
    world = prepare(folder(), config)
    return BaseMap.load(map_of(folder(), config)), open_run(world / "run"), read_tum(world / "truth.tum")


KEYFRAMES = 5  # keyframes of a query: a drive of eight metres

WORLDS = {
    "town": SimulationConfig("town", "vlp16", seed=2201, size=240.0, length=90.0),
    "campus": SimulationConfig("campus", "os64", seed=2202, size=240.0, length=90.0),
}
"""Airborne base map (20 pulses per square metre), ground run; seeds on which nothing was tuned."""


@dataclass(frozen=True)
class Place:
    """One query with its answer."""

    queries: list[SearchRequest]  # of the keyframes, oldest first, for the localizer
    submap: Points  # (N, 3) all points of the keyframes, metres: axes of the odometry (gravity aligned), robot at zero
    T_map_submap: Pose  # (4, 4) the truth; the map's coordinates are relative to its origin

    def errors(self, T_map_submap: Pose) -> tuple[float, float]:
        """Return the distance (metres) and angle (degrees) of an answer from the truth."""
        off = inverse(self.T_map_submap) @ T_map_submap
        return float(np.linalg.norm(off[:3, 3])), float(np.degrees(rotation_angle(off)))

    @property
    def T_odom_submap(self) -> Pose:
        """(4, 4): where the robot is in the odometry frame, without its turn."""
        return pose_from(np.eye(3), self.queries[-1].position)


def places(site: BaseMap, run: Run, truth: Floats, count: int, keyframes: int = KEYFRAMES) -> list[Place]:
    """Return ``count`` places of ``keyframes`` each, evenly along a run with true poses (N, 4, 4) on a map."""
    way = driven(run.poses)
    last = max(0.0, way[-1] - keyframes * KeyframeConfig().distance)
    return [_place(run, truth, int(k), site, keyframes) for k in np.searchsorted(way, np.linspace(0.0, last, count))]


def _place(run: Run, truth: Floats, start: int, site: BaseMap, keyframes: int) -> Place:
    buffer, queries = KeyframeBuffer(KeyframeConfig()), []
    for index in range(start, len(run)):
        frame = run.read(index)
        T_odom_body = to_local(frame.T_odom_body, run.poses[start][:3, 3])
        keyframe = buffer.add(RawScan(voxelized(frame.points, T_odom_body, buffer.config), T_odom_body), frame.stamp)
        if keyframe is not None:
            queries.append(SearchRequest.of(buffer, keyframe, frame.points, RequestSpec(site.descriptor_config)))
            last, T_odom_last = index, T_odom_body
        if len(queries) == keyframes:
            break
    position = queries[-1].position
    submap = (buffer.recent(keyframes) - position.astype(np.float32)).astype(np.float32)
    T_submap_body = pose_from(T_odom_last[:3, :3], np.zeros(3))
    return Place(queries, submap, to_local(truth[last], site.origin) @ inverse(T_submap_body))
