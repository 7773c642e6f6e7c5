"""Ground: ``python -m bench ground`` digs it, ``python -m bench ground FILE.laz ...`` filters it.

Without files, robots drive over simulated sites whose ground was dug, filled, piled up or snowed on since the survey,
with a quarter of the buildings gone and a quarter new. Per case: false frames (metres in the plane, degrees), frames
beyond a level, errors, the median levels, and the greatest lean of the sensor that was made up.

With files labelled by class, per file and method of the ground filter, in per cent: type I (ground taken for something
else), type II (something else taken for ground), and both over all points.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from bench.accuracy.scores import FALSE_DEGREES, FALSE_METRES, Track, errors
from bench.harness.files import fingerprint, folder, remembered
from bench.harness.rows import Row, informs, judged, listed
from coview_stream import BaseMap, Localizer
from coview_stream.basemap.ground import Method, ground_mask
from coview_stream.clouds import read_cloud, write_cloud
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.transforms import Poses
from coview_stream.sim import SimulationConfig
from coview_stream.sim.dirt.scene import drawn_parts
from coview_stream.sim.mesh import EMPTY
from coview_stream.sim.odometry import drifting_odometry
from coview_stream.sim.scenes import Scene
from coview_stream.sim.sensors import FRAME_PERIOD
from coview_stream.sim.simulate import base_map, frames, scene_of, trajectories

METHODS: tuple[Method, ...] = ("cloth", "morphological")
_GROUND_CLASS = 2
_GONE = 0.25  # share of the buildings that are gone, and of those that are new
_SITES = (("town", "vlp16"), ("campus", "mid360"), ("village", "os64"), ("industrial", "vlp16"))

Change = Callable[..., Floats]
"""x, y (N,) and the drive's places (M, 2) -> rise of the ground (N,), metres."""


def _round(x: Floats, y: Floats, place: Floats, inner: float, outer: float) -> Floats:
    """Return one within ``inner`` metres of a place, zero beyond ``outer``, smooth between."""
    inside = np.clip((outer - np.hypot(x - place[0], y - place[1])) / (outer - inner), 0.0, 1.0)
    return np.asarray(inside**2 * (3.0 - 2.0 * inside))


def _piles(x: Floats, y: Floats, way: Floats) -> Floats:
    rng = np.random.default_rng(len(way))
    places = way[rng.integers(len(way), size=40)] + rng.normal(0.0, 12.0, (40, 2))
    clear = [place for place in places if np.hypot(*(way - place).T).min() > 6.0]
    return np.asarray(np.max([rng.uniform(1.5, 3.5) * _round(x, y, place, 0.0, 6.0) for place in clear], axis=0))


