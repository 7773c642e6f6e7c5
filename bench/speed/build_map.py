"""Seconds and memory of building a base map: ``python -m bench.build_map [FILE ...] [--points N]``.

Without files it makes a cloud of its own: hills, boxes and round crowns, as many points as asked for on as
much ground as the stations need. Exit code 1 if the map takes longer, or more memory, than the target says.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np
import numpy.typing as npt

from bench.harness.tables import number, table
from bench.harness.worlds import fingerprint, isolated, peak_megabytes

MOST_SECONDS, MOST_MEGABYTES = 180.0, 4096.0
"""The target for 10 M points and 10,000 stations, on two cores."""

_COVERED = 0.2  # share of the ground below boxes: more than there is, lest stations fall short
_BOX, _BOX_EVERY = (8.0, 20.0), 45.0  # metres
_CROWNS_PER_M2 = 0.004
Cloud = npt.NDArray[np.float64]


def synthetic(points: int, stations: int, block: float, seed: int = 1) -> Cloud:
    """Return a cloud (N, 3), metres, with ground for ``stations`` blocks; an eighth of it are walls."""
    rng = np.random.default_rng(seed)
    side = float(np.sqrt(stations / (1 - _COVERED))) * block
    walls = points // 8
    xy = rng.uniform(0, side, (points - walls, 2))
    z = terrain(xy)
    wall_parts = []
    boxes = _boxes(rng, side)
    for x, y, width, depth, height in boxes:
        inside = (np.abs(xy[:, 0] - x) < width / 2) & (np.abs(xy[:, 1] - y) < depth / 2)
        base = float(terrain(np.array([[x, y]]))[0])
        z[inside] = base + height
        wall_parts.append(_wall(rng, walls // len(boxes), (x, y, width, depth, height), base))
    _grow(rng, xy, z, side)
    seen = np.column_stack([xy, z + rng.normal(0, 0.02, len(z))])
    return np.concatenate([seen, *wall_parts])


def terrain(xy: Cloud) -> Cloud:
    """Height of the ground at (N, 2), metres."""
    return np.asarray(2.0 * np.sin(xy[:, 0] / 37.0) + 1.5 * np.cos(xy[:, 1] / 51.0))


def _boxes(rng: np.random.Generator, side: float) -> Cloud:
    """Boxes (B, 5): centre, width, depth, height; one somewhere in each square of a grid, so none overlap."""
    centres = np.arange(_BOX_EVERY / 2, side, _BOX_EVERY)
    grid = np.stack(np.meshgrid(centres, centres), axis=-1).reshape(-1, 2)
    grid = grid + rng.uniform(-8, 8, grid.shape)
    size = rng.uniform(*_BOX, grid.shape)
    return np.column_stack([grid, size, rng.uniform(4, 14, len(grid))])


def _wall(rng: np.random.Generator, count: int, box: Any, base: float) -> Cloud:
    x, y, width, depth, height = box
    along, side = rng.uniform(-0.5, 0.5, count), rng.choice([-0.5, 0.5], count)
    faces_x = rng.random(count) < 0.5
    px = np.where(faces_x, side, along) * width + x
    py = np.where(faces_x, along, side) * depth + y
    return np.column_stack([px, py, base + rng.uniform(0, height, count)])


def _grow(rng: np.random.Generator, xy: Cloud, z: Cloud, side: float) -> None:
    """Lift half of the points below each crown into it."""
    count = int(_CROWNS_PER_M2 * side**2)
    centres, radii = rng.uniform(0, side, (count, 2)), rng.uniform(1.0, 3.0, count)
    order = np.argsort(xy[:, 0])
    sorted_x = xy[order, 0]
    for centre, radius in zip(centres, radii, strict=True):
        strip = order[slice(*np.searchsorted(sorted_x, [centre[0] - radius, centre[0] + radius]))]
        near = strip[np.hypot(*(xy[strip] - centre).T) < radius]
        lifted = near[rng.random(len(near)) < 0.5]
        z[lifted] = z[lifted] + rng.uniform(2.0, 2.0 + 2 * radius, len(lifted))


def write_synthetic(path: Path, points: int, stations: int, block: float) -> None:
    """Write :func:`synthetic` to ``path``."""
    from coview_stream.clouds import write_cloud

    write_cloud(path, synthetic(points, stations, block))


def build(files: Sequence[Path], out: Path, block: float) -> dict[str, Any]:
    """Build and save a map; seconds of every stage and all, sizes, peak memory. Meant for a fresh process."""
    from coview_stream import BaseMap
    from coview_stream.basemap import build as module

    stages: dict[str, float] = {}
    clocks: Any = {name: _timed(name, work, stages) for name, work in _steps(module).items()}
    with patch.multiple(module, **clocks):
        begin = time.perf_counter()
        base_map = BaseMap.build(files, block=block)
        built = time.perf_counter()
    base_map.save(out)
    saved = time.perf_counter()
    peak = peak_megabytes()
    BaseMap.load(out)
    return {
        "source_points": base_map.parameters["source_points"],
        "points": len(base_map.points),
        "stations": len(base_map),
        "stages": stages | {"save": saved - built},
        "seconds": saved - begin,
        "open_s": time.perf_counter() - saved,
        "megabytes": peak,
        "code": fingerprint(),
        "file_megabytes": out.stat().st_size / 1e6,
    }


def _steps(module: ModuleType) -> dict[str, FunctionType]:
    """Functions of other modules that ``module`` calls: the stages, whatever they come to be called."""
    functions = {name: f for name, f in vars(module).items() if isinstance(f, FunctionType)}
    ours = {name: f for name, f in functions.items() if f.__module__.startswith("coview_stream.")}
    return {name: f for name, f in ours.items() if f.__module__ != module.__name__}


def _timed(name: str, work: Callable[..., Any], stages: dict[str, float]) -> Callable[..., Any]:
    def timed(*args: Any, **named: Any) -> Any:
        begin = time.perf_counter()
        try:
            return work(*args, **named)
        finally:
            stages[name] = stages.get(name, 0.0) + time.perf_counter() - begin

    return timed


def report(found: dict[str, Any]) -> str:
    """Lay out stages and verdict."""
    stages = dict(found["stages"])
    stages["other"] = found["seconds"] - sum(stages.values())
    rows = [(name, number(seconds, 1)) for name, seconds in [*stages.items(), ("total", found["seconds"])]]
    met = found["seconds"] < MOST_SECONDS and found["megabytes"] < MOST_MEGABYTES
    return "\n".join([
        table(("stage", "seconds"), rows),
        "",
        f"{found['source_points'] / 1e6:.2f} M points, {found['points'] / 1e6:.2f} M after cleaning, "
        f"{found['stations']} stations",
        f"the file has {found['file_megabytes']:.0f} MB and opens in {found['open_s']:.2f} s",
        f"{found['seconds']:.0f} s (< {MOST_SECONDS:.0f}), peak {found['megabytes']:.0f} MB "
        f"(< {MOST_MEGABYTES:.0f}): {'met' if met else 'MISSED'}",
        f"Code {found['code']}, {time.strftime('%Y-%m-%d')}.",
    ])  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(prog="python -m bench.build_map", description=__doc__)
    parser.add_argument(
        "files", nargs="*", type=Path, help="clouds to build from, instead of a synthetic one"
    )
    parser.add_argument("--points", type=float, default=10e6, help="points of the synthetic cloud (10e6)")
    parser.add_argument("--stations", type=int, default=10_000, help="at least so many stations (10000)")
    parser.add_argument("--block", type=float, default=2.0, help="metres between stations (2)")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        files = options.files
        if not files:
            files = [Path(folder) / "synthetic.laz"]
            print(f"making {options.points / 1e6:.1f} M points ...", file=sys.stderr, flush=True)
            # in a process of its own: a child starts with its parent's peak memory
            isolated(write_synthetic, files[0], int(options.points), options.stations, options.block)
        print("building ...", file=sys.stderr, flush=True)
        found = isolated(build, files, Path(folder) / "site.coview", options.block)
    print(report(found))
    return 0 if found["seconds"] < MOST_SECONDS and found["megabytes"] < MOST_MEGABYTES else 1


if __name__ == "__main__":
    sys.exit(main())
