"""Ground cover: snow and tall grass between the robot's beams and the ground that was surveyed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.geometry.arrays import Bools, Floats
from coview_stream.sim.dirt.ranges import within
from coview_stream.sim.layout import Site

_VERGE = 1.0  # metres beside the carriageway without grass; set by hand
_STEEPEST = 0.05  # cosine of the incidence: flatter rays pass no longer way through the cover; set by hand
_WAVES = ((23.0, 0.6), (9.0, 0.4))  # metres and share: drifts and tussocks; set by hand


@dataclass(frozen=True)
class Snow:
    """Snow on the ground, after the survey; the robot's wheels sink through it.

    Attributes:
        depth: metres, off the roads.
        on_roads: share of the depth that lies on the carriageway.
        drifts: share by which the depth varies.

    Raises:
        ConfigError: a value out of its range.
    """

    depth: float = 0.25
    on_roads: float = 0.5
    drifts: float = 0.1

    def __post_init__(self) -> None:
        within(self, depth=(0.0, 1.0), on_roads=(0.0, 1.0), drifts=(0.0, 1.0))


@dataclass(frozen=True)
class Grass:
    """Tall grass off the roads, after the survey: beams enter it and end somewhere within.

    Attributes:
        height: metres, of the tallest.
        reach: mean way of a beam through it, metres.
        tussocks: share by which the height varies.

    Raises:
        ConfigError: a value out of its range.
    """

    height: float = 0.35
    reach: float = 0.3
    tussocks: float = 0.5

    def __post_init__(self) -> None:
        within(self, height=(0.0, 2.0), reach=(0.01, 10.0), tussocks=(0.0, 1.0))


class Cover:
    """Snow and grass on the ground of a scene; the deeper of them where both are."""

    def __init__(self, site: Site, snow: Snow | None, grass: Grass | None, rng: np.random.Generator) -> None:
        self._site, self._snow, self._grass = site, snow, grass
        self._phases = rng.uniform(0, 2 * np.pi, (2, len(_WAVES), 2))

    def depth(self, x: Floats, y: Floats) -> Floats:
        """Return how deep the cover is at (N,) coordinates, metres."""
        return np.asarray(np.maximum(self._snow_depth(x, y), self._grass_height(x, y)))

    def _snow_depth(self, x: Floats, y: Floats) -> Floats:
        if self._snow is None:
            return np.zeros(len(x))
        road = self._site.road_distance(x, y) < self._site.layout.half_width
        drift = 1.0 + self._snow.drifts * self._wave(x, y, 0)
        return np.asarray(self._snow.depth * np.where(road, self._snow.on_roads, 1.0) * drift)

    def _grass_height(self, x: Floats, y: Floats) -> Floats:
        if self._grass is None:
            return np.zeros(len(x))
        off = self._site.road_distance(x, y) > self._site.layout.half_width + _VERGE
        return np.asarray(self._grass.height * off * (1.0 - self._grass.tussocks * (0.5 + 0.5 * self._wave(x, y, 1))))

    def _wave(self, x: Floats, y: Floats, which: int) -> Floats:
        """Return a smooth value in [-1, 1] at (N,) coordinates."""
        total = np.zeros(len(x))
        for (wavelength, share), (along, across) in zip(_WAVES, self._phases[which], strict=True):
            k = 2 * np.pi / wavelength
            total += share * np.sin(k * x + along) * np.sin(k * y + across)
        return total

    def sink(self, x: Floats, y: Floats, incidence: Floats, rng: np.random.Generator) -> Floats:
        """Return how far (N,) beams go on behind the cover's surface at (N,) coordinates before they end, metres.

        Snow stops a beam at once; through grass it comes ``reach`` metres on average, and to the ground at most.
        ``incidence`` is the cosine of the angle of incidence.
        """
        if self._grass is None:
            return np.zeros(len(x))
        grass = self._grass_height(x, y)
        through = (grass - self._snow_depth(x, y)) / np.maximum(incidence, _STEEPEST)
        ends: Bools = grass > 0.0
        return np.where(ends, np.clip(rng.exponential(self._grass.reach, len(x)), 0.0, np.maximum(through, 0.0)), 0.0)
