"""Descriptors of 10,000 stations over 10 M points beside NumPy and a k-d tree: ``python -m bench map_build``.

Both sides start from the same points and stations and end with both channels of every station. Ours rasters the
map once and gathers cells. The baseline is vectorised: it keeps the highest point of every 0.5 m voxel (a tenth of the
points: with all of them it is several times slower), puts them into SciPy's
cKDTree, and for each station asks the tree for those within 50 m, bins them in NumPy and finds the co-visible
bins. It is measured at stations spread over the site and scaled to all, as the row's name says; thinning and the
tree count once.

The rows below say how far the results are apart: a raster cell counts at its centre, so points within 0.35 m of
an edge may move to the next bin. For 2.8 % of the scan context's bins and 4.9 % of the co-view's (2.5 and 3.6 with
``--quick``) that is more than 0.5 m; the means are 0.14 and 0.21 m. With a raster one cell off it is 4.9 and 7.6 %
(3.9 and 5.3); with heights 0.3 m off (``--quick``) the means are 0.28 and 0.31 m. The bounds lie between.

``--whole`` builds a map instead, reading and ground included, and takes its seconds and memory. Without files it makes
a cloud of its own: hills, boxes and round crowns, as many points as asked for on as much ground as the stations need.
"""

from __future__ import annotations

import sys
import tempfile
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np
import numpy.typing as npt

from bench.harness.files import isolated, peak_megabytes
from bench.harness.rows import Row, against, bounded, informs
from coview_stream.geometry.arrays import Floats, Floats32, Indices

_BLOCK = 2.0
_LEAST = 10.0
_SAMPLE = 40
_MOST_OFF = {"scan_context": 3.5, "coview": 5.1}  # % of the bins
_MOST_MEAN = {"scan_context": 0.2, "coview": 0.26}  # metres


def site(points: int, count: int) -> tuple[Floats32, Floats32]:
    """Points (N, 3) and stations (count, 3) at the centres of blocks, on the ground; metres."""
    cloud = synthetic(points, count, _BLOCK).astype(np.float32)
    side = int(np.ceil(np.sqrt(count)))
    low = np.floor(0.5 * (cloud[:, :2].max(axis=0) - side * _BLOCK) / _BLOCK)
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)[:count]
    xy = (grid + low + 0.5) * _BLOCK
    return cloud, np.column_stack([xy, terrain(xy)]).astype(np.float32)


def ours(cloud: Floats32, stations: Floats32) -> tuple[float, dict[str, npt.NDArray[np.float16]]]:
    """Seconds, and the channels."""
    from coview_stream.basemap.stations import RASTER_CELL, aligned_corner, describe_stations, rasterise
    from coview_stream.config import DescriptorConfig

    config = DescriptorConfig()
    begin = time.perf_counter()
    corner = aligned_corner(cloud, _BLOCK, RASTER_CELL)
    raster = rasterise(cloud, corner, RASTER_CELL, config.voxel, int(np.ceil(_BLOCK / RASTER_CELL)))
    described = describe_stations(raster, stations, config)
    return time.perf_counter() - begin, {str(name): values for name, values in described.items()}


def highest_of_voxels(cloud: Floats32, voxel: float) -> Floats32:
    """Return the highest point of each voxel."""
    cells = np.floor(cloud / np.float32(voxel)).astype(np.int64)
    cells -= cells.min(axis=0)
    spans = cells.max(axis=0) + 1
    key = (cells[:, 0] * spans[1] + cells[:, 1]) * spans[2] + cells[:, 2]
    order = np.lexsort((cloud[:, 2], key))
    last = np.append(key[order][1:] != key[order][:-1], True)
    return np.ascontiguousarray(cloud[order[last]])


def baseline(cloud: Floats32, stations: Floats32, chosen: Indices) -> tuple[float, float, dict[str, Floats32]]:
    """Seconds once, seconds per station, and the channels of the chosen ones."""
    from scipy.spatial import cKDTree

    from coview_kernels import reference
    from coview_stream.config import DescriptorConfig

    config = DescriptorConfig()
    begin = time.perf_counter()
    thin = highest_of_voxels(cloud, config.voxel)
    tree = cKDTree(thin[:, :2])
    once = time.perf_counter() - begin
    found: dict[str, list[Floats32]] = {"scan_context": [], "coview": []}
    begin = time.perf_counter()
    for station in stations[chosen].astype(np.float64):
        near = thin[tree.query_ball_point(station[:2], config.radius)]
        grid, _ = reference.polar_bin(near, station, config.rings, config.sectors, config.radius)
        found["scan_context"].append(np.where(grid.count > 0, np.maximum(grid.max_height, 0), 0))
        found["coview"].append(reference.coview(*grid))
    each = (time.perf_counter() - begin) / len(chosen)
    return once, each, {name: np.stack(values) for name, values in found.items()}


