"""Distinct poses, one after the other."""

from __future__ import annotations

import numpy as np

from coview_kernels.arrays import F32, I64


def distinct_poses(poses: F32, count: int, square: float, cosine: float) -> I64:
    """Choose the first poses that differ from all earlier choices; return their indices (K,).

    Args:
        poses: (N, 5) float32 position, and cosine and sine of the heading.
        count: greatest number of choices.
        square: square of the distance below which two positions are equal.
        cosine: cosine of the turn below which two headings are equal.
    """
    free = np.ones(len(poses), dtype=bool)
    chosen: list[int] = []
    while len(chosen) < count and free.any():
        k = int(free.argmax())
        chosen.append(k)
        x, y, z, c, s = (poses - np.concatenate([poses[k, :3], np.zeros(2, dtype=np.float32)])).T
        near = x * x + y * y + z * z < np.float32(square)
        free &= ~(near & (c * poses[k, 3] + s * poses[k, 4] > np.float32(cosine)))
        free[k] = False
    return np.array(chosen, dtype=np.int64)
