"""Gravity's direction in the body frame, from the ground around a lidar and the walls on it.

The ground is a plane through the lowest points. Its normal is gravity's direction only where the ground is level. Walls
are vertical on slopes, too, and correct it. On a slope without walls the odometry frame leans with the slope.

Measured once, by no command of this repository, on nine simulated worlds, 20 frames each (town, campus, village,
industrial; vlp16, os64, mid360): the ground's normal leans by 0.4 to 4.1 degrees against gravity (medians), by 0.05 to
0.33 when corrected by the walls. The walls of these worlds are exactly vertical.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from coview_stream.config.odometry import MAX_TILT
from coview_stream.geometry.arrays import Floats, Indices, Reals

SLOPE = float(np.radians(4.0))
"""One sigma of the lean of the ground's normal, radians, from the figures above."""

# the ground; set by hand
_REACH = 25.0  # metres around the sensor
_CELL = 1.0  # metres, of cells from which the lowest points are taken
_BAND = 0.15  # metres to both sides of the plane
_MIN_HEIGHT = 0.1  # metres of the sensor above the ground
_TRIALS = 400  # planes through three points
_REFINEMENTS = 5
_MIN_CELLS = 40
_MIN_SHARE = 0.4  # of the cells, in the plane
_MAX_BELOW = 0.25  # share of the cells below the plane: a table top is not the ground
_MIN_EXTENT = 2.0  # metres, one sigma, of the ground's cells along the shorter axis

# patches of wall; set by hand
_WALL_POINTS = 20_000  # of a cloud
_WALL_REACH = 40.0  # metres around the sensor
_WALL_CELL = 2.0  # metres, of cubes with one plane each
_WALL_MIN_POINTS = 8
_WALL_MAX_THICKNESS = 0.04  # metres, one sigma, off the plane
_WALL_MIN_WIDTH = 0.2  # metres, one sigma, along the shorter axis in the plane
_WALL_MAX_LEAN = np.sin(np.radians(15.0))
_WALL_SIGMA = np.radians(2.0)  # of a patch; larger leans count less and less
_WALL_ROUNDS = 10
_WIDE = float(np.radians(10.0))  # initial sigma of the direction in a search for walls
_UNSEEN = float(np.radians(30.0))  # sigma of the walls' vertical in a direction that no wall faces


@dataclass(frozen=True)
class Ground:
    """A plane below the sensor."""

    up: Floats  # (3,) unit vector in the body frame: the plane's normal, corrected by walls
    height: float  # of the sensor above it, metres
    share: float  # of the surrounding cells, with the lowest point in the plane
    cells: int  # number of these cells
    walls: int = 0  # number of wall patches that corrected ``up``


def find_ground(points: Reals) -> Ground | str:
    """Find the ground in a cloud (N, 3), body frame with z about up, metres; else return the reason."""
    ground = ground_plane(points)
    if isinstance(ground, str):
        return ground
    corrected, walls = gravity_from_walls(points, ground.up)
    return replace(ground, up=corrected, walls=walls)


def ground_plane(points: Reals, near: Ground | None = None) -> Ground | str:
    """Find the ground without walls; arguments as in :func:`find_ground`, ``near`` an expected ground to try first."""
    points = np.asarray(points, dtype=np.float64)
    points = points[(points[:, :2] ** 2).sum(axis=1) < _REACH**2]
    cell = np.floor(points[:, :2] / _CELL).astype(np.int64) @ np.array([1 << 20, 1])
    order = np.lexsort((points[:, 2], cell))
    lowest = points[order][np.diff(cell[order], prepend=-(1 << 62)) != 0]
    if len(lowest) < _MIN_CELLS:
        return f"only {len(lowest)} cells of {_CELL:g} m within {_REACH:g} m hold points"
    if near is not None:
        ground = _checked(lowest, _refined(lowest, (near.up, near.height)))
        if not isinstance(ground, str):
            return ground
    return _checked(lowest, _refined(lowest, _consensus_plane(lowest)))


def _checked(lowest: Floats, plane: tuple[Floats, float] | None) -> Ground | str:
    """Return the plane as the ground below the sensor, or the reason against it."""
    if plane is None:
        return "no plane below the sensor fits three of the lowest points"
    up, height = plane
    if up[2] < np.cos(MAX_TILT) or height < _MIN_HEIGHT:  # moved there by refinement
        return "the best plane does not lie below the sensor"
    above = lowest @ up + height
    inside = np.abs(above) < _BAND
    share, below = float(inside.mean()), float((above < -2 * _BAND).mean())
    if inside.sum() < _MIN_CELLS or share < _MIN_SHARE:
        return f"the best plane holds {share:.0%} of the lowest points around; {_MIN_SHARE:.0%} are asked for"
    if below > _MAX_BELOW:
        return f"{below:.0%} of the lowest points around lie below the best plane"
    extent = np.sqrt(np.linalg.eigvalsh(np.cov(lowest[inside].T))[1])
    if extent < _MIN_EXTENT:
        return f"the best plane is a strip, {extent:.1f} m wide (one sigma)"
    return Ground(up, float(height), share, int(inside.sum()))


def gravity_from_walls(points: Reals, up: Floats) -> tuple[Floats, int]:
    """Correct ``up`` (3,), found by the ground, by the walls in a cloud (N, 3), metres; count their patches, too.

    Directions that no wall faces stay unchanged.
    """
    better, _, count = wall_evidence(points, up, SLOPE)
    return better, count


