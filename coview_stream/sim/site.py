"""The ground of a scene: its relief, its roads, and which square metres are taken."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

from coview_stream.sim.layout import Layout
from coview_stream.sim.mesh import Floats, Mesh, height_field

_CELL = 0.5  # metres; finer than the narrowest gap that matters, between a pole and a kerb


class Site:
    """A square piece of land of +-``half`` metres about the origin.

    ``relief`` is the amplitude of the hills, ``roughness`` that of the ground off the road, ``ditch`` the
    depth of the ditches along it; metres.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        layout: Layout,
        half: float,
        *,
        relief: float,
        roughness: float,
        ditch: float,
    ) -> None:
        self.half = half
        self.layout = layout
        self._taken, self._road = _rasters(layout, half)
        step = max(1.0, half / 180.0)
        self._axis: Floats = np.linspace(-half, half, 2 * int(half / step) + 1, dtype=np.float64)
        self._heights = self._relief(rng, relief, roughness, ditch)

    def _relief(self, rng: np.random.Generator, relief: float, roughness: float, ditch: float) -> Floats:
        X, Y = np.meshgrid(self._axis, self._axis, indexing="ij")
        z = np.zeros_like(X)
        for wavelength, share in ((230.0, 1.0), (140.0, 0.6), (70.0, 0.2), (35.0, 0.06)):
            heading, phase = rng.uniform(0, 2 * np.pi, 2)
            along = X * np.cos(heading) + Y * np.sin(heading)
            z += share * relief * np.sin(2 * np.pi * along / wavelength + phase)
        beside = self.road_distance(X.ravel(), Y.ravel()).reshape(X.shape) - self.layout.half_width
        bumps = gaussian_filter(rng.normal(size=X.shape), 2.0)
        z += roughness * bumps / bumps.std() * np.clip(beside / 3.0, 0.0, 1.0)
        return np.asarray(z - ditch * np.exp(-(((beside - 1.5) / 0.9) ** 2)))

    def z(self, x: npt.ArrayLike, y: npt.ArrayLike) -> Floats:
        """Height of the ground at (N,) coordinates, metres."""
        scale = (len(self._axis) - 1) / (2 * self.half)
        at = (np.stack(np.broadcast_arrays(np.atleast_1d(x), np.atleast_1d(y))) + self.half) * scale
        return np.asarray(map_coordinates(self._heights, at, order=1, mode="nearest"))

    def height(self, x: float, y: float) -> float:
        """Height of the ground at one place, metres."""
        return float(self.z(x, y)[0])

    def mesh(self) -> Mesh:
        """Mesh of the ground itself."""
        return height_field(self._axis, self._heights)

    def road_distance(self, x: Floats, y: Floats) -> Floats:
        """(N,) metres to the nearest street's centre line."""
        i, j = self._cells(x, y)
        return self._road[i, j].astype(np.float64)

    def claim(self, x: float, y: float, w: float, d: float, yaw: float = 0.0, margin: float = 0.0) -> bool:
        """Take a w x d rectangle if it and ``margin`` metres about it are free of roads and other claims."""
        wide = self._footprint(x, y, w + 2 * margin, d + 2 * margin, yaw)
        if np.abs(wide).max() >= self.half or self._taken[self._cells(*wide.T)].any():
            return False
        self._taken[self._cells(*self._footprint(x, y, w, d, yaw).T)] = True
        return True

    def _footprint(self, x: float, y: float, w: float, d: float, yaw: float) -> Floats:
        u, v = np.arange(-w / 2, w / 2 + _CELL, 0.8 * _CELL), np.arange(-d / 2, d / 2 + _CELL, 0.8 * _CELL)
        U, V = (a.ravel() for a in np.meshgrid(np.minimum(u, w / 2), np.minimum(v, d / 2)))
        c, s = np.cos(yaw), np.sin(yaw)
        return np.column_stack([x + c * U - s * V, y + s * U + c * V])

    def _cells(self, x: Floats, y: Floats) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
        last = len(self._taken) - 1
        i, j = (np.clip(((a + self.half) / _CELL).astype(np.intp), 0, last) for a in (x, y))
        return i, j


def _rasters(layout: Layout, half: float) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.float32]]:
    """Taken cells (the streets, to begin with) and each cell's distance to a street's centre, metres."""
    n = int(2 * half / _CELL) + 1
    centre = np.ones((n, n), dtype=bool)
    for line in (layout.route, *layout.streets):
        i, j = np.clip(((line + half) / _CELL).astype(np.intp), 0, n - 1).T
        centre[i, j] = False
    road = (distance_transform_edt(centre) * _CELL).astype(np.float32)
    return road < layout.half_width, road
