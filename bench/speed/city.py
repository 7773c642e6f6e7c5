"""A city of simulated towns, as a directory of tiles: building, opening and searching it, and the memory of each.

The towns lie side by side in one reference system, each with a survey and a drive. The product's command builds them
with two workers, without features. A process then opens the site and searches for robots that were just switched on.
In a wrong circle no robot may come to a pose.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness.files import PYTHON, environment, fingerprint, folder, isolated, peak_megabytes, remembered
from bench.harness.rows import Row, bounded, informs, judged
from bench.harness.worlds import MAPPER, prepared_run, world_name
from coview_stream import BaseMap, Localizer
from coview_stream.basemap.site.manifest import Manifest
from coview_stream.basemap.site.working_file import working_file, working_path
from coview_stream.clouds import read_tum
from coview_stream.localization.search.hints import PlaceGuess
from coview_stream.recordings.open_run import open_run
from coview_stream.sim import SimulationConfig

SIDE, EDGE, FIRST_SEED = 4, 500.0, 9001
OPEN_S, SEARCH_S = 0.5, 1.0  # targets: to open a site that has its working file, and to find a robot
MEGABYTES, PER_KM2, WORKER_MEGABYTES = 500.0, 40.0, 2000.0  # targets: MB of memory, of disk, of a building process
GROWING = (
    "build, two workers", "memory of a worker, peak", "working file made, the first time", "memory for that, peak",
    "memory, resident at the end",
)  # fmt: skip
ELSEWHERE = (50.0, 240.0)  # metres of circles in another town
_CORNER = (400_000.0, 5_600_000.0, 100.0)
_FRAMES, _DRIVES = 60, 6
_FALSE = 1.0  # metres
_SEARCHING = 0.05  # seconds: a shorter step did not search


def options(parser: ArgumentParser) -> None:
    """Add the size."""
    text = f"towns of 500 m along each edge of the city ({SIDE}); several: their growth, too"
    parser.add_argument("--side", type=int, nargs="+", default=[SIDE], help=text)


def towns(side: int) -> list[SimulationConfig]:
    """Return the towns, row by row."""
    x, y, z = _CORNER
    return [
        SimulationConfig(
            scene="town", seed=FIRST_SEED + number, size=EDGE, length=40.0, density=8.0,
            origin=(x + EDGE * (number % side), y + EDGE * (number // side), z),
        )
        for number in range(side * side)
    ]  # fmt: skip


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield the figures of building, opening and searching, and their growth with the points."""
    sides = [1] if asked.quick else asked.side
    values: dict[str, list[float]] = {}
    for side in sides:
        for row in _figures(side):
            values.setdefault(row.name.partition(": ")[2], []).append(row.ours)
            yield row
    for name in GROWING if len(sides) > 1 else ():
        slope = np.polyfit(np.log10(values["points read"]), np.log10(values[name]), 1)[0]
        yield informs(f"city/slope over the points: {name}", float(slope), "")


