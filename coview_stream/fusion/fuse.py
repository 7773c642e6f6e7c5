"""Fuse runs with a base map to one cloud with the source of each point and, on request, the changes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

import coview_kernels as kernels
from coview_stream.basemap.basemap import BaseMap
from coview_stream.config.checks import check_types, require
from coview_stream.errors import CloudError, ConfigError, InputError
from coview_stream.fusion.localized_run import LocalizedRun
from coview_stream.fusion.sightings import REACH, Counts, Sightings, VoxelTable, distances, looks_at, within
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Ints, Reals
from coview_stream.geometry.rasters import max_filter
from coview_stream.geometry.transforms import Points

SAME, NEW, GONE = 0, 1, 2
"""Tags of change."""

RECORD = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("stamp", "<f8"), ("source", "<u2"), ("change", "u1")])
"""A point: metres in the frame of the map's sources, seconds, number of the source, change tag."""


def records(points: Floats, source: npt.ArrayLike, change: npt.ArrayLike, stamp: npt.ArrayLike) -> npt.NDArray[np.void]:
    """Return points (N, 3) with their tags as records (N,)."""
    rows = np.zeros(len(points), dtype=RECORD)
    rows["x"], rows["y"], rows["z"] = points.T
    rows["source"], rows["change"], rows["stamp"] = source, change, stamp
    return rows


_CELL = 0.5  # metres, of the raster of greatest heights
_AROUND = 5  # cells: eaves and crowns hide objects within a metre
_MAX_AREA = 1e8  # square metres; a raster of 1.6 GB


def top_around(base_map: BaseMap, points: Points) -> Floats32:
    """Return the greatest height (N,) of the map within a metre of points (N, 3); minus infinity without map points.

    A survey from above would show a higher object; it may miss a lower one, which is a facade or hidden below a roof
    or a crown.
    """
    low, size = _around(points)
    top = np.full(tuple(np.ceil(size / _CELL).astype(int) + 1), -np.inf, dtype=np.float32)
    for begin in range(0, len(base_map.points), _CHUNK):
        part = np.asarray(base_map.points[begin : begin + _CHUNK])
        inside, cells = _within_raster(np.floor((part[:, :2] - low) / _CELL), top)
        np.maximum.at(top, cells, part[inside, 2])
    return np.asarray(max_filter(top, _AROUND)[_within_raster(np.floor((points[:, :2] - low) / _CELL), top)[1]])


def _around(points: Reals) -> tuple[Floats, Floats]:
    """Return lower corner and size (2,), metres, of a rectangle around points (N, 2 or 3); InputError: over 100 km2."""
    low = np.floor(points[:, :2].min(axis=0).astype(np.float64) - 2.0)
    size = points[:, :2].max(axis=0).astype(np.float64) + 2.0 - low
    if size.prod() > _MAX_AREA:
        raise InputError(f"the runs cover {size[0]:.0f} x {size[1]:.0f} m, 100 km2 at most: fuse them one by one")
    return low, size


def _within_raster(cells: Floats, raster: npt.NDArray[Any]) -> tuple[Ints, tuple[Ints, ...]]:
    """Return the rows (M,) of the cells (N, 2) inside a raster, and these cells as an index."""
    inside = np.flatnonzero(((cells >= 0) & (cells < raster.shape)).all(axis=1))
    return inside, tuple(cells[inside].astype(np.int64).T)


Progress = Callable[[int, int, str], None]
"""Called with the number of frames (or pairs of submaps) done, that of all, and the name of the step."""

_CHUNK = 500_000
_LOOKS = 3  # least looks through a point that is absent
_THROUGH_MOVING, _THROUGH_GONE = 2, 4  # least looks through such a point per look that ends there
_NEAR = 0.5  # metres to the map: a nearer point is on the same object, a farther one may fill a blind spot
_ABOVE = 0.4  # metres above all that the survey saw around a point


