"""A city of simulated towns, as a directory of tiles: building, opening and searching it, and the memory that takes.

The towns lie side by side in one reference system, each with a survey and a drive of its own. The product's command
builds them with two workers, without features. Then a process opens the site and searches for the robots of some
drives, each as one that was just switched on; its memory is what the operating system counts, with and without the
pages of files, which the system takes back when it needs them.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness.files import fingerprint, folder, isolated, peak_megabytes, remembered, today
from bench.harness.rows import Row, bounded, informs, judged
from bench.harness.worlds import MAPPER, prepared_run, world_name
from bench.speed import city_votes
from coview_stream import BaseMap, Localizer
from coview_stream.basemap.site.manifest import Manifest
from coview_stream.basemap.site.working_file import working_file, working_path
from coview_stream.clouds import read_tum
from coview_stream.recordings.open_run import open_run
from coview_stream.sim import SimulationConfig

SIDE, EDGE, FIRST_SEED = 4, 500.0, 9001
OPEN_S, SEARCH_S, MEGABYTES, PER_KM2, WORKER_MEGABYTES = 0.5, 1.0, 500.0, 40.0, 2000.0
"""The targets: seconds to open a site that has its working file, and to find a robot; MB of memory, of disk, and of a
process that builds."""

_CORNER = (400_000.0, 5_600_000.0, 100.0)
_FRAMES, _DRIVES = 60, 6
_FALSE = 1.0  # metres
_SEARCHING = 0.05  # seconds: a step that took less did not search


def options(parser: ArgumentParser) -> None:
    """Add the size."""
    words = f"towns of 500 m along each edge of the city ({SIDE}); several: how all grows, too"
    parser.add_argument("--side", type=int, nargs="+", default=[SIDE], help=words)


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
    """Yield what building, opening and searching take, and how they grow with the points."""
    sides = [1] if asked.quick else asked.side
    found: dict[int, dict[str, float]] = {side: {} for side in sides}
    for side in sides:
        yield from _figures(side, found[side])
    if len(sides) > 1:
        points = np.log10([found[side]["points"] for side in sides])
        for name in found[sides[0]]:
            if name != "points":
                slope = np.polyfit(points, np.log10([found[side][name] for side in sides]), 1)[0]
                yield informs(f"city/slope over the points: {name}", float(slope), "")


def _figures(side: int, found: dict[str, float]) -> Iterator[Row]:
    """Yield the figures of one city, and keep those that grow."""
    below = folder() / f"city{side}"
    worlds = [prepared_run(below, config) for config in towns(side)]
    site = below / "site"
    title = f"city/{side * side} towns"
    made = {"towns": [world_name(config) for config in towns(side)], "code": fingerprint(*MAPPER)}
    built = remembered(below / "built.json", made, lambda: isolated(_built, worlds, site))
    manifest = Manifest.load(site)
    area = side * side * (EDGE / 1e3) ** 2
    found["points"] = float(built["points"])
    found["build, seconds"] = built["seconds"]
    found["build, memory"] = built["megabytes"]
    yield informs(f"{title}: stations", sum(tile.stations for tile in manifest.tiles), "")
    yield informs(f"{title}: points read", built["points"] / 1e6, "million")
    yield informs(f"{title}: build, two workers", built["seconds"], "s")
    yield informs(f"{title}: points a second and worker", built["points"] / built["seconds"] / 2.0, "")
    yield bounded(f"{title}: memory of a worker, peak", built["megabytes"], "MB", WORKER_MEGABYTES)
    yield bounded(f"{title}: directory, per km2", manifest.nbytes / 1e6 / area, "MB", PER_KM2)
    os.environ["COVIEW_CACHE"] = str(below / "cache")
    first = remembered(
        below / "first.json", {"site": manifest.sha256, "code": fingerprint()}, lambda: isolated(_first_opened, site)
    )
    found["first opening, seconds"], found["first opening, memory"] = first["seconds"], first["peak"]
    yield informs(f"{title}: working file made, the first time", first["seconds"], "s")
    yield informs(f"{title}: memory for that, peak", first["peak"], "MB")
    seen = isolated(_searched, site, worlds[:: max(1, len(worlds) // _DRIVES)][:_DRIVES])
    yield bounded(f"{title}: load", seen["load"], "s", OPEN_S)
    yield informs(f"{title}: localizer, and the first robot found, with compilation", seen["first"], "s")
    if searches := [step for step in seen["steps"] if step > _SEARCHING]:
        found["search, seconds"] = float(np.median(searches))
        yield informs(f"{title}: steps until later robots are found, median", found["search, seconds"], "s")
        yield bounded(f"{title}: steps until later robots are found, longest", max(searches), "s", SEARCH_S)
    found["search, memory"] = seen["VmRSS"]
    yield bounded(f"{title}: memory, resident at the end", seen["VmRSS"], "MB", MEGABYTES)
    yield informs(f"{title}: of it, without pages of files", seen["RssAnon"], "MB")
    yield informs(f"{title}: memory, peak", seen["VmHWM"], "MB")
    yield informs(f"{title}: robots found in their first {_FRAMES} frames", seen["found"], f"of {seen['drives']}")
    if side > 1:
        yield from city_votes.rows(title, isolated(city_votes.voted, site, worlds))
        for radius in city_votes.ELSEWHERE:
            yield city_votes.wrong_circle_row(title, isolated(city_votes.elsewhere, site, worlds, radius))
    yield judged(f"{title}: false poses", f"{seen['false']} of {seen['poses']}", "none", seen["false"] == 0)


def _built(worlds: list[Path], site: Path) -> dict[str, float]:
    """Build the site, and tell how many points that read, its seconds, and the memory of its largest process."""
    sources = [str(world / "base.laz") for world in worlds]
    words = ("-m", "coview_stream", "build", *sources, "-o", f"{site}/", "--workers", "2", "--no-learned")
    shutil.rmtree(site, ignore_errors=True)
    begin = time.monotonic()
    subprocess.run(today().command(*words), env=today().environment(), check=True, stdout=sys.stderr)
    seconds = time.monotonic() - begin
    megabytes = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0
    points = int(Manifest.load(site).parameters["source_points"])
    return {"seconds": seconds, "megabytes": megabytes, "points": points}


def _first_opened(site: Path) -> dict[str, float]:
    working_path(site).unlink(missing_ok=True)
    begin = time.monotonic()
    working_file(site)
    return {"seconds": time.monotonic() - begin, "peak": peak_megabytes()}


def _searched(site: Path, worlds: list[Path]) -> dict[str, Any]:
    """Find the robots of some drives, one after the other, in this process."""
    begin = time.monotonic()
    base_map = BaseMap.load(site)
    found: dict[str, Any] = {"load": time.monotonic() - begin, "steps": [], "drives": len(worlds)}
    begin = time.monotonic()
    localizer = Localizer(base_map)
    posed = total = wrong = 0
    for number, world in enumerate(worlds):
        localizer.reset()
        run, (stamps, truth) = open_run(world / "run"), read_tum(world / "truth.tum")
        known = False
        for frame, _ in zip(run, range(_FRAMES), strict=False):
            before = time.monotonic()
            fix = localizer.step(frame.points, frame.T_odom_body, frame.stamp)
            if number and not known:
                found["steps"].append(time.monotonic() - before)
            if fix.T_map_body is None:
                continue
            if not known:
                known, posed = True, posed + 1
                found.setdefault("first", time.monotonic() - begin)
            true = truth[np.argmin(np.abs(stamps - frame.stamp))]
            off = np.linalg.norm(fix.T_map_body[:3, 3] - true[:3, 3])
            total, wrong = total + 1, wrong + bool(off > _FALSE)
    memory = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
    kept = {name: int(memory[name].split()[0]) / 1024 for name in ("VmRSS", "RssAnon", "VmHWM")}
    return {"first": np.nan} | found | kept | {"found": posed, "poses": total, "false": wrong}