def _figures(side: int) -> Iterator[Row]:
    """Yield the figures of one city."""
    below, area = folder() / f"city{side}", side * side * (EDGE / 1e3) ** 2
    worlds = [prepared_run(below, config) for config in towns(side)]
    site, title = below / "site", f"city/{side * side} towns"
    made = {"towns": [world_name(config) for config in towns(side)], "code": fingerprint(*MAPPER)}
    built = remembered(below / "built.json", made, lambda: isolated(_built, worlds, site))
    manifest = Manifest.load(site)
    yield informs(f"{title}: stations", sum(tile.stations for tile in manifest.tiles), "")
    yield informs(f"{title}: points read", built["points"] / 1e6, "million")
    yield informs(f"{title}: build, two workers", built["seconds"], "s")
    yield bounded(f"{title}: memory of a worker, peak", built["megabytes"], "MB", WORKER_MEGABYTES)
    yield bounded(f"{title}: directory, per km2", manifest.nbytes / 1e6 / area, "MB", PER_KM2)
    os.environ["COVIEW_CACHE"] = str(below / "cache")
    first = isolated(_first_opened, site)
    yield informs(f"{title}: working file made, the first time", first["seconds"], "s")
    yield informs(f"{title}: memory for that, peak", first["peak"], "MB")
    found = isolated(_searched, site, worlds[:: max(1, len(worlds) // _DRIVES)][:_DRIVES])
    yield bounded(f"{title}: load", found["load"], "s", OPEN_S)
    yield informs(f"{title}: localizer, and the first robot found, with compilation", found["first"], "s")
    if searches := [step for step in found["steps"] if step > _SEARCHING]:
        yield informs(f"{title}: steps until later robots are found, median", float(np.median(searches)), "s")
        yield bounded(f"{title}: steps until later robots are found, longest", max(searches), "s", SEARCH_S)
    yield bounded(f"{title}: memory, resident at the end", found["VmRSS"], "MB", MEGABYTES)
    yield informs(f"{title}: of it, without pages of files", found["RssAnon"], "MB")
    yield informs(f"{title}: memory, peak", found["VmHWM"], "MB")
    yield informs(f"{title}: robots found in their first {_FRAMES} frames", found["found"], f"of {found['drives']}")
    if side > 1:
        for radius in ELSEWHERE:
            posed, frames = isolated(elsewhere, site, worlds, radius)
            name = f"{title}: robots posed in a circle of {radius:g} m that they are not in, {frames} frames"
            yield judged(name, f"{posed} of {len(worlds)}", "none", posed == 0)
    yield judged(f"{title}: false poses", f"{found['false']} of {found['poses']}", "none", found["false"] == 0)


def _built(worlds: list[Path], site: Path) -> dict[str, float]:
    """Build the site: points read, seconds, and the memory of its largest process."""
    sources = [str(world / "base.laz") for world in worlds]
    words = (*PYTHON, "-m", "coview_stream", "build", *sources, "-o", f"{site}/", "--workers", "2", "--no-learned")
    shutil.rmtree(site, ignore_errors=True)
    begin = time.monotonic()
    subprocess.run(words, env=environment(1), check=True, stdout=sys.stderr)
    seconds = time.monotonic() - begin
    megabytes = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0
    points = int(Manifest.load(site).parameters["source_points"])
    return {"seconds": seconds, "megabytes": megabytes, "points": points}


def _first_opened(site: Path) -> dict[str, float]:
    working_path(Manifest.load(site)).unlink(missing_ok=True)
    begin = time.monotonic()
    working_file(site)
    return {"seconds": time.monotonic() - begin, "peak": peak_megabytes()}


def _searched(site: Path, worlds: list[Path]) -> dict[str, Any]:
    """Find the robots of some drives, one after the other, in this process."""
    begin = time.monotonic()
    base_map = BaseMap.load(site)
    figures: dict[str, Any] = {"load": time.monotonic() - begin, "steps": [], "drives": len(worlds)}
    begin = time.monotonic()
    localizer = Localizer(base_map)
    posed = total = wrong = 0
    for number, world in enumerate(worlds):
        localizer.reset()
        (stamps, truth), known = read_tum(world / "truth.tum"), False
        for frame, _ in zip(open_run(world / "run"), range(_FRAMES), strict=False):
            before = time.monotonic()
            fix = localizer.step(frame.points, frame.T_odom_body, frame.stamp)
            if number and not known:
                figures["steps"].append(time.monotonic() - before)
            if fix.T_map_body is None:
                continue
            if not known:
                known, posed = True, posed + 1
                figures.setdefault("first", time.monotonic() - begin)
            true = truth[np.argmin(np.abs(stamps - frame.stamp))]
            total, wrong = total + 1, wrong + bool(np.linalg.norm(fix.T_map_body[:3, 3] - true[:3, 3]) > _FALSE)
    memory = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
    kept = {name: int(memory[name].split()[0]) / 1024 for name in ("VmRSS", "RssAnon", "VmHWM")}
    return {"first": np.nan} | figures | kept | {"found": posed, "poses": total, "false": wrong}


def elsewhere(site: Path, worlds: Sequence[Path], radius: float) -> tuple[int, int]:
    """Search for each robot in a circle around another one's start: robots that came to a pose, and frames."""
    localizer = Localizer(BaseMap.load(site))
    starts = [read_tum(world / "truth.tum")[1][0][:2, 3] for world in worlds]
    posed = frames = 0
    for number, world in enumerate(worlds):
        localizer.reset()
        x, y = starts[(number + len(worlds) // 2 + 1) % len(worlds)].tolist()
        localizer.guess_place(PlaceGuess(x, y, within=radius))
        poses = 0
        for frame, _ in zip(open_run(world / "run"), range(_FRAMES), strict=False):
            poses += localizer.step(frame.points, frame.T_odom_body, frame.stamp).T_map_body is not None
            frames += 1
        posed += poses > 0
    return posed, frames
