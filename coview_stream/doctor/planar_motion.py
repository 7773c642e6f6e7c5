"""Motion between two lidar frames, seen from above and without odometry: what odometry's own is compared with.

What stands above the ground is drawn on a grid; the other frame's is turned by each of many headings and correlated
with it at all displacements at once (FFT). NumPy only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from coview_stream.doctor.ground_plane import thinned
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points

Complexes = npt.NDArray[np.complex128]

# set by hand; metres
_CELL = 0.25
_CELLS = 320
_NEAR, _FAR = 2.5, 36.0
_LOW, _HIGH = 0.5, 6.0  # above the ground: neither its rings, which move with the sensor, nor crowns
_REACH = 14.0  # longest displacement
_HEADINGS = np.radians(np.arange(-30.0, 30.1, 2.0))
_APART = 1.5  # another peak is this far away at least


@dataclass(frozen=True)
class PlanarMotion:
    """Motion of the sensor over the ground, in the first frame's levelled axes.

    Attributes:
        step: displacement, metres, x + iy.
        heading: radians to the left.
        distinct: height of the peak over the highest one elsewhere; 1 where a place looks alike from several.
    """

    step: complex
    heading: float
    distinct: float


@dataclass(frozen=True)
class Overhead:
    """What stands above the ground of a frame: (N) x + iy, metres, levelled axes."""

    at: Complexes


def overhead(points: Points, R_level: Floats, height: float) -> Overhead:
    """Return what stands above the ground; ``R_level`` (3, 3) levels the points (N, 3), ``height`` is the sensor's."""
    cloud = thinned(points, _CELL, _NEAR, _FAR) @ R_level.T
    above = cloud[:, 2] + height
    cloud = cloud[(above > _LOW) & (above < _HIGH)]
    return Overhead(np.unique(np.round(cloud[:, :2] / _CELL), axis=0) @ np.array([_CELL, 1j * _CELL]))


def planar_motion(one: Overhead, other: Overhead) -> PlanarMotion | None:
    """Return how the sensor moved from one frame to the other; None if there is too little to compare."""
    if min(len(one.at), len(other.at)) < 100:  # cells, set by hand
        return None
    fixed = np.conj(np.fft.rfft2(_smooth(_grid(one.at))))
    best, peaks = (-1.0, 0.0, 0j), []
    for heading in _HEADINGS:
        table = _correlation(fixed, other.at * np.exp(1j * heading))
        value, at = _peak(table)
        peaks.append((value, at, table))
        if value > best[0]:
            best = (value, float(heading), at)
    value, heading, at = best
    which = int(np.argmax([p[0] for p in peaks]))
    rival = max(_elsewhere(table, at) for _, _, table in peaks)
    heading += _parabola([p[0] for p in peaks], which) * float(_HEADINGS[1] - _HEADINGS[0])
    return PlanarMotion(at, heading, value / max(rival, 1e-9))


def _grid(at: Complexes) -> Floats:
    grid = np.zeros((_CELLS, _CELLS))
    x, y = (np.floor(v / _CELL).astype(int) + _CELLS // 2 for v in (at.real, at.imag))
    inside = (x >= 0) & (x < _CELLS) & (y >= 0) & (y < _CELLS)
    grid[x[inside], y[inside]] = 1.0
    return grid


def _smooth(grid: Floats) -> Floats:
    for axis in (0, 1):
        grid = 0.5 * grid + 0.25 * (np.roll(grid, 1, axis) + np.roll(grid, -1, axis))
    return grid


def _correlation(fixed: Complexes, at: Complexes) -> Floats:
    """Return what two grids share, (K, K), by displacement; its middle is none."""
    table = np.fft.irfft2(np.conj(fixed * np.fft.rfft2(_grid(at))), (_CELLS, _CELLS))
    half, reach = _CELLS // 2, int(_REACH / _CELL)
    table = np.fft.fftshift(table)
    return np.asarray(table[half - reach : half + reach + 1, half - reach : half + reach + 1])


def _peak(table: Floats) -> tuple[float, complex]:
    i, j = np.unravel_index(int(np.argmax(table)), table.shape)
    x = i + _parabola(table[:, j], int(i)) - table.shape[0] // 2
    y = j + _parabola(table[i], int(j)) - table.shape[1] // 2
    return float(table[i, j]), complex(x * _CELL, y * _CELL)


def _elsewhere(table: Floats, at: complex) -> float:
    axis = (np.arange(len(table)) - len(table) // 2) * _CELL
    return float(table[np.abs(axis[:, None] + 1j * axis - at) > _APART].max())


def _parabola(values: Floats | list[float], at: int) -> float:
    """Return by how many steps the summit lies beside the largest value."""
    if not 0 < at < len(values) - 1:
        return 0.0
    before, middle, after = float(values[at - 1]), float(values[at]), float(values[at + 1])
    curve = before - 2.0 * middle + after
    return 0.5 * (before - after) / curve if curve < 0 else 0.0
