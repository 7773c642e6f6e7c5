"""Building of a very large survey: as many points as are asked for, of simulated towns that are laid side by side.

Some towns of 500 x 500 m are surveyed from the air, at a density like that of drones or of several flights; copies of
their files, moved, fill a square. To a build every copy is new ground: tiles are cut elsewhere. (A robot could not be
found among copies; ``bench city`` searches in towns that all differ.)
"""

from __future__ import annotations

import math
import os
import resource
import shutil
import struct
import subprocess
import sys
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.harness.files import fingerprint, folder, isolated, remembered
from bench.harness.pinned import today
from bench.harness.rows import Row, bounded, informs
from bench.harness.worlds import SIMULATOR
from coview_stream.basemap.site.manifest import Manifest
from coview_stream.clouds.files import write_cloud
from coview_stream.sim import SimulationConfig
from coview_stream.sim.simulate import base_map, scene_of

EDGE, FIRST_SEED = 500.0, 9101
WORKER_MEGABYTES = 2000.0
"""The target: MB of a process that builds."""

_CORNER = (400_000.0, 5_600_000.0, 100.0)
_OFFSETS, _EXTENT = 155, 179  # bytes of a LAS header: three offsets; greatest and least x, then y and z


def options(parser: ArgumentParser) -> None:
    """Add sizes."""
    parser.add_argument("--million", type=float, nargs="+", default=[50.0, 200.0], help="points, at least (50 200)")
    parser.add_argument("--density", type=float, default=50.0, help="pulses per square metre (50)")
    parser.add_argument("--towns", type=int, default=4, help="that differ (4)")
    parser.add_argument("--workers", type=int, default=2, help="of the build (2)")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield what each size takes, and how that grows."""
    below = folder() / f"large-{asked.density:g}"
    count = 1 if asked.quick else asked.towns
    towns = [_surveyed(below, number, asked.density) for number in range(count)]
    sizes = [5.0] if asked.quick else asked.million
    found = []
    for million in sizes:
        found.append(isolated(_built, below, towns, million * 1e6, asked.workers))
        yield from _figures(found[-1], asked.workers)
    if len(found) > 1:
        points = np.log10([each["points"] for each in found])
        for name in ("seconds", "megabytes"):
            slope = np.polyfit(points, np.log10([each[name] for each in found]), 1)[0]
            yield informs(f"large_build/slope over the points: {name}", float(slope), "")


def _figures(found: dict[str, float], workers: int) -> Iterator[Row]:
    title = f"large_build/{found['points'] / 1e6:.0f} million points"
    yield informs(f"{title}: area", found["area"] / 1e6, "km2")
    yield informs(f"{title}: kept", found["kept"] / 1e6, "million")
    yield informs(f"{title}: stations", found["stations"], "")
    yield informs(f"{title}: build, {workers} workers", found["seconds"], "s")
    yield informs(f"{title}: points a second and worker", found["points"] / found["seconds"] / workers, "")
    yield bounded(f"{title}: memory of a worker, peak", found["megabytes"], "MB", WORKER_MEGABYTES)
    yield informs(f"{title}: directory, per km2", found["bytes"] / found["area"], "MB")


def _surveyed(below: Path, number: int, density: float) -> dict[str, object]:
    """Return the file of a town's survey and its points; simulate it unless it is there."""
    config = SimulationConfig(scene="town", seed=FIRST_SEED + number, size=EDGE, density=density, origin=_CORNER)
    path = below / f"town{number}.laz"
    below.mkdir(parents=True, exist_ok=True)
    spec = {"world": config.to_dict(), "code": fingerprint(*SIMULATOR)}
    made = remembered(below / f"town{number}.json", spec, lambda: isolated(_survey, path, config))
    return {"path": path, "points": made["points"]}


def _survey(path: Path, config: SimulationConfig) -> dict[str, int]:
    """Write the survey of a town, and return its number of points."""
    points = base_map(scene_of(config), config)
    write_cloud(path, points, origin=config.origin)
    return {"points": len(points)}


def _built(below: Path, towns: list[dict[str, object]], points: float, workers: int) -> dict[str, float]:
    """Build a survey of so many points at least, and tell what that took."""
    sources, site = below / "sources", below / "site"
    for path in (sources, site):
        shutil.rmtree(path, ignore_errors=True)
    sources.mkdir()
    mean = float(np.mean([float(str(town["points"])) for town in towns]))
    tiles = math.ceil(points / mean)
    side = math.ceil(math.sqrt(tiles))
    for number in range(tiles):
        at = EDGE * (number % side), EDGE * (number // side)
        _moved(Path(str(towns[number % len(towns)]["path"])), sources / f"{number:05d}.laz", at)
    words = ("-m", "coview_stream", "build", f"{sources}", "-o", f"{site}/", "--no-learned", "--workers", f"{workers}")
    begin = time.monotonic()
    subprocess.run(today().command(*words), env=today().environment(), check=True, stdout=sys.stderr)
    seconds = time.monotonic() - begin
    megabytes = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0
    manifest = Manifest.load(site)
    found = {
        "seconds": seconds, "megabytes": megabytes, "points": float(manifest.parameters["source_points"]),
        "kept": float(sum(tile.points for tile in manifest.tiles)), "bytes": float(manifest.nbytes),
        "stations": float(sum(tile.stations for tile in manifest.tiles)), "area": tiles * EDGE * EDGE,
    }  # fmt: skip
    for path in (sources, site):
        shutil.rmtree(path, ignore_errors=True)
    return found


def _moved(source: Path, target: Path, by: tuple[float, float]) -> None:
    """Copy a LAS or LAZ file, with its offsets and its extent moved along x and y, metres."""
    shutil.copyfile(source, target)
    with target.open("r+b") as file:
        for axis, metres in enumerate(by):
            for at in (_OFFSETS + 8 * axis, _EXTENT + 16 * axis, _EXTENT + 16 * axis + 8):
                file.seek(at)
                (value,) = struct.unpack("<d", file.read(8))
                file.seek(at)
                file.write(struct.pack("<d", value + metres))
        file.flush()
        os.fsync(file.fileno())
