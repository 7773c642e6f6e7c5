"""Errors of two runs, and the distance between their surfaces, with and without ``fuse --joint``.

Two drives of 100 m through one simulated world, each localized on its map, then adjusted jointly. Errors are distances
of the frames' positions from the truth. The distance between the runs is measured from the points of overlapping
submaps to each other's surfaces, half a metre at most. ``map alone`` is the result of ``locate``; ``smoothed`` has the
map and odometry, but no constraint between submaps; ``joint`` has these as well, even where ``fuse`` would not use it.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness.files import folder
from bench.harness.rows import Row, table
from coview_stream.basemap.basemap import BaseMap
from coview_stream.clouds import read_cloud
from coview_stream.clouds.trajectory import read_tum
from coview_stream.fusion.constraints import Registrar, overlapping, submaps_of
from coview_stream.fusion.joint import adjust
from coview_stream.fusion.localized_run import LocalizedRun, RunPair
from coview_stream.localization.offline import locate, write
from coview_stream.localization.registration.clouds import LocalMaps
from coview_stream.recordings.open_run import open_run
from coview_stream.sim import OdometryConfig, SimulationConfig, simulate

_HOLE = 40.0  # metres, radius of the hole in the map about the middle of the first drive
_WORLDS = (("town", "vlp16", 8201), ("village", "vlp16", 8203), ("campus", "os64", 8202))
_CONDITIONS = ("plain", "changed 30 %", "1 pulse per m2", "hole in the map", "odometry drifts x4", "hole, drift x4")
_WAYS = ("map alone", "smoothed", "joint")


def options(parser: ArgumentParser) -> None:
    """Add conditions and worlds."""
    parser.add_argument("--conditions", nargs="+", choices=_CONDITIONS, default=_CONDITIONS)
    parser.add_argument("worlds", nargs="*", metavar="SCENE", help="scenes to look at (all)")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row for each world and condition."""
    chosen = [each for each in _WORLDS if not asked.worlds or each[0] in asked.worlds][: 1 if asked.quick else None]
    for condition in asked.conditions:
        for scene, sensor, seed in chosen:
            plain = SimulationConfig(scene, sensor, seed, size=130.0, length=100.0, speed=3.0)
            figures = measure(configured(plain, condition), "hole" in condition)
            text = ", ".join(f"{way} {figures[way]['rmse']}" for way in _WAYS) if figures else "not localized"
            details = {"world": f"{scene}, {sensor}", "condition": condition, **figures}
            yield Row(f"joint/{condition}, {scene}", text=text, details=details)


def configured(config: SimulationConfig, condition: str) -> SimulationConfig:
    """Return the configuration of a world under a condition."""
    if "changed" in condition:
        return replace(config, changed=0.3)
    if "pulse" in condition:
        return replace(config, density=1.0)
    if "drift" in condition:
        usual = OdometryConfig()
        names = ("yaw_walk", "scale_error", "position_walk", "tilt_noise")
        return replace(config, odometry=replace(usual, **{name: 4.0 * getattr(usual, name) for name in names}))
    return config


def tables(rows: Sequence[Row], _: Namespace) -> dict[str, str]:
    """Lay out a line for each world and condition."""
    heads = ("condition", "world", "frames posed", *(f"{way}: error, cm" for way in _WAYS))
    lines = []
    for figures in (row.details for row in rows):
        cells = [figures["condition"], figures["world"]]
        if "posed" in figures:
            ways = [figures[way] for way in _WAYS]
            cells += [f"{figures['posed']:.0%}", *(way["rmse"] for way in ways), *(way["apart"] for way in ways)]
        lines.append([*cells, *["-"] * (9 - len(cells))])
    return {"": table((*heads, *(f"{way}: apart (p90), cm" for way in _WAYS)), lines)}


def measure(config: SimulationConfig, hole: bool) -> dict[str, Any]:
    """Simulate two drives, localize, adjust and compare; nothing if a run was not localized."""
    places = [_simulated(replace(config, drive_seed=drive)) for drive in (0, 1)]
    cloud = read_cloud(places[0] / "base.laz")
    points = np.asarray(cloud.points, dtype=np.float64)
    if hole:
        driven = read_tum(places[0] / "truth.tum")[1]
        middle = driven[len(driven) // 2, :2, 3] - cloud.origin[:2]
        points = points[np.linalg.norm(points[:, :2] - middle, axis=1) > _HOLE]
    base_map = BaseMap.build(points + cloud.origin)
    base_map.save(places[0] / "now.coview")
    runs, truths = [], []
    for place in places:
        located = locate(base_map, open_run(place / "run"))
        if not located.posed:
            return {}
        out = place / ("out-hole" if hole else "out")
        write(located, base_map, out)
        run = LocalizedRun(RunPair(place / "run", out), base_map, lambda path, mount: open_run(path, mount=mount))
        stamps, truth = read_tum(place / "truth.tum")
        runs.append(run)
        truths.append(truth[np.searchsorted(stamps, run.stamps - 5e-4), :3, 3])
    joint, smoothed = adjust(base_map, runs), adjust(base_map, runs, relative=False)
    submaps = [submap for number, run in enumerate(runs) for submap in submaps_of(run, number, base_map.origin)]
    registrar = Registrar(submaps, LocalMaps(base_map, 40.0))
    pairs = [(k, other) for k, other in overlapping(submaps) if submaps[k].run != submaps[other].run]
    figures: dict[str, Any] = {"posed": sum(map(len, runs)) / sum(len(run) + run.without_pose for run in runs)}
    for way, poses in zip(_WAYS, (joint.located, smoothed.adjusted, joint.adjusted), strict=True):
        errors = [np.linalg.norm(T[:, :3, 3] - truth, axis=1) for T, truth in zip(poses, truths, strict=True)]
        at = np.array([poses[submap.run][submap.index] for submap in submaps])
        at[:, :3, 3] -= base_map.origin
        apart = np.concatenate([np.zeros(0), *(registrar.apart(k, other, at) for k, other in pairs)])
        median, most = np.quantile(apart, [0.5, 0.9]) if len(apart) else (np.nan, np.nan)
        rmse = " / ".join(f"{100 * np.sqrt((error**2).mean()):.1f}" for error in errors)
        figures[way] = {"rmse": rmse, "apart": f"{100 * median:.1f} ({100 * most:.1f})"}
    return figures


def _simulated(config: SimulationConfig) -> Path:
    numbers = (config.seed, config.size, config.length, config.changed, config.density)
    name = "-".join([config.scene, config.sensor, *(f"{number:g}" for number in numbers)])
    place = folder() / f"joint-{name}-{config.odometry.scale_error:g}-{config.drive_seed}"
    if not (place / "world.json").exists():
        place.parent.mkdir(parents=True, exist_ok=True)
        simulate(place, config)
    return place
