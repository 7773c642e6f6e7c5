"""Points around a place, cut out of a map and sorted for searching in the same pass.

A crop of 250,000 points takes 10 MB, which the system allocates page by page, 4 MB per millisecond. One piece of memory
for all arrays gets larger pages.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_kernels import reference, runtime
from coview_kernels.arrays import F32, I8, I32
from coview_kernels.cells import Cells, grid_frame
from coview_kernels.launch import Launch
from coview_kernels.reference.crop import Crop, Cut
from coview_kernels.warm_up import compiled_by

__all__ = ["Crop", "Cut", "crop_points"]

MAX_POINTS = (1 << 31) // 3 - 1
"""Greatest number of points in a map, as kernels count its coordinates in int32."""


def crop_points(points: F32, normals: I8, spans: npt.ArrayLike, cut: Cut) -> Crop | None:
    """Cut the points around a place out of a map; None if there are none.

    Args:
        points: (N, 3) float32, contiguous, metres; rows with NaN or inf are left out.
        normals: (N, 3) int8, contiguous, unit normals times the planarity around each point times 127.
        spans: (S, 2) first row of each stretch of the map to search, and the row after its last; no row twice.
        cut: the circle to cut out.

    Raises:
        ValueError: an array has the wrong shape or type, a span leaves the map, the spans hold more rows than the map,
            the map more than ``MAX_POINTS``, or a setting is out of its range.
    """
    for name, array, kind in (("points", points, np.float32), ("normals", normals, np.int8)):
        if array.shape != (len(points), 3) or array.dtype != kind or not array.flags.c_contiguous:
            raise ValueError(f"{name} must be a contiguous ({len(points)}, 3) array of {np.dtype(kind)}")
    if len(points) > MAX_POINTS:
        raise ValueError(f"{len(points)} points, {MAX_POINTS} at most")
    wide = np.asarray(spans, dtype=np.int64).reshape(-1, 2)
    begin, end = wide.T
    if not ((begin >= 0) & (begin <= end) & (end <= len(points))).all() or (end - begin).sum() > len(points):
        raise ValueError(f"spans must lie in the map's {len(points)} points, once, and not end before they begin")
    stretches = np.ascontiguousarray(wide, dtype=np.int32)
    if not (all(math.isfinite(v) for v in cut) and cut.radius > 0):
        raise ValueError(f"cut must be finite with a positive radius, got {cut}")
    return runtime.dispatch_here(
        lambda: _measure.ready() and _sort.ready(), _crop, reference.crop_points, *(points, normals, stretches, cut)
    )


_NO: dict[type, npt.NDArray[Any]] = {kind: np.zeros(1, dtype=kind) for kind in (np.float32, np.int32, np.int8)}
_measure = Launch(
    "crop", "measure", _NO[np.float32], _NO[np.int32], np.zeros(3), np.zeros(6, np.float32), _NO[np.int32]
)
_sort = Launch(
    *("crop", "sort", _NO[np.float32], _NO[np.int8], _NO[np.int32], np.zeros(11)),
    *(_NO[np.int32], _NO[np.int32], _NO[np.int32], _NO[np.float32]),
)
_cells: I32 = np.empty(1 << 16, dtype=np.int32)  # of a crop's points; working memory


def _crop(points: F32, normals: I8, spans: I32, cut: Cut) -> Crop | None:
    global _cells
    flat, around = points.reshape(-1), np.array([cut.x, cut.y, cut.radius**2])
    bounds, count = np.empty(6, dtype=np.float32), np.empty(1, dtype=np.int32)
    _launch(_measure, flat, spans.reshape(-1), around, bounds, count)
    number = int(count[0])
    if not number:
        return None
    low, high = bounds[:3].astype(np.float64), bounds[3:].astype(np.float64)
    frame = grid_frame(low, high)
    starts, rows, planes = _arena(
        (int(frame[5:].prod()) + 1, np.int32), (4 * number, np.int32), (3 * number, np.float32)
    )
    starts.fill(0)
    candidates = int((spans[:, 1] - spans[:, 0]).sum())
    if candidates > len(_cells):
        _cells = np.empty(1 << (candidates - 1).bit_length(), dtype=np.int32)
    settings = np.concatenate((around, frame))
    _launch(_sort, flat, normals.reshape(-1), spans.reshape(-1), settings, _cells, starts, rows, planes)
    sorted_points = rows.view(np.float32).reshape(-1, 4)[:, :3]
    return Crop(sorted_points, planes.reshape(-1, 3), Cells(frame, starts, rows))


def _arena(*parts: tuple[int, Any]) -> list[npt.NDArray[Any]]:
    """Return arrays of given lengths and four-byte types in one piece of memory."""
    ends = np.cumsum([-(-number // 16) * 16 for number, _ in parts])  # each begins a cache line
    memory = np.empty(int(ends[-1]), dtype=np.int32)
    begins = (0, *ends[:-1])
    return [memory[b : b + number].view(kind) for b, (number, kind) in zip(begins, parts, strict=True)]


def _launch(launch: Launch, *arguments: Any) -> None:
    for index, value in enumerate(arguments):
        launch.put(index, value)
    launch()


def _compile() -> None:
    cloud = np.zeros((1, 3), dtype=np.float32)
    crop_points(cloud, np.zeros((1, 3), dtype=np.int8), [[0, 1]], Cut(0.0, 0.0, 1.0))


compiled_by("crop_points", _compile)
