"""Dirt of training drives: a leaning sensor, beams of finite width, noise that grows with the range, tall grass.

The kinds are those of :mod:`coview_stream.sim.dirt` that matter in a forest, each as strong as drawn for a drive, up to
twice its default there. Seasons are the recipe's own ``leaf_off``. All is drawn from random numbers of its own: a drive
without dirt is the same whether others have any.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, transform
from coview_stream.sim.caster import Caster
from coview_stream.sim.dirt.beams import Beams
from coview_stream.sim.dirt.ground_cover import Grass
from coview_stream.sim.dirt.mounting import Mounting
from coview_stream.sim.sensors import Sensor

TRAINED_DIRT = ("mounting", "beams", "grass")
"""Kinds of dirt that training drives can have."""

_STRONGEST = 2.0  # times the default of the simulator; set by hand
_ON_GROUND = 0.15  # metres: what lies no higher above the ground is hidden by grass; set by hand
_STEEPEST = 0.05  # cosine of the incidence: flatter beams pass no longer way through grass; set by hand


class DriveDirt(NamedTuple):
    """Dirt of one drive; None for kinds that are off.

    Attributes:
        T_body_sensor: (4, 4) where the sensor is; its points are taken for the body's.
        beams: width and noise of its beams.
        grass: off the roads, here everywhere.
        rng: random numbers of all of it.
    """

    T_body_sensor: Pose
    beams: Beams | None
    grass: Grass | None
    rng: np.random.Generator

    @classmethod
    def draw(cls, kinds: tuple[str, ...], rng: np.random.Generator) -> DriveDirt:
        """Draw the strengths of some of :data:`TRAINED_DIRT`."""
        mounting, beams, grass = rng.uniform(0.0, _STRONGEST, 3)
        T = replace(Mounting(), lean=mounting * Mounting().lean).draw(rng) if "mounting" in kinds else np.eye(4)
        usual = Beams()
        wide = replace(usual, noise=beams * usual.noise, divergence=beams * usual.divergence)
        tall = replace(Grass(), height=grass * Grass().height)
        return cls(T, wide if "beams" in kinds else None, tall if "grass" in kinds else None, rng)

    def scan(
        self, lidar: Sensor, caster: Caster, ground: Callable[[Floats, Floats], Floats], T_scene_body: Pose,
        frame: int, porosity: float, noise: float,
    ) -> Points:  # fmt: skip
        """Return one frame (N, 3) in what the robot takes for its body frame, metres; see :meth:`Sensor.scan`."""
        T, rays = T_scene_body @ self.T_body_sensor, lidar.beams(frame)
        distance, strength = self._hits(caster, ground, T, rays, porosity)
        sigma = np.full(len(rays), noise)
        if self.beams is not None:
            aside = self.beams.aside(rays, self.rng)
            second, fainter = self._hits(caster, ground, T, aside, porosity)
            distance, share = self.beams.mixed(distance, second, self.rng)
            strength = (1.0 - share) * strength + share * fainter
            sigma = np.hypot(sigma, self.beams.noise * np.where(np.isfinite(distance), distance, 0.0))
        seen = lidar.detects(distance, strength, self.rng.random(len(rays)))
        noisy = distance + sigma * self.rng.normal(size=len(rays))
        return (rays[seen] * noisy[seen, None]).astype(np.float32)

    def _hits(
        self, caster: Caster, ground: Callable[[Floats, Floats], Floats], T: Pose, rays: Floats, porosity: float
    ) -> tuple[Floats, Floats]:
        """Return ranges (N,) and cosines (N,) of the incidence along ``rays`` (N, 3) of the sensor."""
        origins = np.broadcast_to(T[:3, 3].astype(np.float32), rays.shape)
        hits = caster.cast(origins, (rays @ T[:3, :3].T).astype(np.float32), self.rng, porosity)
        distance, strength = hits.distance.astype(np.float64), hits.incidence.astype(np.float64)
        if self.grass is not None and self.grass.height > 0.0:
            met = np.flatnonzero(np.isfinite(distance))
            at = transform(T, rays[met] * distance[met, None])
            low = met[at[:, 2] - ground(at[:, 0], at[:, 1]) < _ON_GROUND]
            height = self.grass.height * (1.0 - self.grass.tussocks * self.rng.random(len(low)))
            through = np.minimum(height / np.maximum(strength[low], _STEEPEST), distance[low])
            way = self.rng.exponential(self.grass.reach, len(low))
            distance[low] -= np.maximum(through - way, 0.0)
        return distance, strength
