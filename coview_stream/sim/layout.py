"""Layout of a scene: streets, the robot's closed route, the ground, and its occupied cells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

from coview_stream.geometry.arrays import Bools, Floats, Floats32, Indices
from coview_stream.sim.mesh import Mesh, height_field

_LOOP_STEP = 0.25  # metres between points of the route
_STREET_STEP = 1.0  # metres between points of a street
_CELL = 0.5  # metres; finer than the narrowest relevant gap, between a pole and a kerb


@dataclass(frozen=True)
class Layout:
    """Streets of a scene."""

    route: Floats  # (N, 2) closed loop, metres, points _LOOP_STEP apart; one of the streets
    streets: tuple[Floats, ...]  # (K_i, 2) centre lines, metres, points a metre apart
    half_width: float  # metres from the centre line to the edge of the carriageway


def resample(points: Floats, step: float) -> Floats:
    """Return a polyline (N, 2) with points ``step`` metres apart."""
    arc = arc_lengths(points)
    count = max(2, round(arc[-1] / step) + 1)
    at = np.linspace(0.0, arc[-1], count)
    return np.column_stack([np.interp(at, arc, points[:, 0]), np.interp(at, arc, points[:, 1])])


def arc_lengths(points: Floats) -> Floats:
    """Return the metres (N,) along a polyline (N, 2)."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def directions(points: Floats) -> Floats:
    """Return the headings (N,) of a polyline (N, 2), radians."""
    tangent = np.gradient(points, axis=0)
    return np.asarray(np.arctan2(tangent[:, 1], tangent[:, 0]))


def grid_layout(
    rng: np.random.Generator, size: float, half: float, spacing: tuple[float, float], half_width: float, bend: float
) -> Layout:
    """Return blocks between crossing streets, some inside the loop; streets curve by ``bend`` metres."""
    yaw = rng.uniform(0, np.pi / 2)
    xs, x0, x1 = _loop_lines(_street_lines(rng, half, spacing), size)
    ys, y0, y1 = _loop_lines(_street_lines(rng, half, spacing), size)
    across = np.linspace(-1.5 * half, 1.5 * half, 200)
    straight = [np.column_stack([np.full(200, x), across]) for x in xs]
    straight += [np.column_stack([across, np.full(200, y)]) for y in ys]
    phase = rng.uniform(0, 2 * np.pi, 2)
    length = rng.uniform(110, 170)

    def warp(points: Floats) -> Floats:
        x, y = points.T
        bent = np.column_stack(
            [x + bend * np.sin(y * 2 * np.pi / length + phase[0]), y + bend * np.sin(x * 6.0 / length + phase[1])]
        )
        c, s = np.cos(yaw), np.sin(yaw)
        return np.asarray(bent @ np.array([[c, s], [-s, c]]))

    route = resample(warp(_rounded_rectangle(x0, x1, y0, y1, radius=7.0)), _LOOP_STEP)
    streets = [_inside(resample(warp(line), _STREET_STEP), half) for line in straight]
    return Layout(route, tuple(line for line in streets if len(line) > 10), half_width)


