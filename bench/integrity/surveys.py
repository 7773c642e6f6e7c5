"""Real airborne surveys as worlds: the map is one half of a square of a survey, a robot drives in the other half.

The halves are two flight strips where both cover the square, else every other point by chance. The world stands on the
ground points of its half, with columns of 0.75 m wherever that half has points higher than 1.5 m: solid where every
pulse had one return, else foliage above a third of its height. Robots drive where 3 m are free, near such columns.
Surveys are ``surveys/*.laz`` below ``COVIEW_DATA``, in metres, with classes, returns and strips. Walls are stairs of
cells, and both halves are of one flight: errors below half a metre say little.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from bench.harness.files import data
from bench.integrity.sites import there_and_back
from coview_stream.clouds.las import require_laspy
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Bools, Floats, Ints
from coview_stream.sim.layout import Site
from coview_stream.sim.mesh import Mesh, box, copies, height_field, join
from coview_stream.sim.scenes import Scene, SceneState

KINDS = ("survey", "gap", "twice")
"""The map of a square as it is; without all that is near the drive; with a copy of the block around the drive."""

SIZE, MARGIN = 240.0, 50.0  # metres, side of a map, and the world beyond it
_APART = SIZE + 2 * MARGIN  # metres between the middles of a map and of a drive outside it
_GAP, _BLOCK = 40.0, 80.0  # metres from the drive, and the side of a block
_HALF = SIZE / 2 + MARGIN

_CELL = 0.75  # metres; a way has steps of two cells
_LOW, _HIGH, _FREE, _NEAR = 1.5, 45.0, 3.0, 15.0  # metres
_STEEP = 0.2  # slope that no robot drives
_WAY = 60.0  # metres of a way at least, driven to and fro
_RASTER = 10.0  # metres, of the cells that say
_COVERED, _UPRIGHT = 0.95, 0.3  # which share of a square is surveyed at least, and has points above the ground
_TRIES = 500
_GROUND = 2  # class of LAS
_SQUARE, _HALVES, _ROUTE = 250, 251, 252  # random streams


class Survey(NamedTuple):
    """Points of a survey: (N, 3) metres, and for each its class, the returns of its pulse, and its strip."""

    xyz: Floats
    label: Ints
    returns: Ints
    strip: Ints

    def chosen(self, rows: Bools) -> Survey:
        """Return some of them."""
        return Survey(*(column[rows] for column in self))


def files() -> list[Path]:
    """Return the surveys that are there."""
    return sorted(data().glob("surveys/*.laz"))


@lru_cache(maxsize=2)
def _read(file: Path) -> Survey:
    las = require_laspy().read(file)
    xyz = np.asarray(las.xyz, dtype=np.float64)
    names = ("classification", "number_of_returns", "point_source_id")
    return Survey(xyz - np.floor(xyz.min(axis=0)), *(np.asarray(getattr(las, name)) for name in names))


@lru_cache(maxsize=8)
def _rasters(file: Path) -> tuple[Bools, Bools]:
    """Return by cells of 10 m (x, y) where the survey has points, and where some of them are not ground."""
    survey = _read(file)
    at, out = (survey.xyz[:, :2] / _RASTER).astype(int), []
    for rows in (slice(None), survey.label != _GROUND):
        raster = np.zeros(at.max(axis=0) + 1, bool)
        raster[at[rows, 0], at[rows, 1]] = True
        out.append(raster)
    return out[0], out[1]


@lru_cache(maxsize=8)
def _place(seed: int, apart: int | None) -> tuple[Path, Floats, float]:
    """Return the survey of a square, its middle (2,) there, and its heading; it does not reach the square ``apart``."""
    rng, other = np.random.default_rng([seed, _SQUARE]), None if apart is None else _place(apart, None)
    area = np.array([_rasters(file)[0].sum() for file in files()])
    for _ in range(_TRIES):
        file = files()[int(rng.choice(len(area), p=area / area.sum()))]
        covered, high = _rasters(file)
        yaw = float(rng.uniform(0.0, 2 * np.pi))
        middle = rng.uniform(SIZE / 2, np.maximum(np.multiply(covered.shape, _RASTER) - SIZE / 2, SIZE / 2 + 1.0))
        if other is not None and file == other[0] and np.abs(middle - other[1]).max() < _APART:
            continue
        x, y = (slice(int((at - SIZE / 2) / _RASTER), int((at + SIZE / 2) / _RASTER)) for at in middle)
        if covered[x, y].mean() > _COVERED and high[x, y].mean() > _UPRIGHT:
            return file, middle, yaw
    raise InputError(f"no square of {SIZE:g} m of {', '.join(map(str, files()))} has enough that stands on it")


def place_of(seed: int) -> Path:
    """Return the survey of a square."""
    return _place(seed, None)[0]


def block_of(seed: int) -> str:
    """Return the block of the survey, one square large, that a square's middle is in."""
    file, middle, _ = _place(seed, None)
    return f"{file.stem} {middle[0] // SIZE:.0f} {middle[1] // SIZE:.0f}"


