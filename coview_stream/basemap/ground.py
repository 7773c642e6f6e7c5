"""Ground points and heights of a base map, by cloth simulation (as in the paper) or a morphological filter."""

from __future__ import annotations

import ctypes
import functools
import importlib
import importlib.util
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import numpy as np

from coview_stream.errors import DependencyError
from coview_stream.geometry.arrays import Bools, Floats32, Ints, Reals
from coview_stream.geometry.rasters import cells, filled, lowest_per_cell
from coview_stream.geometry.transforms import Points

Method = Literal["auto", "cloth", "morphological"]
"""``auto`` uses the cloth if its wheel is installed and the points are wide enough for a cloth to hang."""

# ``python -m bench ground`` scores all these on labelled scans
_CELL = 0.5  # metres: a filter gets the lowest point of each cell
_MAX_CELLS = 20_000_000  # larger areas get larger cells, which bounds time and memory
_CLASS_THRESHOLD = 0.3  # metres from the ground raster within which a point is ground
_SLOPE_ALLOWANCE = 0.3  # metres added to ``_CLASS_THRESHOLD`` per unit of local slope
_REFINEMENTS = 4  # rounds in which lowest points near the ground raster are added to it
_PORTION = 1_000_000  # points classified at a time
_MIN_CELLS = 50  # with fewer occupied cells all lowest points are ground: a cloth cannot rest on them
# cloth
_NODES = 1.0  # metres between its nodes
_RIGIDNESS = 2  # 1 for mountains, 2 for relief, 3 for plains
_ITERATIONS = 100  # limit until the cloth rests: in steep forest 50 are too few, 200 no better
_CLOTH_THRESHOLD = 0.5  # metres from the cloth within which a lowest point is ground
_TILE, _MARGIN = 256.0, 24.0  # metres: smaller cloths rest sooner and fit the cache; one of 1.5 km2 took 75 s
_MIN_POINTS = 10  # for a cloth to rest on
# morphological filter
_MAX_WINDOW = 40.0  # metres: wider roofs pass for ground, larger hills survive whole
_MAX_SLOPE = 0.3  # rise per metre of terrain that a wider window must not remove
_FIRST_THRESHOLD = 0.5  # metres above the opened surface that every window leaves


def cloth_available() -> bool:
    """Return whether the cloth's wheel is installed; there is none for Python 3.13 or for ARM."""
    return importlib.util.find_spec("CSF") is not None


def _cloth_ground(points: Points) -> Bools:
    """Mask the points (N, 3), metres, on which a cloth comes to rest when dropped on the inverted cloud."""
    ground = np.zeros(len(points), dtype=bool)
    low = points[:, :2].min(axis=0).astype(np.float64)
    counts = np.maximum(1, np.ceil(np.ptp(points[:, :2], axis=0) / _TILE)).astype(int)
    size = np.ptp(points[:, :2], axis=0).astype(np.float64) / counts + 1e-3
    tile = np.minimum(((points[:, :2] - low) / size).astype(int), counts - 1)
    for i in range(counts[0]):
        strip = np.flatnonzero(_between(points[:, 0], low[0] + size[0] * i, size[0]))
        for j in range(counts[1]):
            index = strip[_between(points[strip, 1], low[1] + size[1] * j, size[1])]
            inside = (tile[index] == (i, j)).all(axis=1)
            if inside.any() and len(index) >= _MIN_POINTS:
                inside &= _one_cloth(points[index])
            ground[index[inside]] = True
    return ground


def _between(values: Floats32, start: float, length: float) -> Bools:
    return np.asarray((values > start - _MARGIN) & (values < start + length + _MARGIN))


def _one_cloth(points: Points) -> Bools:
    csf = importlib.import_module("CSF")
    _one_thread()
    cloth = csf.CSF()
    cloth.params.bSloopSmooth = True  # the cloth follows steep steps: banks, terraces
    cloth.params.cloth_resolution = _NODES
    cloth.params.rigidness = _RIGIDNESS
    cloth.params.interations = _ITERATIONS  # the wheel's spelling
    cloth.params.class_threshold = _CLOTH_THRESHOLD
    ground, rest = csf.VecInt(), csf.VecInt()
    with _silence():
        cloth.setPointCloud(points.astype(np.float64))
        cloth.do_filtering(ground, rest, False)
    mask = np.zeros(len(points), dtype=bool)
    mask[np.array(ground, dtype=np.intp)] = True
    return mask


