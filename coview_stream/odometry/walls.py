"""Up, from what stands upright: walls are vertical where the ground slopes.

Measured on nine simulated worlds, 20 frames each (town, campus, village, industrial; vlp16, os64, mid360): the ground's
normal leans 0.4 to 4.1 degrees against gravity (medians), with the walls taken into account 0.05 to 0.33. The walls
of these worlds are plumb; real ones nearly so.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

SLOPE = float(np.radians(4.0))
"""One sigma of how far the ground's normal leans, radians."""

_MOST_POINTS = 20_000
_REACH = 40.0  # metres around the sensor
_CELL = 2.0  # metres: points of one such cube are fitted by a plane
_LEAST_POINTS = 8
_THICKEST = 0.04  # metres, one sigma, off the plane
_LEAST_WIDTH = 0.2  # metres, one sigma, along the shorter axis in the plane
_UPRIGHT = np.sin(np.radians(15.0))
_WALL_SIGMA = np.radians(2.0)  # of a patch; farther off it counts less and less
_ROUNDS = 10


def upright(points: npt.NDArray[np.floating], up: Array, sigma: float = SLOPE) -> tuple[Array, int]:
    """Return ``up`` (3,), good to ``sigma`` radians, corrected by the walls in a cloud (N, 3), metres.

    Where there are none, or all face one way, it stays as it is in the directions that they say nothing of.

    Returns:
        The unit vector, and how many patches of wall it was taken from.
    """
    normals = _patches(points[:: 1 + len(points) // _MOST_POINTS].astype(np.float64), up)
    better = up
    for _ in range(_ROUNDS):
        weights = 1.0 / (_WALL_SIGMA**2 + (normals @ better) ** 2)  # Cauchy's: a car's door is no wall
        information = (normals.T * weights) @ normals + np.eye(3) / sigma**2
        better = np.linalg.solve(information, up / sigma**2)
        better /= np.linalg.norm(better)
    return better, len(normals)


def _patches(points: Array, up: Array) -> Array:
    """Return normals (K, 3) of the flat, roughly upright pieces of surface around."""
    near = points[(points**2).sum(axis=1) < _REACH**2]
    cell = np.floor(near / _CELL).astype(np.int64) @ np.array([1 << 40, 1 << 20, 1])
    _, which, count = np.unique(cell, return_inverse=True, return_counts=True)
    mean = _sums(near, which, len(count)) / count[:, None]
    off = near - mean[which]
    moments = _sums((off[:, :, None] * off[:, None, :]).reshape(-1, 9), which, len(count)) / count[:, None]
    spread, axes = np.linalg.eigh(moments[count >= _LEAST_POINTS].reshape(-1, 3, 3))
    normals = axes[:, :, 0]
    flat = (spread[:, 0] < _THICKEST**2) & (spread[:, 1] > _LEAST_WIDTH**2)
    return np.asarray(normals[flat & (np.abs(normals @ up) < _UPRIGHT)])


def _sums(values: Array, which: npt.NDArray[np.intp], count: int) -> Array:
    """Add up, (count, K), the rows of values (N, K) that go to each of ``count`` places."""
    return np.stack([np.bincount(which, column, minlength=count) for column in values.T], axis=1)
