"""Descriptors of 10,000 stations over 10 M points beside NumPy and a k-d tree: ``python -m bench map_build``.

Ours rasters the map once and gathers cells. The baseline keeps the highest point of every 0.5 m voxel (with all points
it is several times slower), and for each station bins those within 50 m. It is measured at some stations and scaled to
all, as the row's name says; thinning and the tree count once.

A raster cell counts at its centre, so points within 0.35 m of an edge may move to the next bin. For 2.8 % of the scan
context's bins and 4.9 % of the co-view's that is more than 0.5 m; the means are 0.14 and 0.21 m. With a raster one cell
off it is 4.9 and 7.6 %; with heights 0.3 m off the means are 0.28 and 0.31 m. The bounds lie between.
"""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

import coview_kernels
from bench.harness.rows import Row, against, bounded
from coview_kernels import reference
from coview_stream.basemap.stations import RASTER_CELL, aligned_corner, describe_stations, rasterise
from coview_stream.config import DescriptorConfig
from coview_stream.geometry.arrays import Floats, Floats32, Indices

_BLOCK = 2.0
_SAMPLE = 40  # stations of the baseline
_BOUNDS = {"scan_context": (3.5, 0.2), "coview": (5.1, 0.26)}  # % of the bins that are off, mean difference in metres
_COVERED = 0.2  # share of the ground below boxes: more than there is, so that no station is missing
_BOX, _BOX_EVERY = (8.0, 20.0), 45.0  # metres
_CROWNS_PER_M2 = 0.004


def site(points: int, count: int) -> tuple[Floats32, Floats32]:
    """Points (N, 3) and stations (count, 3) at the centres of blocks, on the ground; metres."""
    cloud = synthetic(points, count, _BLOCK).astype(np.float32)
    side = int(np.ceil(np.sqrt(count)))
    low = np.floor(0.5 * (cloud[:, :2].max(axis=0) - side * _BLOCK) / _BLOCK)
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)[:count]
    xy = (grid + low + 0.5) * _BLOCK
    return cloud, np.column_stack([xy, _terrain(xy)]).astype(np.float32)


def ours(cloud: Floats32, stations: Floats32) -> tuple[float, dict[str, npt.NDArray[np.float16]]]:
    """Seconds, and the channels."""
    config, begin = DescriptorConfig(), time.perf_counter()
    corner = aligned_corner(cloud, _BLOCK, RASTER_CELL)
    raster = rasterise(cloud, corner, RASTER_CELL, config.voxel, int(np.ceil(_BLOCK / RASTER_CELL)))
    described = describe_stations(raster, stations, config)
    return time.perf_counter() - begin, {str(name): values for name, values in described.items()}


def baseline(cloud: Floats32, stations: Floats32, chosen: Indices) -> tuple[float, float, dict[str, Floats32]]:
    """Seconds once, seconds per station, and the channels of the chosen ones."""
    config, begin = DescriptorConfig(), time.perf_counter()
    thin = _highest_of_voxels(cloud, config.voxel)
    tree = cKDTree(thin[:, :2])
    once = time.perf_counter() - begin
    found: dict[str, list[Floats32]] = {"scan_context": [], "coview": []}
    begin = time.perf_counter()
    for station in stations[chosen].astype(np.float64):
        near = thin[tree.query_ball_point(station[:2], config.radius)]
        grid, _ = reference.polar_bin(near, station, config.rings, config.sectors, config.radius)
        found["scan_context"].append(np.where(grid.count > 0, np.maximum(grid.max_height, 0), 0))
        found["coview"].append(reference.coview(grid.max_height, grid.count))
    each = (time.perf_counter() - begin) / len(chosen)
    return once, each, {name: np.stack(values) for name, values in found.items()}


