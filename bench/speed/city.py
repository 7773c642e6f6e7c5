"""A city of simulated towns, as a directory of tiles: building, opening and searching it, and the memory that takes.

The towns lie side by side in one reference system, each with a survey and a drive of its own. The product's command
builds them with two workers, without features. Then a process opens the site and searches for the robots of some
drives, each as one that was just switched on; its memory is what the operating system counts, with and without the
pages of files, which the system takes back when it needs them.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness.files import fingerprint, folder, isolated, peak_megabytes, remembered
from bench.harness.pinned import today
from bench.harness.rows import Row, bounded, informs, judged
from bench.harness.worlds import MAPPER, prepared_run, world_name
from coview_stream import BaseMap, Localizer
from coview_stream.basemap.site.manifest import Manifest
from coview_stream.basemap.site.working_file import working_file
from coview_stream.clouds import read_tum
from coview_stream.recordings.open_run import open_run
from coview_stream.sim import SimulationConfig

SIDE, EDGE, FIRST_SEED = 4, 500.0, 9001
OPEN_S, SEARCH_S, MEGABYTES, PER_KM2 = 0.5, 1.0, 500.0, 40.0
"""The targets: seconds to open a site that has its working file, and to find a robot; MB of memory, and of disk."""

_CORNER = (400_000.0, 5_600_000.0, 100.0)
_FRAMES, _DRIVES = 60, 6
_FALSE = 1.0  # metres
_SEARCHING = 0.05  # seconds: a step that took less did not search


def options(parser: ArgumentParser) -> None:
    """Add the size."""
    parser.add_argument("--side", type=int, default=SIDE, help=f"towns of 500 m along each edge of the city ({SIDE})")


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
    """Yield what building took, then what opening and searching take."""
    side = 1 if asked.quick else asked.side
    below = folder() / f"city{side}"
    worlds = [prepared_run(below, config) for config in towns(side)]
    site = below / "site"
    title = f"city/{side * side} towns"
    made = {"towns": [world_name(config) for config in towns(side)], "code": fingerprint(*MAPPER)}
    built = remembered(below / "built.json", made, lambda: _built(worlds, site))
    manifest = Manifest.load(site)
    area = side * side * (EDGE / 1e3) ** 2
    yield informs(f"{title}: stations", sum(tile.stations for tile in manifest.tiles), "")
    yield informs(f"{title}: points", sum(tile.points for tile in manifest.tiles) / 1e6, "million")
    yield informs(f"{title}: build, two workers", built["seconds"], "s")
    yield bounded(f"{title}: directory, per km2", manifest.nbytes / 1e6 / area, "MB", PER_KM2)
    os.environ.setdefault("COVIEW_CACHE", str(below / "cache"))
    first = isolated(_first_opened, site)
    yield informs(f"{title}: working file made, if it was not there", first["seconds"], "s")
    yield informs(f"{title}: memory for that, peak", first["peak"], "MB")
    found = isolated(_searched, site, worlds[:: max(1, len(worlds) // _DRIVES)][:_DRIVES])
    yield bounded(f"{title}: load", found["load"], "s", OPEN_S)
    yield informs(f"{title}: localizer, and the first robot found, with compilation", found["first"], "s")
    searches = [step for step in found["steps"] if step > _SEARCHING] or [np.nan]
    yield informs(f"{title}: steps until later robots are found, median", float(np.median(searches)), "s")
    yield bounded(f"{title}: steps until later robots are found, longest", max(searches), "s", SEARCH_S)
    yield bounded(f"{title}: memory, resident at the end", found["VmRSS"], "MB", MEGABYTES)
    yield informs(f"{title}: of it, without pages of files", found["RssAnon"], "MB")
    yield informs(f"{title}: memory, peak", found["VmHWM"], "MB")
    yield informs(f"{title}: robots found in their first {_FRAMES} frames", found["found"], f"of {found['drives']}")
    yield judged(f"{title}: false poses", f"{found['false']} of {found['poses']}", "none", found["false"] == 0)


def _built(worlds: list[Path], site: Path) -> dict[str, Any]:
    sources = [str(world / "base.laz") for world in worlds]
    words = ("-m", "coview_stream", "build", *sources, "-o", f"{site}/", "--workers", "2", "--no-learned")
    begin = time.monotonic()
    subprocess.run(today().command(*words), env=today().environment(), check=True, stdout=sys.stderr)
    return {"seconds": time.monotonic() - begin}


def _first_opened(site: Path) -> dict[str, float]:
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
