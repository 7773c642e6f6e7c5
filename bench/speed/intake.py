"""Intake of a 64k-point frame beside NumPy: ``python -m bench intake``.

Transform, range filter (0.5 to 80 m), one point per 0.3 m voxel, and the 20 x 60 polar bins of what is left. The
frame has 64 rings of 1024 beams in a street: ground, walls, ceiling of crowns, 2 cm of noise. Two baselines: the
plain reference, and the fastest NumPy that we could write (voxel and index in one int64, one sort). Threads:
COVIEW_THREADS, all cores by default.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from bench.harness.rows import REPEAT, Row, against, bounded, informs, medians

if TYPE_CHECKING:
    from coview_kernels.arrays import F32, PolarGrid

_LEAST = 4.0
_LIMITS = 0.3, 0.5, 80.0
_BINS = 20, 60, 50.0


def frame(seed: int = 0) -> npt.NDArray[np.float32]:
    """One turn (65536, 3) of a 64-beam lidar in a street, row by row, metres."""
    rng = np.random.default_rng(seed)
    elevation = np.deg2rad(np.linspace(-25, 15, 64))[:, None]
    azimuth = (np.arange(1024) * (2 * np.pi / 1024))[None, :]
    level = np.cos(elevation)
    beams = np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation) + 0 * azimuth], axis=-1
    ).reshape(-1, 3)
    reach = np.full(len(beams), 75.0)
    for axis, plane in ((2, -1.8), (1, 12.0), (1, -9.0), (0, 45.0), (0, -38.0), (2, 14.0)):
        with np.errstate(divide="ignore"):
            hit = plane / beams[:, axis]
        reach = np.where((hit > 0) & (hit < reach), hit, reach)
    noisy = reach + rng.normal(0, 0.02, len(reach))
    return np.asarray(beams * noisy[:, None], dtype=np.float32)


def pose() -> npt.NDArray[np.float64]:
    """Return where the robot stands, (4, 4)."""
    T = np.eye(4)
    T[:2, :2] = [[0.6, -0.8], [0.8, 0.6]]
    T[:3, 3] = 100.3, -20.2, 1.7
    return T


def best_numpy(points: npt.NDArray[np.float32], T: npt.NDArray[np.float64]) -> tuple[F32, PolarGrid]:
    """Return the same points and bins; presumes finite points near the sensor."""
    from coview_kernels import reference

    voxel, r_min, r_max = _LIMITS
    x, y, z = points.T.astype(np.float64)
    r2 = x * x + y * y + z * z
    moved = np.empty(points.shape, np.float32)
    for k in range(3):
        moved[:, k] = T[k, 0] * x + T[k, 1] * y + T[k, 2] * z + T[k, 3]
    keep = (r2 >= r_min * r_min) & (r2 < r_max * r_max)
    if not keep.all():
        moved = moved[keep]
    cells = np.floor(moved.T.astype(np.float64) * (1 / voxel)).astype(np.int64)
    a, b, c = cells - cells.min(axis=1, keepdims=True)
    bits = int(len(moved) - 1).bit_length()
    key = (((a * (int(b.max()) + 1) + b) * (int(c.max()) + 1) + c) << bits) | np.arange(len(moved))
    key.sort()
    new = np.empty(len(key), dtype=bool)
    new[0] = True
    np.not_equal(key[1:] >> bits, key[:-1] >> bits, out=new[1:])
    first = key[new] & ((1 << bits) - 1)
    first.sort()
    unique = moved[first]
    return unique, reference.polar_bin(unique, T[:3, 3], *_BINS)[0]


def measure(repeat: int) -> list[float]:
    """Milliseconds of ours, of ours without bins, of the reference and of the best NumPy; all must agree."""
    from coview_kernels import FrameIntake, reference

    points, T = frame(), pose()
    full, thin = FrameIntake(*_LIMITS, _BINS), FrameIntake(*_LIMITS)

    def plain() -> tuple[F32, PolarGrid]:
        unique, _ = reference.transform_unique(points, T, *_LIMITS)
        return unique, reference.polar_bin(unique, T[:3, 3], *_BINS)[0]

    taken = full(points, T)
    for unique, grid in (plain(), best_numpy(points, T)):
        same = taken.grid is not None and all(map(np.array_equal, taken.grid, grid))
        if not same or not np.array_equal(taken.points, unique):
            raise AssertionError("ours and NumPy disagree")
    sides = (lambda: full(points, T), lambda: thin(points, T), plain, lambda: best_numpy(points, T))
    return medians(*sides, repeat=repeat)


def allocated(frames: int = 100) -> float:
    """Kilobytes that Python and NumPy had allocated at most at a time during ``frames`` frames, warmed up."""
    import tracemalloc

    from coview_kernels import FrameIntake

    points, T = frame(), pose()
    take = FrameIntake(*_LIMITS, _BINS)
    take(points, T)
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        for _ in range(frames):
            take(points, T)
        return (tracemalloc.get_traced_memory()[1] - before) / 1e3
    finally:
        tracemalloc.stop()


def rows(quick: bool = False) -> Iterator[Row]:
    """Ratios, and what a frame allocates (its points have 786 kB)."""
    ours, thin, plain, best = measure(9 if quick else REPEAT)
    yield against("intake, 64k points, beside the best NumPy", ours, best, "ms", _LEAST)
    yield against("intake, 64k points, beside the reference", ours, plain, "ms", None)
    yield informs("intake, 64k points, without bins", thin, "ms")
    yield bounded("intake, memory allocated in 100 frames, at most", allocated(), "kB", 16.0)