def _highest_of_voxels(cloud: Floats32, voxel: float) -> Floats32:
    cells = np.floor(cloud / np.float32(voxel)).astype(np.int64)
    cells -= cells.min(axis=0)
    spans = cells.max(axis=0) + 1
    key = (cells[:, 0] * spans[1] + cells[:, 1]) * spans[2] + cells[:, 2]
    order = np.lexsort((cloud[:, 2], key))
    last = np.append(key[order][1:] != key[order][:-1], True)
    return np.ascontiguousarray(cloud[order[last]])


def synthetic(points: int, stations: int, block: float) -> Floats:
    """Return a cloud (N, 3), metres, with ground for ``stations`` blocks; an eighth of it are walls."""
    rng = np.random.default_rng(1)
    side = float(np.sqrt(stations / (1 - _COVERED))) * block
    walls = points // 8
    xy = rng.uniform(0, side, (points - walls, 2))
    z = _terrain(xy)
    # one box somewhere in each square of a grid, so none overlap
    centres = np.arange(_BOX_EVERY / 2, side, _BOX_EVERY)
    middles = np.stack(np.meshgrid(centres, centres), axis=-1).reshape(-1, 2)
    middles = middles + rng.uniform(-8, 8, middles.shape)
    sizes, heights = rng.uniform(*_BOX, middles.shape), rng.uniform(4, 14, len(middles))
    faces = []
    for middle, size, height in zip(middles, sizes, heights, strict=True):
        base = float(_terrain(middle[None])[0])
        z[(np.abs(xy - middle) < size / 2).all(axis=1)] = base + height
        count = walls // len(middles)
        along, across = rng.uniform(-0.5, 0.5, count), rng.choice([-0.5, 0.5], count)
        turned = rng.random(count) < 0.5
        face = np.column_stack([np.where(turned, across, along), np.where(turned, along, across)]) * size + middle
        faces.append(np.column_stack([face, base + rng.uniform(0, height, count)]))
    crowns = int(_CROWNS_PER_M2 * side**2)
    trees, radii = rng.uniform(0, side, (crowns, 2)), rng.uniform(1.0, 3.0, crowns)
    order = np.argsort(xy[:, 0])
    sorted_x = xy[order, 0]
    for tree, radius in zip(trees, radii, strict=True):  # half of the points below a crown are lifted into it
        strip = order[slice(*np.searchsorted(sorted_x, [tree[0] - radius, tree[0] + radius]))]
        near = strip[np.hypot(*(xy[strip] - tree).T) < radius]
        lifted = near[rng.random(len(near)) < 0.5]
        z[lifted] = z[lifted] + rng.uniform(2.0, 2.0 + 2 * radius, len(lifted))
    return np.concatenate([np.column_stack([xy, z + rng.normal(0, 0.02, len(z))]), *faces])


def _terrain(xy: Floats) -> Floats:
    return np.asarray(2.0 * np.sin(xy[:, 0] / 37.0) + 1.5 * np.cos(xy[:, 1] / 51.0))


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield the seconds of both and the differences of their descriptors."""
    coview_kernels.warm_up()
    points, count = (1_000_000, 1_000) if asked.quick else (10_000_000, 10_000)
    cloud, stations = site(points, count)
    chosen = np.linspace(0, count - 1, 10 if asked.quick else _SAMPLE).astype(np.intp)
    seconds, described = ours(cloud, stations)
    once, each, expected = baseline(cloud, stations, chosen)
    name = f"map_build, {count} stations, {points / 1e6:.0f} M points"
    extrapolated = f"{name}, baseline extrapolated from {len(chosen)} stations"
    yield against(extrapolated, seconds, once + each * count, "s", 10.0)
    for channel, exact in expected.items():
        mine = described[channel][chosen].astype(np.float32)
        off, (share, mean) = np.abs(mine - exact), _BOUNDS[channel]
        bins = 100 * float((off > 0.5).mean())
        yield bounded(f"{name}, {channel}: bins off by more than 0.5 m", bins, "%", share)
        yield bounded(f"{name}, {channel}: mean difference", float(off.mean()), "m", mean)
