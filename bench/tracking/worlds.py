"""Worlds that tracking is measured in, and their maps: as it is, with a gap, and of an earlier time.

A world is simulated once (the base map's scan, the truth and the frames of a drive) and kept; what happens to the robot
in a scenario is made of those frames. Frames are kept as int16 steps of 4 mm, a fifth of the lidar's noise.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

from bench.harness.files import fingerprint, remembered
from bench.harness.worlds import MAPPER, SIMULATOR
from coview_stream import BaseMap
from coview_stream.clouds import write_cloud
from coview_stream.clouds.atomic_file import atomic_path
from coview_stream.config import MapConfig
from coview_stream.geometry.arrays import Bools, Floats, Indices, Ints
from coview_stream.geometry.transforms import Points
from coview_stream.report.evaluation import driven
from coview_stream.sim import KINDS, SimulationConfig
from coview_stream.sim.layout import Layout, loop_layout, resample
from coview_stream.sim.scenes import Scene, build_scene
from coview_stream.sim.vegetation import TreeMix

STEP = 0.004  # metres, to which frames are rounded
GAP, GAP_RADIUS = (120.0, 220.0), 40.0  # metres of the drive between which a gap's map holds nothing so near
CHANGED = 0.3  # share of the buildings, cars, poles and trees that are others in the changed map
_FOREST = KINDS["forest"]
_PATH = 1.2  # metres from a path's middle to the trees beside it
_PETALS, _DEPTH, _ROUNDED = 7, 0.45, 60  # of a winding path: bends outwards, their depth, and samples that round them
_FELLED = 0.1  # share of the trees along a path that are gone since the survey; new ones stand where there is room
_SELF = "bench/tracking/worlds.py"


class World(NamedTuple):
    """A place and a drive of ``length`` metres at ``speed`` m/s, and how far the odometry of its plain run drifts."""

    kind: str  # one of the simulator's, or of FORESTS
    sensor: str
    seed: int
    size: float
    length: float
    speed: float
    drift: float  # share of the distance, over 100 m (see :func:`bench.tracking.drives.drift_share`)

    @property
    def name(self) -> str:
        """Directory below the benchmark's folder."""
        return f"tracking-{self.kind}-{self.sensor}-{self.seed}"

    @property
    def config(self) -> SimulationConfig:
        """The simulator's settings."""
        scene = "forest" if self.kind in FORESTS else self.kind
        return SimulationConfig(scene, self.sensor, self.seed, self.size, self.length, speed=self.speed)

    def scene(self, changed: float | None = None) -> Scene:
        """Draw the place; the share ``changed`` of its trees, cars and poles is another since the survey."""
        config, usual = self.config, _FELLED if self.kind in PATHS else 0.0
        with patch.dict(KINDS, {"forest": FORESTS.get(self.kind, _FOREST)}):
            return build_scene(config.scene, config.seed, config.size, usual if changed is None else changed)


def winding_path(rng: np.random.Generator, size: float, half: float) -> Layout:
    """Return a closed path of rounded petals through the square of ``size`` metres, about four times its side long."""
    angle = np.linspace(0.0, 2.0 * np.pi, 6000, endpoint=False)
    radius = 1.0 + _DEPTH * np.cos(_PETALS * angle + rng.uniform(0.0, 2.0 * np.pi))
    radius *= (size / 2 - 30.0) / radius.max()
    loop = resample(np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]), 0.25)
    loop = gaussian_filter1d(loop, _ROUNDED, axis=0, mode="wrap")
    loop = np.concatenate([loop, loop[:1]])
    return Layout(resample(loop, 0.25), (resample(loop, 1.0),), _PATH)


def _lonely_path(rng: np.random.Generator, size: float, half: float) -> Layout:
    return replace(loop_layout(rng, size, half, _PATH, branches=0, waviness=0.3), half_width=_PATH)


PATHS = {
    "dense-forest": _FOREST._replace(
        streets=_lonely_path, trees=0.15, species=TreeMix((14.0, 24.0), spread=(0.07, 0.12), conifers=0.5)
    ),
    "long-forest": _FOREST._replace(streets=winding_path, trees=0.06),
    "closed-forest": _FOREST._replace(streets=_lonely_path, trees=0.16),
}
"""Forests for the second paper's tables, with a path of 2.4 m: about 900 stems per hectare of one age with crowns of
1 to 2 m, 450 along two kilometres, and 940 of all ages, whose crowns overlap from 2 m above the ground on."""

FORESTS = {"sparse-forest": _FOREST._replace(trees=0.012, undergrowth=0.008), **PATHS}
"""Forests beside the simulator's own, which has 360 stems per hectare; ``sparse-forest`` has 120."""


class Recorded(NamedTuple):
    """The drive through a world, frame by frame: true poses (N, 4, 4) map <- body, and all points of all frames."""

    truth: Floats
    ends: Ints
    rows: npt.NDArray[np.int16]

    def read(self, index: int) -> Points:
        """Frame (K, 3) float32 metres, body frame."""
        rows = self.rows[self.ends[index - 1] if index else 0 : self.ends[index]]
        return np.asarray(rows.astype(np.float32) * np.float32(STEP))


def open_world(folder: Path, world: World) -> Recorded:
    """Open the drive of a world, simulated now unless it is there."""
    out = folder / world.name
    wanted = {"world": world._replace(drift=0.0)._asdict(), "code": fingerprint(*SIMULATOR, _SELF)}
    remembered(out / "simulated.json", wanted, lambda: _simulate(out, world))
    rows = np.memmap(out / "frames.i16", np.int16, "r").reshape(-1, 3)
    return Recorded(np.load(out / "truth.npy"), np.load(out / "ends.npy"), rows)


