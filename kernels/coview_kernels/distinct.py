"""Selection of the best poses that differ from each other in place or heading."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from coview_kernels import reference, runtime
from coview_kernels.arrays import F32, I64, as_finite64
from coview_kernels.launch import Launch
from coview_kernels.warm_up import SAMPLE, compiled_by


def distinct_poses(positions: npt.ArrayLike, yaw: npt.ArrayLike, count: int, distance: float, turn: float) -> I64:
    """Choose the first poses that differ from all earlier choices; return at most ``count`` ascending indices (K,).

    Two poses are the same if they are less than ``distance`` apart and turned by less than ``turn``.

    Args:
        positions: (N, 3) metres, best first.
        yaw: (N,) radians.
        count: at least 1.
        distance: metres.
        turn: radians, at most pi.

    Raises:
        ValueError: another shape, NaN or inf, or ``count`` below 1.
    """
    place, heading = as_finite64("positions", positions, None, 3), as_finite64("yaw", yaw, None)
    if len(place) != len(heading):
        raise ValueError(f"yaw has shape {heading.shape}, but positions {place.shape}")
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    poses = np.empty((len(place), 5), dtype=np.float32)
    if not len(poses):
        return np.empty(0, dtype=np.int64)
    poses[:, :3] = place - place[0]  # float32 near its own zero
    poses[:, 3], poses[:, 4] = np.cos(heading), np.sin(heading)
    square, cosine = float(distance) ** 2, math.cos(turn)
    return runtime.dispatch_here(_launch.ready, _native, reference.distinct_poses, *(poses, count, square, cosine))


_REALS, _WHOLES = np.zeros(1, dtype=np.float32), np.zeros(1, dtype=np.int32)
_launch = Launch("distinct", "distinct", _REALS, _REALS, _WHOLES, _WHOLES, 0, 0, 0.0, 0.0)
"""One launch for all calls, as only one call of native code runs at a time."""


def _native(poses: F32, count: int, square: float, cosine: float) -> I64:
    kept = np.zeros(5 * count, dtype=np.float32)
    chosen, number = np.zeros(count, dtype=np.int32), np.zeros(1, dtype=np.int32)
    arguments = poses.reshape(-1), kept, chosen, number, len(poses), count, square, cosine
    for index, value in enumerate(arguments):
        _launch.put(index, value)
    _launch()
    return chosen[: int(number[0])].astype(np.int64)


compiled_by("distinct_poses", lambda: distinct_poses(SAMPLE, np.zeros(2), 1, 1.0, 1.0))
