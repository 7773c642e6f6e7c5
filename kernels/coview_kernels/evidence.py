"""What a scan's points and rays say about a pose in a map: counts of those that fit and of those that do not.

Three passes of one launch each: over the points of a scan, which the map has or has not; over a frame, whose returns
are sorted by direction; and over the map's points, which the frame's rays met or passed through.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from coview_kernels import reference, runtime
from coview_kernels.arrays import F32, F64, U8, as_finite64, as_float32, as_uint8, check_same_shape
from coview_kernels.launch import Launch
from coview_kernels.nearest import SAMPLE_GRID, PointGrid
from coview_kernels.reference.evidence import (
    Beams,
    Distances,
    PointCounts,
    PointKind,
    Raster,
    RayCounts,
    Sight,
    beam_cells,
)
from coview_kernels.warm_up import SAMPLE, compiled_by

__all__ = [
    "Beams",
    "Distances",
    "PointCounts",
    "PointKind",
    "Raster",
    "RayCounts",
    "Sight",
    "beam_cells",
    "match_points",
    "match_rays",
    "sort_beams",
]


def match_points(
    grid: PointGrid,
    normals: npt.ArrayLike,
    points: npt.ArrayLike,
    kinds: npt.ArrayLike,
    T: npt.ArrayLike,
    walls: Raster,
    survey: Raster,
    distances: Distances,
) -> PointCounts:
    """Count the points of a scan that a map explains.

    Args:
        grid: the map, (K, 3).
        normals: (K, 3) float32, its normals, of any length but zero.
        points: (N, 3) float32, scan frame, metres, finite.
        kinds: (N,) uint8 of :class:`PointKind`.
        T: (4, 4) ``T_map_scan``.
        walls: height of the map's edges, float32, metres.
        survey: uint8, above zero where the map has been surveyed; points elsewhere do not count.
        distances: what fits.

    Raises:
        ValueError: an array has the wrong shape, or ``T`` is not finite.
    """
    cloud, of = as_float32("points", points, None, 3), as_uint8("kinds", kinds, None)
    check_same_shape("kinds", of, "one value per point", (len(cloud),))
    planes, pose = as_float32("normals", normals, len(grid.points), 3), as_finite64("T", T, 4, 4)
    arguments = grid, planes, cloud, of, pose, walls, survey, distances
    return runtime.dispatch_here(
        lambda: "cells" in vars(grid) and _launches["match"].ready(), _match_points, _plain_match_points, *arguments
    )


def sort_beams(points: npt.ArrayLike, sight: Sight, every: int = 1) -> Beams:
    """Sort a frame by direction.

    Args:
        points: (N, 3) float32, body frame, metres, finite.
        sight: cells, and the least range that counts.
        every: of so many points one counts.

    Raises:
        ValueError: ``points`` has the wrong shape, or ``every`` is below 1.
    """
    cloud = as_float32("points", points, None, 3)
    _check_every(every)
    return runtime.dispatch_here(_launches["beams"].ready, _sort_beams, _plain_sort_beams, cloud, sight, every)


def match_rays(
    limits: npt.ArrayLike, points: npt.ArrayLike, T_map_body: npt.ArrayLike, lowest: float, sight: Sight, every: int = 1
) -> RayCounts:
    """Count the map points that a frame's rays met, and those that they passed through.

    A map point is passed through where the nearest return in its direction lies clearly behind it; it is met where
    that is not so and the farthest one does not lie clearly before it. Others are hidden.

    Args:
        limits: (2, C) float32 ranges of the nearest and of the farthest return in each cell that ``sight`` has, metres;
            below any range where they say nothing.
        points: (K, 3) float32, map frame, metres, finite.
        T_map_body: (4, 4) pose of the frame.
        lowest: height in the map above which a point counts, metres.
        sight: cells, ranges and slack.
        every: of so many map points one counts.

    Raises:
        ValueError: an array has the wrong shape, ``T_map_body`` is not finite, or ``every`` is below 1.
    """
    ranges, cloud = as_float32("limits", limits, 2, sight.cells), as_float32("points", points, None, 3)
    pose = as_finite64("T_map_body", T_map_body, 4, 4)
    _check_every(every)
    ready = _launches["free_space"].ready
    arguments = ranges, cloud, pose, float(lowest), sight, every
    return runtime.dispatch_here(ready, _match_rays, _plain_match_rays, *arguments)


def _check_every(every: int) -> None:
    if every < 1:
        raise ValueError(f"every must be at least 1, got {every}")


# ---- in Taichi; one launch of each is enough, as only one call of native code runs at a time

_FLOATS, _INTS, _BYTES = (np.zeros(1, dtype=kind) for kind in (np.float32, np.int32, np.uint8))
_launches = {
    "match": Launch(
        *("evidence", "match", np.zeros(38), _INTS, _INTS, _FLOATS, _FLOATS, _BYTES),
        *(_FLOATS, _BYTES, np.zeros(6, dtype=np.int32)),
    ),
    "beams": Launch("evidence", "beams", _FLOATS, 1, 1.0, 1.0, 1, _FLOATS, _FLOATS, _INTS),
    "free_space": Launch(
        *("evidence", "free_space", np.zeros(21), _FLOATS, 1, 1, _FLOATS, np.zeros(2, dtype=np.int32))
    ),
}


def _match_points(
    grid: PointGrid, normals: F32, points: F32, kinds: U8, T: F64, walls: Raster, survey: Raster, distances: Distances
) -> PointCounts:
    cells, counts = grid.cells, np.empty(6, dtype=np.int32)
    settings = np.concatenate((T[:3].ravel(), cells.frame, distances, _numbers(walls), _numbers(survey)))
    heights, known = (raster.values.ravel(order="K") for raster in (walls, survey))
    _launch(
        "match", settings, cells.starts, cells.rows, normals.reshape(-1), heights, known,
        points.reshape(-1), kinds, counts,
    )  # fmt: skip
    return PointCounts(*counts.tolist())


def _numbers(raster: Raster) -> tuple[float, ...]:
    """Corner, edge, numbers of cells, and steps from one to the next in memory, of a raster."""
    values = raster.values
    x, y = (stride // values.itemsize for stride in values.strides)
    return (*raster.corner.tolist(), raster.cell, *values.shape, x, y)


def _sort_beams(points: F32, sight: Sight, every: int) -> Beams:
    nearest = np.full(sight.cells, np.inf, dtype=np.float32)
    beams = Beams(nearest, np.zeros(sight.cells, dtype=np.float32), np.zeros(sight.cells, dtype=np.int32))
    _launch("beams", points.reshape(-1), every, sight.least, 1.0 / sight.beam, sight.columns, *beams)
    return beams


def _match_rays(limits: F32, points: F32, T_map_body: F64, lowest: float, sight: Sight, every: int) -> RayCounts:
    R, place = T_map_body[:3, :3], T_map_body[:3, 3]
    settings, counts = np.empty(21), np.empty(2, dtype=np.int32)
    back = settings[:12].reshape(3, 4)
    back[:, :3], back[:, 3] = R.T, -(R.T @ place)
    settings[12:] = (
        *place, lowest, sight.farthest, sight.least, sight.slack, sight.slope, 1.0 / sight.beam,
    )  # fmt: skip
    _launch("free_space", settings, points.reshape(-1), every, sight.columns, limits.reshape(-1), counts)
    return RayCounts(*counts.tolist())


def _launch(name: str, *arguments: object) -> None:
    launch = _launches[name]
    for index, value in enumerate(arguments):
        launch.put(index, value)
    launch()


# ---- in NumPy


def _plain_match_points(
    grid: PointGrid, normals: F32, points: F32, kinds: U8, T: F64, walls: Raster, survey: Raster, distances: Distances
) -> PointCounts:
    return reference.match_points(grid.tree, normals, points, kinds, T, walls, survey, distances)


def _plain_sort_beams(points: F32, sight: Sight, every: int) -> Beams:
    return reference.sort_beams(points[::every], sight)


def _plain_match_rays(limits: F32, points: F32, T_map_body: F64, lowest: float, sight: Sight, every: int) -> RayCounts:
    return reference.match_rays(limits, points[::every], T_map_body, lowest, sight)


def _compile_points() -> None:
    walls = Raster(np.ones((1, 1), dtype=np.float32), np.zeros(2), 1.0)
    survey = walls._replace(values=np.ones((1, 1), dtype=np.uint8))
    match_points(SAMPLE_GRID, SAMPLE, SAMPLE, np.ones(2), np.eye(4), walls, survey, Distances(1.0, 1.0, 1.0, 1.0))


_ANY = Sight(1.0, 1.0, 1.0, 1.0, 1.0)
compiled_by("match_points", _compile_points)
compiled_by("match_rays", lambda: match_rays(np.ones((2, _ANY.cells)), SAMPLE, np.eye(4), 0.0, _ANY))
compiled_by("sort_beams", lambda: sort_beams(SAMPLE, _ANY))
