"""Intake of a 64k-point frame and the descriptor of a keyframe, beside NumPy, with one thread on every side.

Intake: transform, range filter (0.5 to 80 m) and one point per 0.3 m voxel, of 64 rings of 1024 beams in a street with
2 cm of noise; beside the fastest NumPy that we could write (voxel and index in one int64, one sort).

Describe: both channels that a map stores, 20 x 60 bins, of a full virtual local scan: 20 keyframes 2 m apart, within
50 m, one point per 0.5 m voxel, 131,072 in the order of the keyframes. The baseline is the plain reference.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from bench.harness.rows import REPEAT, Row, against, medians
from coview_kernels import reference, transform_unique
from coview_stream.config import DescriptorConfig
from coview_stream.descriptors.coview import describe
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.geometry.transforms import pose_from

LIMITS = 0.3, 0.5, 80.0  # voxel, least and greatest range, metres
STANDING = pose_from([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]], [100.3, -20.2, 1.7])  # the robot's pose
_SCAN = 131_072


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


def best_numpy(points: Floats32, T: Floats) -> Floats32:
    """Return the same points as the kernel; presumes finite ones near the sensor."""
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


def rows(asked: Namespace) -> Iterator[Row]:
    """Take in a frame, then describe a keyframe."""
    points = frame()
    ours: Callable[[], Any] = partial(transform_unique, points, STANDING, *LIMITS)
    numpy: Callable[[], Any] = partial(best_numpy, points, STANDING)
    if not np.array_equal(ours()[0], numpy()):
        raise AssertionError("ours and NumPy disagree")
    taken, best = medians(ours, numpy, repeat=9 if asked.quick else REPEAT)
    yield against("intake, 64k points, beside the best NumPy", taken, best, "ms", 4.0)

    points, centre, config = _virtual_scan(), np.array([0.1, -0.2, -1.8]), DescriptorConfig()

    def plain() -> list[Floats32]:
        grid, _ = reference.polar_bin(points, centre, config.rings, config.sectors, config.radius)
        highest = np.where(grid.count > 0, np.maximum(grid.max_height, 0.0), 0.0).astype(np.float32)
        return [highest, reference.coview(grid.max_height, grid.count)]

    ours = partial(describe, points, centre, config)
    if not all(map(np.array_equal, ours().values(), plain())):
        raise AssertionError("ours and NumPy disagree")
    described, reference_ms = medians(ours, plain, repeat=5 if asked.quick else REPEAT)
    yield against(f"describe, {_SCAN} points", described, reference_ms, "ms", 10.0)


def _virtual_scan() -> Floats32:
    """Points (131072, 3) of 20 keyframes 2 m apart; heights are spread, since one street has too few voxels."""
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