def _cells(xyz: Floats, size: float) -> int:
    return len(np.unique(np.floor(xyz[:, :2] / size), axis=0))


@lru_cache(maxsize=2)
def _square(seed: int, apart: int | None) -> tuple[Survey, Bools]:
    """Return the points of a square and around it, its middle at zero, and which of them are the map's half."""
    file, middle, yaw = _place(seed, apart)
    every = _read(file)
    near = every.chosen((np.abs(every.xyz[:, :2] - middle) < np.sqrt(2) * _HALF).all(axis=1))
    c, s = np.cos(yaw), np.sin(yaw)
    xyz = near.xyz - [*middle, np.median(near.xyz[near.label == _GROUND, 2])]
    xyz[:, :2] = xyz[:, :2] @ np.array([[c, s], [-s, c]])
    some = near._replace(xyz=xyz).chosen((np.abs(xyz[:, :2]) < _HALF).all(axis=1))
    names, counts = np.unique(some.strip, return_counts=True)
    two = names[np.argsort(-counts)[:2]]
    if min(_cells(some.xyz[some.strip == name], 10.0) for name in two) > 0.95 * _cells(some.xyz, 10.0) and len(two) > 1:
        some = some.chosen(np.isin(some.strip, two))
        return some, np.asarray(some.strip == two[0])
    return some, np.asarray(np.random.default_rng([seed, _HALVES]).random(len(some.xyz)) < 0.5)


class Ground(Site):
    """Ground of a survey; it has no streets."""

    def __init__(self, axis: Floats, heights: Floats) -> None:
        self.half, self._axis, self._heights = float(axis[-1]), axis, heights


@lru_cache(maxsize=2)
def _stage(seed: int, apart: int | None) -> tuple[Floats, Floats, SceneState, Bools]:
    """Return a square's axis and heights, all that stands on its other half, and where a robot may drive."""
    points, of_map = _square(seed, apart)
    seen = points.chosen(~of_map)
    count = int(2 * _HALF / _CELL)
    axis = (np.arange(count) + 0.5) * _CELL - _HALF
    i, j = np.clip(((seen.xyz[:, :2] + _HALF) / _CELL).astype(int), 0, count - 1).T
    low, top, returns = np.full((count, count), np.inf), np.zeros((count, count)), np.zeros((count, count))
    ground = seen.label == _GROUND
    np.minimum.at(low, (i[ground], j[ground]), seen.xyz[ground, 2])
    nearest = ndimage.distance_transform_edt(np.isinf(low), return_distances=False, return_indices=True)
    heights = ndimage.uniform_filter(low[tuple(nearest)], 5)
    up = seen.xyz[:, 2] - heights[i, j]
    high = ~ground & (up > _LOW) & (up < _HIGH)
    np.maximum.at(top, (i[high], j[high]), up[high])
    np.maximum.at(returns, (i[high], j[high]), seen.returns[high])
    top = ndimage.grey_closing(top, 3)
    stands, leafy = top > _LOW, ndimage.maximum_filter(returns, 3) > 1
    solid = _columns(axis, heights - 1.0, heights + top, stands & ~leafy)
    leaves = _columns(axis, heights + np.where(top > 4.0, 0.35 * top, 0.0), heights + top, stands & leafy)
    away = ndimage.distance_transform_edt(~stands) * _CELL
    inside = np.abs(axis) < SIZE / 2 - 10.0
    free = (away > _FREE) & (away < _NEAR) & (np.hypot(*np.gradient(heights, _CELL)) < _STEEP)
    now = SceneState(join([height_field(axis, heights), solid]), leaves)
    return axis, heights, now, free & inside[:, None] & inside