CASES: dict[str, Change] = {
    "as surveyed": lambda x, y, way: np.zeros_like(x),
    "starts in a pit of 2 m": lambda x, y, way: -2.0 * _round(x, y, way[0], 40.0, 70.0),
    "starts in a pit of 1 to 3 m": lambda x, y, way: (
        (np.sin(x / 13.0) * np.cos(y / 17.0) - 2.0) * _round(x, y, way[0], 40.0, 70.0)
    ),
    "starts on 1.5 m of filling": lambda x, y, way: 1.5 * _round(x, y, way[0], 40.0, 70.0),
    "drives into a pit of 2.5 m": lambda x, y, way: -2.5 * _round(x, y, way[len(way) // 2], 12.0, 28.0),
    "drives onto a bank of 2 m": lambda x, y, way: 2.0 * _round(x, y, way[len(way) // 2], 12.0, 28.0),
    "piles": _piles,
    "snow of 0.5 m": lambda x, y, way: 0.5 + 0.05 * np.sin(x / 4.0) * np.cos(y / 5.0),
}


def options(parser: ArgumentParser) -> None:
    """Add the files, and the seed of the sites."""
    parser.add_argument("files", nargs="*", type=Path, help="LAS or LAZ with ground labelled as class 2")
    parser.add_argument("--seed", type=int, default=3701, help="of the first simulated site (%(default)s)")
    parser.add_argument("--sites", type=int, default=len(_SITES), help="number of them (%(default)s)")
    parser.add_argument("--metres", type=float, default=70.0, help="driven on each (%(default)g)")


def rows(asked: Namespace) -> Iterator[Row]:
    """Filter each file and compare with its labels; without files drive over changed sites."""
    if not asked.files:
        yield from _changed(asked)
    for file in asked.files:
        cloud = read_cloud(file)
        if cloud.classification is None or not (cloud.classification == _GROUND_CLASS).any():
            raise InputError(f"{file}: no point is labelled as ground (class 2)")
        label = cloud.classification == _GROUND_CLASS
        for method in METHODS:
            mask = ground_mask(cloud.points, method)
            shares = [100 * each.mean() for each in (~mask[label], mask[~label], label != mask)]
            about = {"file": file.name, "method": method, "I": shares[0], "II": shares[1], "total": shares[2]}
            yield informs(f"ground/{file.name}, {method}: total error", shares[2], "%", about)


def _changed(asked: Namespace) -> Iterator[Row]:
    false = 0
    metres, every = (25.0, 4) if asked.quick else (asked.metres, 1)
    for number, (kind, sensor) in enumerate(_SITES[: 1 if asked.quick else asked.sites]):
        config = SimulationConfig(kind, sensor, seed=asked.seed + number, size=200.0, length=metres)
        spec = {"site": config.to_dict(), "code": fingerprint(), "bench": fingerprint("bench/accuracy/ground.py")}
        changed = cache(partial(_site, config))  # not made where all cases are there
        for case in list(CASES)[::every]:
            file = folder() / "ground" / f"{kind}-{sensor}-{config.seed}-{case.replace(' ', '-')}.json"
            make = partial(_drive, config, case, changed)
            about = remembered(file, {**spec, "case": case}, make)
            about |= {"site": f"{kind}, {sensor}", "case": case}
            false += about["false"]
            bad = about["false"] + about["beyond in the plane"] + about["beyond in height"]
            yield replace(
                judged(f"ground/{kind}, {sensor}, {case}: false, or beyond a level", str(bad), "0", bad == 0),
                ours=float(bad), details=about,
            )  # fmt: skip
    yield judged("ground/false frames", str(false), "0", false == 0, false)


def _site(config: SimulationConfig) -> tuple[BaseMap, Scene, Poses, Any]:
    """Return the map of a site, its scene, the level drive, and the present objects."""
    scene = scene_of(config)
    level = trajectories(scene, config)[1]
    gone, new, _ = np.split(
        np.random.default_rng([config.seed, 37]).permutation(len(scene.houses)),
        np.cumsum([round(_GONE * len(scene.houses))] * 2),
    )
    before, now = drawn_parts(scene)
    mapped = replace(before, built=_without(before.built, scene, new))
    with TemporaryDirectory() as scratch:
        write_cloud(Path(scratch) / "base.laz", base_map(replace(scene, mapped=mapped.state(scene.site)), config))
        site = BaseMap.build(Path(scratch) / "base.laz")
    return site, scene, level, replace(now, built=_without(now.built, scene, gone))


def _without(built: Sequence[Any], scene: Scene, houses: Ints) -> tuple[Any, ...]:
    left = list(built)
    for house in houses:
        left[scene.houses[house]] = EMPTY
    return tuple(left)


def _drive(config: SimulationConfig, case: str, of: Callable[[], tuple[BaseMap, Scene, Poses, Any]]) -> dict[str, Any]:
    """Drive over a site whose ground has changed, and return counts, errors and levels."""
    site, scene, level, now = of()
    way = level[:, :2, 3]
    risen = partial(CASES[case], way=way)
    scene = replace(scene, now=replace(now, ground=scene.site.mesh(risen)).state(scene.site))
    truth = level.copy()
    truth[:, 2, 3] += risen(way[:, 0], way[:, 1])
    odometry = drifting_odometry(truth, config.odometry, np.random.default_rng([config.seed, 38]))
    localizer, fixes = Localizer(site), []
    for k, points in enumerate(frames(scene, config, truth)):
        fixes.append(localizer.step(points, odometry[k], FRAME_PERIOD * k))
    track = Track.of(fixes, FRAME_PERIOD * np.arange(len(fixes), dtype=np.float64))
    posed = track.tracking
    if not posed.any():
        return dict.fromkeys(("posed", "false", "beyond in the plane", "beyond in height"), 0) | dict.fromkeys(
            ("plane", "height", "plane's level", "height's level", "lean"), np.nan
        )
    off = errors(track, truth)
    plane, height = np.hypot(*off.twist[posed, :2].T), np.abs(off.twist[posed, 2])
    levels = track.levels[posed]
    wrong = (plane > FALSE_METRES) | (off.degrees[posed] > FALSE_DEGREES)
    lean = [np.hypot(fix.calibration.roll, fix.calibration.pitch) for fix in fixes if fix.calibration is not None]
    return {
        "posed": 100.0 * posed.mean(),
        "false": int(wrong.sum()),
        "beyond in the plane": int((plane > levels[:, 2]).sum()),
        "beyond in height": int((height > levels[:, 3]).sum()),
        "plane": float(np.sqrt((plane**2).mean())),
        "height": float(np.sqrt((height**2).mean())),
        "plane's level": float(np.median(levels[:, 2])),
        "height's level": float(np.median(levels[:, 3])),
        "lean": float(np.degrees(max(lean))),
    }


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """One line per file and method, or per site and case."""
    if asked.files:
        heads = (
            ("file", "file", None),
            ("method", "method", None),
            ("I", "I", 2),
            ("II", "II", 2),
            ("total", "total", 2),
        )
        return {"": listed(heads, [row.details for row in rows])}
    columns: tuple[tuple[str, str, int | None], ...] = (
        ("site", "site", None), ("ground since the survey", "case", None), ("posed %", "posed", 0),
        ("false frames", "false", 0), ("beyond the level in the plane", "beyond in the plane", 0),
        ("in height", "beyond in height", 0), ("error in the plane (m)", "plane", 3), ("in height", "height", 3),
        ("level in the plane (m)", "plane's level", 2), ("in height", "height's level", 2), ("lean (deg)", "lean", 2),
    )  # fmt: skip
    return {"": listed(columns, [row.details for row in rows if row.details])}