def loop_layout(
    rng: np.random.Generator, size: float, half: float, half_width: float, branches: int, waviness: float
) -> Layout:
    """Return a winding loop with side roads outwards, and one path across its middle."""
    angle = np.linspace(0, 2 * np.pi, 1500)
    radius = np.ones_like(angle)
    for k in (2, 3, 4):
        radius += waviness / k * np.cos(k * angle + rng.uniform(0, 2 * np.pi))
    scale = rng.uniform(0.22, 0.29, 2) * size / radius.max()
    turn, shift = rng.uniform(0, 2 * np.pi), rng.uniform(-0.05, 0.05, 2) * size
    loop = np.column_stack([scale[0] * radius * np.cos(angle), scale[1] * radius * np.sin(angle)])
    loop = loop @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) + shift
    route = resample(loop, _LOOP_STEP)
    streets = [resample(route, _STREET_STEP)]
    for start in rng.permutation(branches):
        at = int((start + rng.uniform(0.1, 0.9)) / branches * (len(route) - 1))
        outward = directions(route)[at] - np.pi / 2  # the loop runs counter-clockwise
        heading = outward + np.cumsum(rng.normal(0, 0.02, int(2 * half / _STREET_STEP)))
        steps = _STREET_STEP * np.column_stack([np.cos(heading), np.sin(heading)])
        streets.append(_inside(route[at] + np.cumsum(steps, axis=0), half))
    a, b = rng.integers(0, len(route) // 3), rng.integers(len(route) // 2, 5 * len(route) // 6)
    streets.append(resample(route[[a, b]], _STREET_STEP))
    return Layout(route, tuple(line for line in streets if len(line) > 10), half_width)


def _street_lines(rng: np.random.Generator, half: float, spacing: tuple[float, float]) -> Floats:
    gaps = rng.uniform(*spacing, size=int(3.2 * half / spacing[0]) + 2)
    lines = np.cumsum(gaps)
    return np.asarray(lines - lines[len(lines) // 2] + rng.uniform(-0.5, 0.5) * spacing[0])


def _loop_lines(lines: Floats, size: float) -> tuple[Floats, float, float]:
    """Choose the two street lines that bound the loop; return all lines and these two.

    They are the nearest to a quarter of the map's size on either side of its centre, moved if they would leave the
    map; streets that then run too close to them are dropped.
    """
    near, far = 0.14 * size, 0.28 * size
    low = np.clip(lines[np.argmin(np.abs(lines + 0.24 * size))], -far, -near)
    high = np.clip(lines[np.argmin(np.abs(lines - 0.24 * size))], near, far)
    apart = 0.5 * float(np.diff(lines).min())
    clear = (np.abs(lines - low) > apart) & (np.abs(lines - high) > apart)
    return np.concatenate([lines[clear], [low, high]]), float(low), float(high)


def _rounded_rectangle(x0: float, x1: float, y0: float, y1: float, radius: float) -> Floats:
    corners = [(x1, y0, -np.pi / 2), (x1, y1, 0.0), (x0, y1, np.pi / 2), (x0, y0, np.pi)]
    points = []
    for x, y, begin in corners:
        centre = np.array([x - radius if x == x1 else x + radius, y - radius if y == y1 else y + radius])
        arc = begin + np.linspace(0, np.pi / 2, 20)
        points.append(centre + radius * np.column_stack([np.cos(arc), np.sin(arc)]))
    loop = np.concatenate([*points, points[0][:1]])
    return resample(loop, 1.0)


def _inside(points: Floats, half: float) -> Floats:
    return points[(np.abs(points) < half).all(axis=1)]


class Site:
    """Ground of a scene, a square of +-``half`` metres about the origin, with its occupied cells.

    ``relief`` and ``roughness`` are the amplitudes of the hills and of bumps off the road, ``ditch`` is the depth of
    the ditches along roads; metres.
    """

    def __init__(
        self, rng: np.random.Generator, layout: Layout, half: float, *, relief: float, roughness: float, ditch: float
    ) -> None:
        self.half = half
        self.layout = layout
        n = int(2 * half / _CELL) + 1
        centre = np.ones((n, n), dtype=bool)
        for line in (layout.route, *layout.streets):
            i, j = np.clip(((line + half) / _CELL).astype(np.intp), 0, n - 1).T
            centre[i, j] = False
        # distance of each cell to a street's centre, metres, and the occupied cells, at first the streets
        self._road: Floats32 = (distance_transform_edt(centre) * _CELL).astype(np.float32)
        self._taken: Bools = self._road < layout.half_width
        step = max(1.0, half / 180.0)
        self._axis: Floats = np.linspace(-half, half, 2 * int(half / step) + 1, dtype=np.float64)
        X, Y = np.meshgrid(self._axis, self._axis, indexing="ij")
        z = np.zeros_like(X)
        for wavelength, share in ((230.0, 1.0), (140.0, 0.6), (70.0, 0.2), (35.0, 0.06)):
            heading, phase = rng.uniform(0, 2 * np.pi, 2)
            along = X * np.cos(heading) + Y * np.sin(heading)
            z += share * relief * np.sin(2 * np.pi * along / wavelength + phase)
        off_road = self.road_distance(X.ravel(), Y.ravel()).reshape(X.shape) - layout.half_width
        bumps = gaussian_filter(rng.normal(size=X.shape), 2.0)
        z += roughness * bumps / bumps.std() * np.clip(off_road / 3.0, 0.0, 1.0)
        self._heights: Floats = z - ditch * np.exp(-(((off_road - 1.5) / 0.9) ** 2))

    def z(self, x: npt.ArrayLike, y: npt.ArrayLike) -> Floats:
        """Return the ground height at coordinates (N,), metres."""
        scale = (len(self._axis) - 1) / (2 * self.half)
        at = (np.stack(np.broadcast_arrays(np.atleast_1d(x), np.atleast_1d(y))) + self.half) * scale
        return np.asarray(map_coordinates(self._heights, at, order=1, mode="nearest"))

    def height(self, x: float, y: float) -> float:
        """Return the ground height at one place, metres."""
        return float(self.z(x, y)[0])

    def mesh(self, cover: Callable[[Floats, Floats], Floats] | None = None) -> Mesh:
        """Return the ground's mesh, raised by a ``cover``: (x, y) -> depth (N,), metres."""
        if cover is None:
            return height_field(self._axis, self._heights)
        X, Y = np.meshgrid(self._axis, self._axis, indexing="ij")
        return height_field(self._axis, self._heights + cover(X.ravel(), Y.ravel()).reshape(X.shape))

    def road_distance(self, x: Floats, y: Floats) -> Floats:
        """Return the metres (N,) to the nearest street's centre line."""
        i, j = self._cells(x, y)
        return self._road[i, j].astype(np.float64)

    def claim(self, x: float, y: float, w: float, d: float, yaw: float = 0.0, margin: float = 0.0) -> bool:
        """Occupy a w x d rectangle if it and ``margin`` metres around are free of roads and other claims."""
        wide = self._footprint(x, y, w + 2 * margin, d + 2 * margin, yaw)
        if np.abs(wide).max() >= self.half or self._taken[self._cells(*wide.T)].any():
            return False
        self.occupy(x, y, w, d, yaw)
        return True

    def occupy(self, x: float, y: float, w: float, d: float, yaw: float) -> None:
        """Occupy a w x d rectangle, free or not."""
        self._taken[self._cells(*self._footprint(x, y, w, d, yaw).T)] = True

    def _footprint(self, x: float, y: float, w: float, d: float, yaw: float) -> Floats:
        u, v = np.arange(-w / 2, w / 2 + _CELL, 0.8 * _CELL), np.arange(-d / 2, d / 2 + _CELL, 0.8 * _CELL)
        U, V = (a.ravel() for a in np.meshgrid(np.minimum(u, w / 2), np.minimum(v, d / 2)))
        c, s = np.cos(yaw), np.sin(yaw)
        return np.column_stack([x + c * U - s * V, y + s * U + c * V])

    def _cells(self, x: Floats, y: Floats) -> tuple[Indices, Indices]:
        last = len(self._taken) - 1
        i, j = (np.clip(((a + self.half) / _CELL).astype(np.intp), 0, last) for a in (x, y))
        return i, j
