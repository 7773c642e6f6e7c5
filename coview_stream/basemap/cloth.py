"""Cloth simulation filter: the wheel of that name, silenced, and run by tiles."""

from __future__ import annotations

import ctypes
import functools
import importlib
import importlib.util
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from coview_stream.errors import DependencyError
from coview_stream.geometry.arrays import Bools, Floats32
from coview_stream.geometry.transforms import Points

_TILE = 256.0
_MARGIN = 24.0
"""Metres, set by hand. A cloth per tile rests after fewer steps and stays in the cache: 1.5 km2 as one took 75 s."""

_MIN_POINTS = 10  # for a cloth to rest on; set by hand


def cloth_available() -> bool:
    """Tell whether the wheel is installed; there is none for Python 3.13 and for ARM."""
    return importlib.util.find_spec("CSF") is not None


def require_cloth() -> None:
    """Raise DependencyError where the wheel is not installed."""
    if not cloth_available():
        raise DependencyError(
            "the ground filter `cloth` needs the wheel cloth-simulation-filter, which exists for x86-64 and Python up "
            "to 3.12: pip install cloth-simulation-filter there, or use method='morphological'"
        )


def cloth_ground(
    points: Points, *, resolution: float, rigidness: int, slope_smooth: bool, iterations: int, threshold: float
) -> Bools:
    """Mask the points (N, 3), metres, on which the cloth comes to lie, dropped on the upturned cloud.

    Raises:
        DependencyError: the wheel is not installed.
    """
    require_cloth()
    ground = np.zeros(len(points), dtype=bool)
    low = points[:, :2].min(axis=0).astype(np.float64)
    counts = np.maximum(1, np.ceil(np.ptp(points[:, :2], axis=0) / _TILE)).astype(int)
    size = np.ptp(points[:, :2], axis=0).astype(np.float64) / counts + 1e-3
    tile = np.minimum(((points[:, :2] - low) / size).astype(int), counts - 1)
    for i in range(counts[0]):
        strip = np.flatnonzero(_between(points[:, 0], low[0] + size[0] * i, size[0]))
        for j in range(counts[1]):
            index = strip[_between(points[strip, 1], low[1] + size[1] * j, size[1])]
            own = (tile[index] == (i, j)).all(axis=1)
            if not own.any():
                continue
            inside = own
            if len(index) >= _MIN_POINTS:
                inside = _one_cloth(points[index], resolution, rigidness, slope_smooth, iterations, threshold)
            ground[index[inside & own]] = True
    return ground


def _between(values: Floats32, start: float, length: float) -> Bools:
    return np.asarray((values > start - _MARGIN) & (values < start + length + _MARGIN))


def _one_cloth(
    points: Points, resolution: float, rigidness: int, slope_smooth: bool, iterations: int, threshold: float
) -> Bools:
    csf = importlib.import_module("CSF")
    _one_thread()
    cloth = csf.CSF()
    cloth.params.bSloopSmooth = slope_smooth
    cloth.params.cloth_resolution = resolution
    cloth.params.rigidness = rigidness
    cloth.params.interations = iterations  # the wheel's spelling
    cloth.params.class_threshold = threshold
    kept, rest = csf.VecInt(), csf.VecInt()
    with _silence():
        cloth.setPointCloud(points.astype(np.float64))
        cloth.do_filtering(kept, rest, False)
    mask = np.zeros(len(points), dtype=bool)
    mask[np.array(kept, dtype=np.intp)] = True
    return mask


@functools.cache
def _one_thread() -> None:
    """Run the cloth in one thread: its many short parallel loops busy-wait, three times slower on busy cores."""
    library = importlib.import_module("_CSF").__file__
    try:
        # its private OpenMP is among its dependencies, where a symbol lookup by handle finds it
        ctypes.CDLL(library).omp_set_num_threads(1)
    except (OSError, AttributeError):
        return  # built without OpenMP


@contextmanager
def _silence() -> Iterator[None]:
    """Discard what the C library writes to standard output: the wheel reports every step there."""
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
            libc.fflush(None)  # before the descriptor comes back, or its buffer is written to the real output
        os.dup2(saved, 1)
        os.close(null)
        os.close(saved)