@functools.cache
def _one_thread() -> None:
    """Run the cloth in one thread: its short parallel loops busy-wait, and take three times as long on busy cores."""
    library = importlib.import_module("_CSF").__file__
    try:
        # a symbol lookup by handle also searches the library's dependencies, where its private OpenMP is
        ctypes.CDLL(library).omp_set_num_threads(1)
    except (OSError, AttributeError):
        return  # built without OpenMP


@contextmanager
def _silence() -> Iterator[None]:
    """Discard the C library's standard output, where the wheel reports every step."""
    libc = ctypes.CDLL(None) if os.name == "posix" else None
    sys.stdout.flush()
    try:
        saved = os.dup(1)
    except OSError:  # no standard output at all
        yield
        return
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 1)
        yield
    finally:
        if libc is not None:
            libc.fflush(None)  # before the descriptor is restored, or the buffer goes to the real output
        os.dup2(saved, 1)
        os.close(null)
        os.close(saved)


@dataclass(frozen=True)
class GroundRaster:
    """Ground heights of square cells in the frame of the points, metres.

    Attributes:
        z: (H, W) float32, row along y and column along x; NaN where the ground is unknown.
        x0, y0: lower corner of cell (0, 0).
        cell: edge length.
    """

    z: Floats32
    x0: float
    y0: float
    cell: float

    def height_at(self, xy: Reals) -> Floats32:
        """Interpolate the ground height (N,) at (N, 2) positions; NaN in unknown cells and outside.

        The interpolation is bilinear between the centres of known cells.
        """
        height, width = self.z.shape
        column = (xy[:, 0].astype(np.float64) - self.x0) / self.cell
        row = (xy[:, 1].astype(np.float64) - self.y0) / self.cell
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        column, row = np.where(inside, column, 0.0), np.where(inside, row, 0.0)
        known = inside & np.isfinite(self.z[row.astype(np.intp), column.astype(np.intp)])
        left, low = np.floor(column - 0.5).astype(np.intp), np.floor(row - 0.5).astype(np.intp)
        total, weight = np.zeros(len(xy)), np.zeros(len(xy))
        for dr, dc in ((0, 0), (0, 1), (1, 0), (1, 1)):
            r, c = np.clip(low + dr, 0, height - 1), np.clip(left + dc, 0, width - 1)
            w = (1 - np.abs(row - 0.5 - (low + dr))) * (1 - np.abs(column - 0.5 - (left + dc)))
            z = self.z[r, c].astype(np.float64)
            usable = np.isfinite(z)
            total += np.where(usable, w * z, 0.0)
            weight += np.where(usable, w, 0.0)
        out = np.full(len(xy), np.nan, dtype=np.float32)
        np.divide(total, weight, out=out, where=known & (weight > 0), casting="unsafe")
        return out


def ground_filter(points: Points, method: Method = "auto") -> Literal["cloth", "morphological"]:
    """Choose the filter for (N, 3) points, metres; DependencyError if ``cloth`` is asked for and not installed."""
    if method == "cloth" and not cloth_available():
        raise DependencyError(
            "the ground filter `cloth` needs the wheel cloth-simulation-filter, which exists for x86-64 and Python up "
            "to 3.12: install it there, or use method='morphological'"
        )
    if method != "auto":
        return method
    hangs = float(min(np.ptp(points[:, :2], axis=0))) > 5 * _NODES
    return "cloth" if hangs and cloth_available() else "morphological"


def ground_mask(points: Points, method: Method = "auto") -> Bools:
    """Mask (N,) the points that lie on the ground.

    The filter finds the ground among the lowest points of the cells. All points are then classified by their height
    above the raster of this ground.

    Args:
        points: (N, 3) float32 metres, finite, z up.
        method: the filter.

    Raises:
        ConfigError: the extent is absurd for a map. DependencyError: see :func:`ground_filter`.
    """
    if not len(points):
        return np.zeros(0, dtype=bool)
    from scipy import ndimage  # only for builds: an installation without extras lacks it

    surface = _ground_surface(points, method)
    slope = _gradient(ndimage.gaussian_filter(surface.z, 1.0 / surface.cell, mode="nearest"), surface.cell)
    mask = np.zeros(len(points), dtype=bool)
    for start in range(0, len(points), _PORTION):
        part = points[start : start + _PORTION]
        # float32 may round the outermost point up into the next cell
        column = np.minimum(((part[:, 0] - surface.x0) / surface.cell).astype(np.intp), slope.shape[1] - 1)
        row = np.minimum(((part[:, 1] - surface.y0) / surface.cell).astype(np.intp), slope.shape[0] - 1)
        allowed = _CLASS_THRESHOLD + _SLOPE_ALLOWANCE * slope[row, column]
        mask[start : start + len(part)] = np.abs(part[:, 2] - surface.height_at(part[:, :2])) <= allowed
    return mask


