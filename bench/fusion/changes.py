"""Points that ``fuse --changes`` tags or leaves out as moving, against the truth of simulated worlds.

Sites surveyed from the air, ten years later, after one drive of 60 m. Truth is the distance of each point to all
surfaces of the world then and now. A point of the run is truly new if it lies on a surface now (within 0.4 m: crowns
are deep) and half a metre from all of then, a point of the map truly gone if half a metre from all of now. A tag within
0.3 m of a surface of the other time is wrong, and so is a new point that lies on no surface. Recall of new is of all
points that the run added, below roofs and crowns as well; recall of gone is of all points of the map within 25 m of the
way, visible or not.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness.files import fingerprint, folder, remembered
from bench.harness.rows import Row, table
from coview_stream.basemap.basemap import BaseMap
from coview_stream.fusion.fuse import GONE, NEW, FuseConfig, Fused, fuse
from coview_stream.fusion.localized_run import LocalizedRun, RunPair
from coview_stream.fusion.sightings import REACH
from coview_stream.geometry.arrays import Bools, Floats, Floats32
from coview_stream.localization.offline import locate, write
from coview_stream.recordings.open_run import open_run
from coview_stream.sim import SimulationConfig, parse_dirt, simulate
from coview_stream.sim.casting import open3d
from coview_stream.sim.scenes import SceneState
from coview_stream.sim.simulate import scene_of

_WORLDS = (("town", "os64", 6101), ("village", "vlp16", 6102), ("industrial", "os64", 6103), ("campus", "vlp16", 6104))
_DIRT = "traffic,years"
_ON, _OFF, _APART = 0.4, 0.3, 0.5  # metres
_TAGS = ("new", "gone")


def options(parser: ArgumentParser) -> None:
    """Add worlds."""
    parser.add_argument("worlds", nargs="*", metavar="SCENE", help="scenes to look at (all)")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row for each world: precision and recall."""
    chosen = [world for world in _WORLDS if not asked.worlds or world[0] in asked.worlds][: 1 if asked.quick else None]
    metres = 20.0 if asked.quick else 60.0
    for scene, sensor, seed in chosen:
        config = SimulationConfig(
            scene, sensor, seed, size=160.0, length=metres, changed=0.4, dirt=parse_dirt(_DIRT, 0)
        )
        place = folder() / f"changes-{scene}-{sensor}-{seed}"
        spec = {"world": config.to_dict(), "code": fingerprint(), "bench": fingerprint("bench/fusion")}
        figures = remembered(place.with_suffix(".json"), spec, partial(measure, config, place))
        text = ", ".join(f"{tag}: precision {p:.0%}, recall {r:.0%}" for tag in _TAGS for _, p, r in [figures[tag]])
        yield Row(f"changes/{scene}, {sensor}", text=text, details={"world": f"{scene}, {sensor}", **figures})


def tables(rows: Sequence[Row], _: Namespace) -> dict[str, str]:
    """Lay out a line for each world."""
    lines = []
    for figures in (row.details for row in rows):
        tags = [(f"{n:,}", f"{precision:.0%}", f"{recall:.0%}") for n, precision, recall in (figures[t] for t in _TAGS)]
        count, standing, lost = figures["moving"]
        lines.append([figures["world"], *tags[0], *tags[1], f"{count:,}", f"{standing:.1%}", f"{lost:.2%}"])
    share = ("precision", "recall")
    moving = ("left out as moving", "of these standing", "of all that stands")
    return {"": table(("world", "new", *share, "gone", *share, *moving), lines)}


def measure(config: SimulationConfig, place: Path) -> dict[str, Any]:
    """Simulate, localize, fuse and compare: (count, precision, recall) of new and gone, and what moved."""
    simulate(place, config, overwrite=True)
    base_map = BaseMap.build(place / "base.laz")
    base_map.save(place / "site.coview")
    write(locate(base_map, open_run(place / "run")), base_map, place / "out")
    run = LocalizedRun(RunPair(place / "run", place / "out"), base_map, lambda path, mount: open_run(path, mount=mount))
    whole = fuse(base_map, [run], FuseConfig(changes=True, keep_moving=True))
    fused = fuse(base_map, [run], FuseConfig(changes=True))
    scene = scene_of(config)
    origin = base_map.origin - np.array(config.origin)
    standing = distance(scene.now, whole.points + origin) < _ON
    out = ~_within(fused.points, whole.points, 1e-4)
    points = np.asarray(fused.base_map.points) + origin
    tagged, to_now = fused.base_change == GONE, distance(scene.now, points)
    near = _within(run.poses[:, :3, 3] - config.origin, points, REACH)
    return {
        "new": _new(fused, scene.mapped, scene.now, origin),
        "gone": (int(tagged.sum()), _share(to_now > _OFF, tagged), _share(tagged, near & (to_now > _APART))),
        "moving": (int(out.sum()), _share(standing, out), _share(out, standing)),
    }


def _new(fused: Fused, then: SceneState, now: SceneState, origin: Floats) -> tuple[int, float, float]:
    points = fused.points + origin
    tagged, to_then, to_now = fused.change == NEW, distance(then, points), distance(now, points)
    truly = (to_now < _ON) & (to_then > _APART)
    return int(tagged.sum()), _share((to_then > _OFF) & (to_now < _ON), tagged), _share(tagged, truly)


def _within(others: Floats | Floats32, points: Floats | Floats32, reach: float) -> Bools:
    from scipy.spatial import cKDTree

    return np.asarray(np.isfinite(cKDTree(others).query(points, distance_upper_bound=reach)[0]))


def distance(state: SceneState, points: Floats) -> Floats32:
    """Return the distance (N,) of points (N, 3), scene frame, to the nearest surface, foliage included."""
    library, tensor = open3d(), open3d().core.Tensor
    scene = library.t.geometry.RaycastingScene(nthreads=2)
    meshes = [mesh for mesh in (state.solid, state.foliage) if len(mesh.triangles)]
    if not meshes or not len(points):
        return np.full(len(points), np.inf, dtype=np.float32)
    for mesh in meshes:
        scene.add_triangles(tensor(mesh.vertices.astype(np.float32)), tensor(mesh.triangles.astype(np.uint32)))
    return np.asarray(scene.compute_distance(tensor(points.astype(np.float32))).numpy(), dtype=np.float32)


def _share(good: Bools, of: Bools) -> float:
    return float(good[of].mean()) if of.any() else float("nan")