@lru_cache(maxsize=2)
def world(seed: int, route_seed: int, apart: int | None = None) -> Scene | None:
    """Return the world of a square's other half, with a way through it that ``route_seed`` draws, if there is one."""
    axis, heights, now, free = _stage(seed, apart)
    route = _way(free, axis, np.random.default_rng([route_seed, _ROUTE]))
    return None if route is None else Scene("survey", SIZE, now, now, Ground(axis, heights), route, ())


def moved(scene: Scene, shift: Floats) -> Scene:
    """Return the world with all solid columns moved by (2,) metres; ground and foliage stay."""
    solid = scene.now.solid
    vertices, ground = solid.vertices.copy(), len(scene.site.mesh().vertices)
    vertices[ground:, :2] += np.asarray(shift)
    return replace(scene, now=replace(scene.now, solid=solid._replace(vertices=vertices)))


def _columns(axis: Floats, low: Floats, high: Floats, where: Bools) -> Mesh:
    """Return a box of a cell's size from ``low`` to ``high`` (metres, by cell) at each cell ``where``."""
    template, (i, j) = box(_CELL, _CELL, 1.0), np.nonzero(where)
    corners = np.tile(template.vertices, (len(i), 1, 1))
    corners[..., 2] = np.where(corners[..., 2] > 0.5, high[i, j][:, None], low[i, j][:, None])
    corners[..., 0] += axis[i][:, None]
    corners[..., 1] += axis[j][:, None]
    return copies(template, corners)


def _way(free: Bools, axis: Floats, rng: np.random.Generator) -> Floats | None:
    """Return a closed way (N, 2), metres, the shortest between two free places, to and fro; None if all are short."""
    free = free[::2, ::2]
    number = np.where(free, np.cumsum(free).reshape(free.shape) - 1, -1)
    sides = (number[:-1], number[:, :-1]), (number[1:], number[:, 1:])
    a, b = (np.concatenate([part.ravel() for part in side]) for side in sides)
    beside, places = (a >= 0) & (b >= 0), axis[::2][np.argwhere(free)]
    steps = np.full(int(beside.sum()), 2 * _CELL)
    graph = sparse.coo_matrix((steps, (a[beside], b[beside])), (len(places),) * 2).tocsr()
    for _ in range(_TRIES if len(places) else 0):
        start = int(rng.integers(len(places)))
        metres, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True, limit=2 * _WAY)
        far = np.flatnonzero(np.isfinite(metres) & (metres > _WAY))
        if len(far):
            way = [int(rng.choice(far))]
            while way[-1] != start:
                way.append(int(before[way[-1]]))
            return there_and_back(ndimage.uniform_filter1d(places[way], 7, axis=0, mode="nearest"))
    return None


def surveyed(kind: str, seed: int) -> Floats:
    """Return the map's half of a square as its kind says: (N, 3) metres."""
    points, of_map = _square(seed, None)
    xyz = points.xyz[of_map & (np.abs(points.xyz[:, :2]) < SIZE / 2).all(axis=1)]
    scene = None if kind == "survey" else world(seed, seed)
    if scene is None:
        return xyz
    route = scene.route
    if kind == "gap":
        return xyz[cKDTree(route).query(xyz[:, :2])[0] > _GAP]
    centre, reach = route.mean(axis=0), SIZE / 2 - _BLOCK / 2
    other = np.where(centre > 0.0, -reach, reach)

    def inside(middle: Floats) -> Bools:
        return np.asarray((np.abs(xyz[:, :2] - middle) < _BLOCK / 2).all(axis=1))

    copy, there = xyz[inside(centre)], xyz[inside(other)]
    lift = np.median(there[:, 2]) - np.median(copy[:, 2])
    return np.concatenate([xyz[~inside(other)], copy + np.r_[other - centre, lift]])