def wall_evidence(points: Reals, up: Floats, sigma: float) -> tuple[Floats, Floats, int]:
    """Return ``up`` (sigma in radians) corrected by walls, their information (3, 3), 1 / rad^2, and their number."""
    normals = _patches(points[:: 1 + len(points) // _WALL_POINTS].astype(np.float64), up)
    better, walls = up, np.zeros((3, 3))
    for _ in range(_WALL_ROUNDS):
        weights = 1.0 / (_WALL_SIGMA**2 + (normals @ better) ** 2)  # Cauchy's, as a car's door is not a wall
        walls = (normals.T * weights) @ normals
        better = np.linalg.solve(walls + np.eye(3) / sigma**2, up / sigma**2)
        better /= np.linalg.norm(better)
    return better, walls, len(normals)


def level_rotation(up: Floats) -> Floats:
    """Return the rotation (3, 3), odometry <- body, that turns ``up`` (3,) to z and keeps x pointing forward."""
    x = np.array([1.0, 0.0, 0.0]) - up[0] * up
    x /= np.linalg.norm(x)  # up leans by 60 degrees at most, so x is never along it
    return np.stack([x, np.cross(up, x), up])


def _consensus_plane(lowest: Floats) -> tuple[Floats, float] | None:
    """Return the plane with the most points among planes through three random points (RANSAC)."""
    rng = np.random.default_rng(0)  # the same cloud gives the same ground
    a, b, c = np.moveaxis(lowest[rng.integers(len(lowest), size=(_TRIALS, 3))], 1, 0)
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    usable = lengths > 1.0  # square metres, twice the triangle's area; slivers are ill-conditioned
    normals = normals[usable] / lengths[usable, None] * np.sign(normals[usable, 2:])
    heights = -(normals * a[usable]).sum(axis=1)
    ground = (normals[:, 2] > np.cos(MAX_TILT)) & (heights > _MIN_HEIGHT)
    if not ground.any():
        return None
    normals, heights = normals[ground], heights[ground]
    inside = np.abs(lowest @ normals.T + heights) < _BAND
    best = int(inside.sum(axis=0).argmax())
    return normals[best], float(heights[best])


def _refined(lowest: Floats, plane: tuple[Floats, float] | None) -> tuple[Floats, float] | None:
    """Fit the plane to the points within it by least squares, five times."""
    for _ in range(_REFINEMENTS if plane else 0):
        assert plane is not None
        up, height = plane
        inside = lowest[np.abs(lowest @ up + height) < _BAND]
        if len(inside) < 3:
            return None
        centre = inside.mean(axis=0)
        normal = np.linalg.svd(inside - centre, full_matrices=False)[2][2]
        normal *= np.sign(normal[2]) or 1.0
        plane = normal, float(-normal @ centre)
    return plane


def _patches(points: Floats, up: Floats) -> Floats:
    """Return normals (K, 3) of the flat, roughly upright surface patches."""
    near = points[(points**2).sum(axis=1) < _WALL_REACH**2]
    cell = np.floor(near / _WALL_CELL).astype(np.int64) @ np.array([1 << 40, 1 << 20, 1])
    _, cell_of, count = np.unique(cell, return_inverse=True, return_counts=True)
    mean = _sums(near, cell_of, len(count)) / count[:, None]
    off = near - mean[cell_of]
    moments = _sums((off[:, :, None] * off[:, None, :]).reshape(-1, 9), cell_of, len(count)) / count[:, None]
    variances, axes = np.linalg.eigh(moments[count >= _WALL_MIN_POINTS].reshape(-1, 3, 3))
    normals = axes[:, :, 0]
    flat = (variances[:, 0] < _WALL_MAX_THICKNESS**2) & (variances[:, 1] > _WALL_MIN_WIDTH**2)
    return np.asarray(normals[flat & (np.abs(normals @ up) < _WALL_MAX_LEAN)])


def _sums(values: Floats, cell_of: Indices, count: int) -> Floats:
    """Return the sums (count, K) of values (N, K) by cell number (N,)."""
    return np.stack([np.bincount(cell_of, column, minlength=count) for column in values.T], axis=1)


@dataclass(frozen=True)
class Plumb:
    """The vertical by the surrounding surfaces, in level axes, for a filter."""

    walls: Floats | None  # (2,) x and y of the vertical by the walls, a unit vector; None without walls
    covariance: Floats  # (2, 2) of ``walls``, radians squared, up to a factor
    ground: Floats | None  # (2,) x and y of the ground's unit normal; None without ground

    def rows(self) -> tuple[Floats, Indices]:
        """Return the measurement (4,), zeros for missing parts, and the indices (K,) of the present components."""
        y = np.concatenate([np.zeros(2) if part is None else part for part in (self.walls, self.ground)])
        return y, np.flatnonzero(np.repeat([self.walls is not None, self.ground is not None], 2))


@dataclass(frozen=True)
class Surfaces:
    """Walls and ground around one frame, in its body frame."""

    walls: Floats | None  # (3,) vertical by the walls, a unit vector; None without walls
    information: Floats  # (3, 3) of ``walls``, 1 / radians squared
    ground: Ground | None  # None without ground

    @classmethod
    def around(cls, points: Reals, up: Floats, near: Ground | None) -> Surfaces:
        """Measure in a frame (N, 3), metres, with ``up`` (3,) known to some degrees and the last ground ``near``."""
        walls, information, count = wall_evidence(points, up, _WIDE)
        plane = ground_plane(points, near)
        return cls(walls if count else None, information, None if isinstance(plane, str) else plane)

    def seen(self, R: Floats) -> Plumb:
        """Return the vertical in level axes, up to a small tilt; ``R`` (3, 3) is these axes <- body."""
        information = (R @ self.information @ R.T)[:2, :2] + np.eye(2) / _UNSEEN**2
        return Plumb(
            None if self.walls is None else (R @ self.walls)[:2],
            np.asarray(np.linalg.inv(information), dtype=np.float64),
            None if self.ground is None else (R @ self.ground.up)[:2],
        )