@dataclass(frozen=True)
class FuseConfig:
    """Selection of the runs' points.

    Attributes:
        voxel: metres; one point of all runs per cube of this size, and none this near to the map's points.
        range_min: metres from the lidar; nearer points may be the robot itself.
        range_max: metres from the lidar; farther points suffer from errors of the pose's angles.
        keep_moving: keep people and cars, that is points through which other rays went.
        changes: mark new and vanished points.

    Raises:
        ConfigError: a value out of its range.
    """

    voxel: float = 0.25
    range_min: float = 1.5
    range_max: float = 50.0
    keep_moving: bool = False
    changes: bool = False

    def __post_init__(self) -> None:
        check_types(self)
        require(0.02 <= self.voxel <= 5.0, self, "voxel", "0.02 to 5 m")
        require(0.0 <= self.range_min < self.range_max, self, "range_min", "at least 0, and less than range_max")


@dataclass(frozen=True)
class Added:
    """Contribution of one run: numbers of its frames and of its points in the fused cloud."""

    frames: int  # used
    without_pose: int
    damaged: int  # that could not be read
    points: int  # a voxel of several runs counts for the first


@dataclass(frozen=True, eq=False)
class Fused:
    """Fused cloud; the points of its base map stay in their file until :meth:`chunks` reads them."""

    base_map: BaseMap  # the map
    base_change: npt.NDArray[np.uint8]  # (B,) uint8 tags of the map's points: same, or gone
    points: Points  # (N, 3) float32 of the runs, relative to the map's origin
    source: npt.NDArray[np.uint16]  # (N,) uint16 number of the run, from 1
    change: npt.NDArray[np.uint8]  # (N,) uint8 tag: same, or new
    stamp: npt.NDArray[np.float64]  # (N,) float64 of the newest frame with a point in the voxel, seconds
    added: tuple[Added, ...]  # by run
    filled: float  # approximate square metres of new surface in blind spots of the survey
    moving: int  # voxels off the map that rays went through; left out without keep_moving

    def __len__(self) -> int:
        """Return the number of points including the map's."""
        return len(self.base_map.points) + len(self.points)

    def chunks(self) -> Iterator[npt.NDArray[np.void]]:
        """Yield the points as records, in the coordinates of the map's sources; the map's come first."""
        origin = self.base_map.origin
        for begin in range(0, len(self.base_map.points), _CHUNK):
            part = slice(begin, begin + _CHUNK)
            points = np.asarray(self.base_map.points[part], dtype=np.float64)
            yield records(points + origin, 0, self.base_change[part], 0.0)
        for begin in range(0, len(self.points), _CHUNK):
            part = slice(begin, begin + _CHUNK)
            points = self.points[part].astype(np.float64) + origin
            yield records(points, self.source[part], self.change[part], self.stamp[part])