def _simulate(out: Path, world: World) -> None:
    from coview_stream.sim.simulate import base_map, frames, trajectories

    scene, counts = world.scene(), []
    truth = trajectories(scene, world.config)[1]
    out.mkdir(parents=True, exist_ok=True)
    np.save(out / "base.npy", base_map(scene, world.config).astype(np.float32))
    np.save(out / "truth.npy", truth)
    with atomic_path(out / "frames.i16") as part, part.open("wb") as stream:
        for points in frames(scene, world.config, truth):
            stream.write(np.round(points / STEP).astype(np.int16).tobytes())
            counts.append(len(points))
    np.save(out / "ends.npy", np.cumsum(counts))


def map_of(folder: Path, world: World, variant: str = "plain") -> Path:
    """Return a map of a world, built now unless it is there: ``plain``, ``gap`` or ``changed``."""
    drive, out = open_world(folder, world), folder / world.name
    file = out / f"{variant}.coview"
    wanted = {
        "world": world._replace(drift=0.0)._asdict(), "map": asdict(MapConfig()), "code": fingerprint(*MAPPER, _SELF),
    }  # fmt: skip

    def build() -> None:
        from coview_stream.sim.simulate import base_map

        points = np.load(out / "base.npy").astype(np.float64)
        if variant == "gap":
            points = points[~in_gap(drive.truth, points)]
        if variant == "changed":
            points = base_map(earlier(world.scene(CHANGED), world.seed, CHANGED), world.config)
        with TemporaryDirectory() as scratch:
            write_cloud(Path(scratch) / "base.laz", points)
            BaseMap.build(Path(scratch) / "base.laz").save(file)

    remembered(out / f"{variant}.json", wanted, build)
    return file


def in_gap(truth: Floats, positions: Floats) -> Bools:
    """Whether each of (N, 2 or 3) positions lies where the map of a gap holds nothing."""
    from scipy.spatial import cKDTree

    way = driven(truth)
    inner = (way >= GAP[0] + GAP_RADIUS) & (way <= GAP[1] - GAP_RADIUS)
    if not inner.any():
        return np.zeros(len(positions), dtype=bool)
    near = cKDTree(truth[inner, :2, 3]).query(positions[:, :2], distance_upper_bound=GAP_RADIUS)[0]
    return np.asarray(np.isfinite(near))


def earlier(scene: Scene, seed: int, share: float) -> Scene:
    """Return the place as it was: other cars, poles and trees (``scene.now``), and a ``share`` of other buildings.

    A third of those is not built yet, a third is smaller and of another height, a third is turned round and shifted by
    1 to 2.5 m either way. ``mapped`` is what the aircraft saw then; ``now`` is what the unchanged scene's drive sees.
    """
    rng = np.random.default_rng([seed, 31])
    solid = scene.now.solid
    owner = owners(scene)
    chosen = rng.permutation(len(scene.footprints))[: round(share * len(scene.footprints))]
    vertices, gone = solid.vertices.copy(), np.zeros(len(solid.vertices), dtype=bool)
    for rank, building in enumerate(chosen):
        mine = owner == building
        plot = scene.footprints[building]
        base = np.array([plot.x, plot.y, plot.ground])
        if rank % 3 == 0:
            gone |= mine
            continue
        local = vertices[mine] - base
        c, s = np.cos(plot.yaw), np.sin(plot.yaw)
        local[:, :2] = local[:, :2] @ np.array([[c, -s], [s, c]])  # frontage along x
        if rank % 3 == 1:
            local *= (rng.uniform(0.6, 0.8), rng.uniform(0.6, 0.8), rng.choice([0.6, 1.5]))
        else:
            local[:, :2] = (local[:, :2] + rng.uniform(1.0, 2.5, 2) * rng.choice([-1, 1], 2)) * (-1, -1)
        local[:, :2] = local[:, :2] @ np.array([[c, s], [-s, c]])
        vertices[mine] = local + base
    keep = ~gone[solid.triangles[:, 0]]
    epoch = replace(scene.now, solid=solid._replace(vertices=vertices, triangles=solid.triangles[keep]))
    return replace(scene, mapped=epoch, now=scene.mapped)


def owners(scene: Scene, margin: float = 2.0) -> Indices:
    """(V,) the building that each vertex of ``scene.now.solid`` belongs to, -1 for none.

    A mesh is of unconnected pieces (walls, roofs, porches, and the ground); a piece belongs to the building whose
    footprint its middle lies in, or is nearest to within ``margin`` metres.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    solid = scene.now.solid
    a, b, c = solid.triangles.T
    count = len(solid.vertices)
    edges = coo_matrix((np.ones(2 * len(a), bool), (np.r_[a, b], np.r_[b, c])), shape=(count, count))
    pieces, piece = connected_components(edges, directed=False)
    size = np.bincount(piece, minlength=pieces)
    middle = np.column_stack([np.bincount(piece, solid.vertices[:, d], pieces) / size for d in (0, 1)])
    best, owner = np.full(pieces, margin), np.full(pieces, -1, dtype=np.intp)
    for k, plot in enumerate(scene.footprints):
        c, s = np.cos(plot.yaw), np.sin(plot.yaw)
        local = np.abs((middle - (plot.x, plot.y)) @ np.array([[c, -s], [s, c]]))
        out = np.hypot(*np.maximum(local - (plot.w / 2, plot.d / 2), 0.0).T)
        nearer = (out < best) & (size < 1000)  # the ground is one piece
        best[nearer], owner[nearer] = out[nearer], k
    return np.asarray(owner[piece])