def described_stations(asked: Namespace) -> Iterator[Row]:
    """Seconds of both, and the differences of what they describe."""
    import coview_kernels

    coview_kernels.warm_up()
    points, count = (1_000_000, 1_000) if asked.quick else (10_000_000, 10_000)
    cloud, stations = site(points, count)
    chosen = np.linspace(0, count - 1, 10 if asked.quick else _SAMPLE).astype(np.intp)
    seconds, described = ours(cloud, stations)
    once, each, expected = baseline(cloud, stations, chosen)
    name = f"map_build, {count} stations, {points / 1e6:.0f} M points"
    extrapolated = f"{name}, baseline extrapolated from {len(chosen)} stations"
    yield against(extrapolated, seconds, once + each * count, "s", _LEAST)
    for channel, exact in expected.items():
        off = np.abs(described[channel][chosen].astype(np.float32) - exact)
        share, most = 100 * float((off > 0.5).mean()), _MOST_OFF[channel]
        yield bounded(f"{name}, {channel}: bins off by more than 0.5 m", share, "%", most)
        yield bounded(f"{name}, {channel}: mean difference", float(off.mean()), "m", _MOST_MEAN[channel])
        flat = (described[channel][chosen].astype(np.float32), exact)
        mine, theirs = (each.reshape(len(chosen), -1) for each in flat)
        lengths = np.linalg.norm(mine, axis=1) * np.linalg.norm(theirs, axis=1)
        cosine = (mine * theirs).sum(axis=1) / np.maximum(lengths, 1e-9)
        yield informs(f"{name}, {channel}: cosine distance, mean", float(1 - cosine.mean()), "")


MOST_SECONDS, MOST_MEGABYTES = 180.0, 4096.0  # the target for 10 M points and 10,000 stations, on two cores
_COVERED = 0.2  # share of the ground below boxes: more than there is, so that no station is missing
_BOX, _BOX_EVERY = (8.0, 20.0), 45.0  # metres
_CROWNS_PER_M2 = 0.004


def synthetic(points: int, stations: int, block: float, seed: int = 1) -> Floats:
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


def terrain(xy: Floats) -> Floats:
    """Height of the ground at (N, 2), metres."""
    return np.asarray(2.0 * np.sin(xy[:, 0] / 37.0) + 1.5 * np.cos(xy[:, 1] / 51.0))


def _boxes(rng: np.random.Generator, side: float) -> Floats:
    """Boxes (B, 5): centre, width, depth, height; one somewhere in each square of a grid, so none overlap."""
    centres = np.arange(_BOX_EVERY / 2, side, _BOX_EVERY)
    grid = np.stack(np.meshgrid(centres, centres), axis=-1).reshape(-1, 2)
    grid = grid + rng.uniform(-8, 8, grid.shape)
    size = rng.uniform(*_BOX, grid.shape)
    return np.column_stack([grid, size, rng.uniform(4, 14, len(grid))])


def _wall(rng: np.random.Generator, count: int, box: Any, base: float) -> Floats:
    x, y, width, depth, height = box
    along, side = rng.uniform(-0.5, 0.5, count), rng.choice([-0.5, 0.5], count)
    faces_x = rng.random(count) < 0.5
    px = np.where(faces_x, side, along) * width + x
    py = np.where(faces_x, along, side) * depth + y
    return np.column_stack([px, py, base + rng.uniform(0, height, count)])


def _grow(rng: np.random.Generator, xy: Floats, z: Floats, side: float) -> None:
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
        "file_megabytes": out.stat().st_size / 1e6,
    }


def _steps(module: ModuleType) -> dict[str, FunctionType]:
    """Functions of other modules that ``module`` calls: the stages, by the names they have."""
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


def options(parser: ArgumentParser) -> None:
    """Add the clouds, or how large a synthetic one is."""
    parser.add_argument("--whole", action="store_true", help="build a whole map instead: its seconds and memory")
    parser.add_argument("files", nargs="*", type=Path, help="clouds to build the whole from, not a synthetic one")
    parser.add_argument("--points", type=float, default=10e6, help="points of the synthetic cloud (10e6)")
    parser.add_argument("--stations", type=int, default=10_000, help="at least so many stations (10000)")
    parser.add_argument("--block", type=float, default=2.0, help="metres between stations (2)")


def whole_build(asked: Namespace) -> Iterator[Row]:
    """Build a map once; a row per stage, and the whole with its targets."""
    points, stations = (1e6, 1000) if asked.quick else (asked.points, asked.stations)
    with tempfile.TemporaryDirectory() as folder:
        files = asked.files or [Path(folder) / "synthetic.laz"]
        if not asked.files:
            print(f"making {points / 1e6:.1f} M points ...", file=sys.stderr, flush=True)
            # in a process of its own: a child starts with its parent's peak memory
            isolated(write_synthetic, files[0], int(points), stations, asked.block)
        print("building ...", file=sys.stderr, flush=True)
        found = isolated(build, files, Path(folder) / "site.coview", asked.block)
    other = found["seconds"] - sum(found["stages"].values())
    for stage, seconds in (found["stages"] | {"other": other}).items():
        yield informs(f"build_map/{stage}", seconds, "s")
    yield bounded("build_map/total", found["seconds"], "s", MOST_SECONDS)
    yield bounded("build_map/peak memory", found["megabytes"], "MB", MOST_MEGABYTES)
    yield informs("build_map/points", found["source_points"] / 1e6, "M")
    yield informs("build_map/points after cleaning", found["points"] / 1e6, "M")
    yield informs("build_map/stations", found["stations"], "")
    yield informs("build_map/size of the file", found["file_megabytes"], "MB")
    yield informs("build_map/opening it", found["open_s"], "s")


def rows(asked: Namespace) -> Iterator[Row]:
    """Describe stations, or build the whole."""
    yield from (whole_build if asked.whole or asked.files else described_stations)(asked)