def fuse(
    base_map: BaseMap, runs: Sequence[LocalizedRun], config: FuseConfig | None = None, progress: Progress | None = None
) -> Fused:
    """Merge localized runs with the map they were localized on.

    Frames are read for their surfaces, and some of them again for their rays. Memory holds one row per occupied voxel,
    not all points.

    Raises:
        InputError: a frame lies too far from the map, or the runs' bounding rectangle is larger than 100 km2.
        CloudError: no point of the runs is in range.
    """
    config = config or FuseConfig(voxel=base_map.config.voxel)
    if runs:
        _around(np.concatenate([run.poses[:, :3, 3] for run in runs]))  # before anything slow
    table, taken = _surfaces(runs, config, progress)
    if not len(table):
        raise CloudError(f"no run has a point from {config.range_min:g} to {config.range_max:g} m from its lidar")
    points, rows = table.points(), table.rows()
    base = _base_near(base_map, points) if config.changes else np.zeros(0, dtype=np.int64)
    base_points = np.asarray(base_map.points[base])
    sightings = Sightings(np.concatenate([points, base_points]), max(0.3, 1.2 * config.voxel))
    for number, run in enumerate(runs, start=1):
        chosen = looks_at(run.stamps, run.poses[:, :3, 3])
        for done, frame in enumerate(run.frames(chosen.__getitem__), start=1):
            if frame is not None:
                sightings.look(frame)
            if progress:
                progress(done, len(run), f"rays of run {number}")
    through, seen = sightings.given(sightings.through), sightings.given(sightings.seen)
    n = len(points)
    moving = _seen_through(through[:n], seen[:n], _THROUGH_MOVING)
    to_map = distances(points, lambda centre, radius: base_map.crop(centre, radius)[0], max(_NEAR, config.voxel))
    top = top_around(base_map, points)
    base_change = np.full(len(base_map.points), SAME, dtype=np.uint8)
    new = np.zeros(n, dtype=bool)
    if config.changes:
        enough = rows["hits"] >= min(2, sum(taken))
        surveyed = np.isfinite(top) & (points[:, 2] > top + _ABOVE)  # the survey would have seen it
        new = ~moving & enough & (to_map > _NEAR) & surveyed
        gone = np.flatnonzero(_seen_through(through[n:], seen[n:], _THROUGH_GONE))
        lasting = np.isfinite(distances(base_points[gone], within(points[~moving]), _NEAR))
        base_change[base[gone[~lasting]]] = GONE
    keep = (to_map > config.voxel) & (~moving | config.keep_moving)
    blind = keep & ~new & (to_map > _NEAR) & np.isfinite(top)
    source = rows["source"][keep]
    added = tuple(
        Added(frames, run.without_pose, len(run.damaged), int((source == k).sum()))
        for k, (run, frames) in enumerate(zip(runs, taken, strict=True), start=1)
    )
    return Fused(
        base_map,
        base_change,
        points=points[keep],
        source=source,
        change=np.where(new, NEW, SAME)[keep].astype(np.uint8),
        stamp=rows["stamp"][keep],
        added=added,
        filled=float(blind.sum()) * config.voxel**2,
        moving=int((moving & (to_map > config.voxel)).sum()),
    )


def _surfaces(
    runs: Sequence[LocalizedRun], config: FuseConfig, progress: Progress | None
) -> tuple[VoxelTable, list[int]]:
    """Collect the voxels of all runs, and count the frames of each run."""
    table, taken = VoxelTable(config.voxel), []
    for source, run in enumerate(runs, start=1):
        count = 0
        for done, frame in enumerate(run.frames(), start=1):
            if frame is not None:
                far = np.linalg.norm(frame.points - frame.eye.astype(np.float32), axis=1)
                near = frame.points[(far >= config.range_min) & (far < config.range_max)]
                table.add(kernels.transform_unique(near, frame.T_map_body, config.voxel)[0], frame.stamp, source)
                count += 1
            if progress:
                progress(done, len(run), f"run {source}")
        taken.append(count)
    return table, taken


def _seen_through(through: Counts, seen: Counts, times: int) -> Bools:
    return np.asarray((through >= _LOOKS) & (through > times * seen.astype(np.int64)))


def _base_near(base_map: BaseMap, points: Points) -> Ints:
    """Return the indices of the map's points within reach of the runs' rays."""
    tile = 2.0 * REACH
    low = np.floor(points[:, :2].min(axis=0).astype(np.float64) / tile) - 1
    shape = (np.floor(points[:, :2].max(axis=0) / tile) + 2 - low).astype(int)
    grid = np.zeros(tuple(shape), dtype=bool)
    grid[_within_raster(np.floor(points[:, :2].astype(np.float64) / tile) - low, grid)[1]] = True
    near = []
    for begin in range(0, len(base_map.points), _CHUNK):
        inside, cells = _within_raster(np.floor(base_map.points[begin : begin + _CHUNK, :2] / tile) - low, grid)
        near.append(begin + inside[grid[cells]])
    return np.concatenate(near)


def check_count(runs: int) -> None:
    """Raise ConfigError for more runs than a point's source number can count."""
    if runs > np.iinfo(np.uint16).max:
        raise ConfigError(f"{runs} runs: at most 65,535 can be told apart; fuse some of them first")
