"""The ground of a forest, and smooth random fields."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from coview_stream.geometry.arrays import Floats
from coview_stream.sim.mesh import Mesh, height_field

Field = Callable[[Floats, Floats], Floats]

_STEP = 1.0  # metres between grid points; set by hand


def waves(rng: np.random.Generator, wavelength: float, count: int = 8) -> Field:
    """Draw a smooth function of x and y (N,) with mean 0, variance 1 and about this wavelength, metres."""
    heading, phase = rng.uniform(0, 2 * np.pi, (2, count))
    number = 2 * np.pi / (wavelength * rng.uniform(0.7, 1.4, count))
    kx, ky = number * np.cos(heading), number * np.sin(heading)

    def field(x: Floats, y: Floats) -> Floats:
        total = np.zeros(np.shape(x))
        for a, b, p in zip(kx, ky, phase, strict=True):
            total += np.cos(a * x + b * y + p)
        return np.asarray(total * np.sqrt(2.0 / count))

    return field


class Terrain:
    """A square of ground, +-``half`` metres about the origin.

    ``slope`` (degrees) is exceeded on 5 % of it, without the roughness; ``roughness`` is in metres.
    """

    def __init__(self, rng: np.random.Generator, half: float, slope: float, roughness: float) -> None:
        self.half = half
        self._axis: Floats = np.linspace(-half, half, 2 * int(half / _STEP) + 1, dtype=np.float64)
        X, Y = np.meshgrid(self._axis, self._axis, indexing="ij")
        heading, share = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.7)
        tilted = share * (X * np.cos(heading) + Y * np.sin(heading))
        z = np.zeros_like(X)
        shortness = rng.uniform(0.7, 1.6)  # exponent by which longer waves are higher
        for wavelength in (220.0, 110.0, 55.0, 27.0):
            z += wavelength**shortness * rng.uniform(0.2, 1.0) * waves(rng, wavelength, 5)(X, Y)
        z = tilted + (1 - share) * z / np.quantile(_slopes(z), 0.95)
        z *= np.tan(np.radians(slope)) / max(float(np.quantile(_slopes(z), 0.95)), 1e-6)
        bumps = gaussian_filter(rng.normal(size=X.shape), rng.uniform(1.0, 3.0))
        self._heights: Floats = z - z.mean() + roughness * bumps / bumps.std()

    def z(self, x: Floats, y: Floats) -> Floats:
        """Return the height of the ground (N,) at (N,) coordinates, metres."""
        scale = (len(self._axis) - 1) / (2 * self.half)
        at = (np.stack([np.asarray(x), np.asarray(y)]) + self.half) * scale
        return np.asarray(map_coordinates(self._heights, at, order=1, mode="nearest"))

    @property
    def span(self) -> tuple[float, float]:
        """Lowest and highest ground, metres."""
        return float(self._heights.min()), float(self._heights.max())

    def mesh(self) -> Mesh:
        """Return a mesh of the ground."""
        return height_field(self._axis, self._heights)


def _slopes(z: Floats) -> Floats:
    dx, dy = np.gradient(z, _STEP)
    return np.asarray(np.hypot(dx, dy))
