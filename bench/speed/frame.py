"""Intake of a 64k-point frame and the descriptor of a keyframe, beside NumPy.

Intake: transform, range filter (0.5 to 80 m) and one point per 0.3 m voxel. The frame has 64 rings of 1024 beams in a
street: ground, walls, ceiling of crowns, 2 cm of noise. Two baselines: the plain reference, and the fastest NumPy
that we could write (voxel and index in one int64, one sort). One thread on every side.

Describe: a full virtual local scan is what 20 keyframes see within 50 m, one point per 0.5 m voxel: here a street of
40 m with its frames every 2 m, laid over crowns and facades, 131,072 points in the order of the keyframes. Bins
20 x 60, both channels that a map stores (greatest height, co-visible). The baseline is the plain reference; its
co-visibility serves us too, since one grid takes it less than a launch.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator

import numpy as np

from bench.harness.rows import REPEAT, Row, against, bounded, medians
from coview_stream.geometry.arrays import Floats, Floats32

_LEAST = 4.0
LIMITS = 0.3, 0.5, 80.0


def frame(seed: int = 0) -> Floats32:
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


def pose() -> Floats:
    """Return where the robot stands, (4, 4)."""
    T = np.eye(4)
    T[:2, :2] = [[0.6, -0.8], [0.8, 0.6]]
    T[:3, 3] = 100.3, -20.2, 1.7
    return T


def best_numpy(points: Floats32, T: Floats) -> Floats32:
    """Return the same points; presumes finite ones near the sensor."""
    voxel, r_min, r_max = LIMITS
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
    return np.asarray(moved[first])


def _taken(repeat: int) -> list[float]:
    """Milliseconds of ours, of the reference and of the best NumPy; all must agree."""
    from coview_kernels import VoxelFilter, reference

    points, T = frame(), pose()
    ours = VoxelFilter(*LIMITS)

    def plain() -> Floats32:
        return reference.transform_unique(points, T, *LIMITS)[0]

    found, _ = ours(points, T)
    for other in (plain(), best_numpy(points, T)):
        if not np.array_equal(found, other):
            raise AssertionError("ours and NumPy disagree")
    return medians(lambda: ours(points, T), plain, lambda: best_numpy(points, T), repeat=repeat)


def allocated(frames: int = 100) -> float:
    """Kilobytes that Python and NumPy had allocated at most at a time during ``frames`` frames, warmed up."""
    import tracemalloc

    from coview_kernels import VoxelFilter

    points, T = frame(), pose()
    take = VoxelFilter(*LIMITS)
    take(points, T)
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        for _ in range(frames):
            take(points, T)
        return (tracemalloc.get_traced_memory()[1] - before) / 1e3
    finally:
        tracemalloc.stop()


def _intake(asked: Namespace) -> Iterator[Row]:
    """Ratios, and what a frame allocates (its points have 786 kB)."""
    ours, plain, best = _taken(9 if asked.quick else REPEAT)
    yield against("intake, 64k points, beside the best NumPy", ours, best, "ms", _LEAST)
    yield against("intake, 64k points, beside the reference", ours, plain, "ms", None)
    yield bounded("intake, memory allocated in 100 frames, at most", allocated(), "kB", 16.0)


_SCAN = 131_072
_DESCRIBE = 10.0


def virtual_scan() -> Floats32:
    """Points (131072, 3) of 20 keyframes 2 m apart; heights are spread, since one street has too few voxels."""
    from coview_kernels import reference

    rng = np.random.default_rng(1)
    parts = []
    for k in range(20):
        points = frame(k)
        points += np.array([2.0 * k - 20.0, 0.0, 0.0], dtype=np.float32)
        points[:, 1:] += rng.normal(0, 2.5, (len(points), 2)).astype(np.float32)
        parts.append(points[np.hypot(points[:, 0], points[:, 1]) < 50.0])
    unique = reference.transform_unique(np.concatenate(parts), np.eye(4), 0.5)[0]
    chosen = np.sort(rng.choice(len(unique), min(_SCAN, len(unique)), replace=False))
    return np.ascontiguousarray(unique[chosen])


def _described(repeat: int) -> list[float]:
    """Milliseconds of ours and the reference, then of binning alone, ours first."""
    import coview_kernels as kernels
    from coview_kernels import reference
    from coview_stream.config import DescriptorConfig
    from coview_stream.descriptors.coview import describe

    points, centre, config = virtual_scan(), np.array([0.1, -0.2, -1.8]), DescriptorConfig()
    size = config.rings, config.sectors, config.radius

    def plain() -> list[Floats32]:
        grid, _ = reference.polar_bin(points, centre, *size)
        highest = np.where(grid.count > 0, np.maximum(grid.max_height, 0.0), 0.0).astype(np.float32)
        return [highest, reference.coview(*grid)]

    if not all(map(np.array_equal, describe(points, centre, config).values(), plain())):
        raise AssertionError("ours and NumPy disagree")
    return medians(
        lambda: describe(points, centre, config),
        plain,
        lambda: kernels.polar_bin(points, centre, *size),
        lambda: reference.polar_bin(points, centre, *size),
        repeat=repeat,
    )


def _describe(asked: Namespace) -> Iterator[Row]:
    """Ratios of the whole and of its parts."""
    found = _described(5 if asked.quick else REPEAT)
    for what, least, k in (("", _DESCRIBE, 0), (", bins alone", None, 2)):
        yield against(f"describe, {_SCAN} points{what}", found[k], found[k + 1], "ms", least)


def rows(asked: Namespace) -> Iterator[Row]:
    """Take in a frame, then describe a keyframe."""
    yield from _intake(asked)
    yield from _describe(asked)