def _ground_surface(points: Points, method: Method) -> GroundRaster:
    """Raster the ground over the cloud's extent, interpolated under buildings and trees, without NaN."""
    chosen, cell = ground_filter(points, method), _CELL
    corner, shape, flat = cells(points, cell)
    while shape[0] * shape[1] > _MAX_CELLS:
        cell *= 2
        corner, shape, flat = cells(points, cell)
    index = lowest_per_cell(points, flat)
    lowest, occupied = points[index], flat[index]
    z = np.full(shape, np.nan, dtype=np.float32)
    z.flat[occupied] = lowest[:, 2]
    usable = ~_stray_low(z).flat[occupied]
    lowest, occupied = lowest[usable], occupied[usable]
    ground = np.ones(len(lowest), dtype=bool)
    if len(lowest) >= _MIN_CELLS:
        if chosen == "cloth":
            ground = _cloth_ground(lowest)
        else:
            raster = np.full(shape, np.nan, dtype=np.float32)
            raster.flat[occupied] = lowest[:, 2]
            ground = _morphological_ground(raster, cell).flat[occupied]
        if not ground.any():
            ground[:] = True
    return GroundRaster(_refined(shape, lowest[:, 2], occupied, ground, cell), float(corner[0]), float(corner[1]), cell)


def _stray_low(z: Floats32) -> Bools:
    """Mask cells more than 1 m below the fourth lowest of the 9 x 9 cells around: echoes from below the ground."""
    from scipy import ndimage  # only for builds: an installation without extras lacks it

    high = np.where(np.isnan(z), np.float32(np.inf), z)
    fourth = ndimage.rank_filter(high, rank=3, size=9, mode="nearest")
    return np.asarray(np.isfinite(fourth) & (high < fourth - 1.0))


def _refined(shape: tuple[int, int], heights: Floats32, occupied: Ints, ground: Bools, cell: float) -> Floats32:
    """Raster the ground cells, and add lowest points near the interpolated raster, which restores steep slopes."""
    from scipy import ndimage  # only for builds: an installation without extras lacks it

    for _ in range(_REFINEMENTS + 1):
        raster = np.full(shape, np.nan, dtype=np.float32)
        raster.flat[occupied[ground]] = heights[ground]
        surface = filled(raster)
        # smooth a little: single low returns must not pull the surface down, and slopes need a scale
        smooth = ndimage.gaussian_filter(surface, 1.0 / cell, mode="nearest")
        away = np.abs(heights - smooth.flat[occupied])
        slope = _gradient(smooth, cell).flat[occupied]
        near = away <= _CLASS_THRESHOLD + _SLOPE_ALLOWANCE * slope
        ground = near | (ground & (away <= 2.0 + slope))
        if not ground.any():
            break
    return surface


def _gradient(z: Floats32, cell: float) -> Floats32:
    if min(z.shape) < 2:
        return np.zeros_like(z)
    dy, dx = np.gradient(z, cell)
    slope: Floats32 = np.minimum(np.hypot(dx, dy), 2.0).astype(np.float32)
    return slope


def _morphological_ground(z: Floats32, cell: float) -> Bools:
    """Mask the ground cells of a raster of lowest heights (H, W; NaN where empty; metres): a progressive filter.

    Openings with growing windows remove objects that are narrower than the window and rise above the opened surface
    by more than a slope of 0.3 explains.
    """
    from scipy import ndimage  # only for builds: an installation without extras lacks it

    surface = filled(z)
    ground = np.isfinite(z)
    window, previous = 1.0, 0.0
    while window <= _MAX_WINDOW:
        size = 2 * max(1, round(window / cell / 2)) + 1
        # separable: a square window costs two one-dimensional passes
        opened = ndimage.grey_opening(surface, size=(size, size), mode="nearest")
        threshold = min(_FIRST_THRESHOLD + _MAX_SLOPE * (window - previous) / 2, 3.0)
        ground &= ~(surface - opened > threshold)
        surface, previous, window = opened, window, window * 1.5
    return ground
