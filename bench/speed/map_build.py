"""Descriptors of 10,000 stations over 10 M points beside NumPy and a k-d tree: ``python -m bench map_build``.

Both sides start from the same points and stations and end with both channels of every station. Ours rasters the
map once and gathers cells. The baseline is vectorised: it keeps the highest point of every 0.5 m voxel (what the
density counts, and a tenth of the points: with all of them it is several times slower), puts them into SciPy's
cKDTree, and for each station asks the tree for those within 50 m, bins them in NumPy and finds the co-visible
bins. It is measured at stations spread over the site and scaled to all, as the row's name says; thinning and the
tree count once.

The rows below say how far the results are apart: a raster cell counts at its centre, so points within 0.35 m of
an edge may move to the next bin. For 2.8 % of the scan context's bins and 4.9 % of the co-view's (2.5 and 3.6 with
``--quick``) that is more than 0.5 m; the means are 0.14 and 0.21 m. With a raster one cell off it is 4.9 and 7.6 %
(3.9 and 5.3); with heights 0.3 m off (``--quick``) the means are 0.28 and 0.31 m. The bounds lie between.

The whole build, with reading and ground, is ``python -m bench.build_map``.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from bench.harness.rows import Row, against, bounded, informs
from bench.speed.build_map import synthetic, terrain

_BLOCK = 2.0
_LEAST = 10.0
_SAMPLE = 40
_MOST_OFF = {"scan_context": 3.5, "coview": 5.1}  # % of the bins
_MOST_MEAN = {"scan_context": 0.2, "coview": 0.26}  # metres
Floats = npt.NDArray[np.float32]


def site(points: int, count: int) -> tuple[Floats, Floats]:
    """Points (N, 3) and stations (count, 3) at the centres of blocks, on the ground; metres."""
    cloud = synthetic(points, count, _BLOCK).astype(np.float32)
    side = int(np.ceil(np.sqrt(count)))
    low = np.floor(0.5 * (cloud[:, :2].max(axis=0) - side * _BLOCK) / _BLOCK)
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)[:count]
    xy = (grid + low + 0.5) * _BLOCK
    return cloud, np.column_stack([xy, terrain(xy)]).astype(np.float32)


def ours(cloud: Floats, stations: Floats) -> tuple[float, dict[str, npt.NDArray[np.float16]]]:
    """Seconds, and the channels."""
    from coview_stream.basemap.raster import aligned_corner, rasterise
    from coview_stream.basemap.stations import RASTER_CELL, describe_stations
    from coview_stream.config import DescriptorConfig

    config = DescriptorConfig()
    begin = time.perf_counter()
    corner = aligned_corner(cloud, _BLOCK, RASTER_CELL)
    raster = rasterise(cloud, corner, RASTER_CELL, config.voxel, int(np.ceil(_BLOCK / RASTER_CELL)))
    described = describe_stations(raster, stations, config)
    return time.perf_counter() - begin, {str(name): values for name, values in described.items()}


def highest_of_voxels(cloud: Floats, voxel: float) -> Floats:
    """Return the highest point of each voxel."""
    cells = np.floor(cloud / np.float32(voxel)).astype(np.int64)
    cells -= cells.min(axis=0)
    spans = cells.max(axis=0) + 1
    key = (cells[:, 0] * spans[1] + cells[:, 1]) * spans[2] + cells[:, 2]
    order = np.lexsort((cloud[:, 2], key))
    last = np.append(key[order][1:] != key[order][:-1], True)
    return np.ascontiguousarray(cloud[order[last]])


def baseline(
    cloud: Floats, stations: Floats, chosen: npt.NDArray[np.intp]
) -> tuple[float, float, dict[str, Floats]]:
    """Seconds once, seconds per station, and the channels of the chosen ones."""
    from scipy.spatial import cKDTree

    from coview_kernels import reference
    from coview_stream.config import DescriptorConfig

    config = DescriptorConfig()
    begin = time.perf_counter()
    thin = highest_of_voxels(cloud, config.voxel)
    tree = cKDTree(thin[:, :2])
    once = time.perf_counter() - begin
    found: dict[str, list[Floats]] = {"scan_context": [], "coview": []}
    begin = time.perf_counter()
    for station in stations[chosen].astype(np.float64):
        near = thin[tree.query_ball_point(station[:2], config.radius)]
        grid, _ = reference.polar_bin(near, station, config.rings, config.sectors, config.radius)
        found["scan_context"].append(np.where(grid.count > 0, np.maximum(grid.max_height, 0), 0))
        found["coview"].append(reference.coview(*grid, mode=config.visibility, eye=config.eye))
    each = (time.perf_counter() - begin) / len(chosen)
    return once, each, {name: np.stack(values) for name, values in found.items()}


def rows(quick: bool = False) -> Iterator[Row]:
    """Seconds of both, and the differences of what they describe."""
    import coview_kernels

    coview_kernels.warm_up()
    points, count = (1_000_000, 1_000) if quick else (10_000_000, 10_000)
    cloud, stations = site(points, count)
    chosen = np.linspace(0, count - 1, 10 if quick else _SAMPLE).astype(np.intp)
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
        ours_, theirs = (
            a.reshape(len(chosen), -1) for a in (described[channel][chosen].astype(np.float32), exact)
        )
        cosine = (ours_ * theirs).sum(1) / np.maximum(
            np.linalg.norm(ours_, axis=1) * np.linalg.norm(theirs, axis=1), 1e-9
        )
        yield informs(f"{name}, {channel}: cosine distance, mean", float(1 - cosine.mean()), "")
