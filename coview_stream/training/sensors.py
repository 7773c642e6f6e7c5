"""Sensors of training drives, and their dirt.

The sensors are the simulator's. The dirt is the part of :mod:`coview_stream.sim.dirt` that matters in a forest: a
leaning sensor, beams of finite width, noise that grows with the range, and tall grass, each up to twice its default
strength. Seasons are the recipe's ``leaf_off``. Dirt has its own random numbers, so a drive without it does not change.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, transform
from coview_stream.sim.dirt.optics import Beams
from coview_stream.sim.dirt.robot import Mounting
from coview_stream.sim.dirt.scene import Grass
from coview_stream.sim.sensors import SENSORS, Caster, Sensor

# beams fired together
_GROUP = {"vlp16": 16, "vlp16-inclined": 16, "os64": 64, "os64-2048": 64, "bpearl": 32, "blk360": 250}


def trained_sensor(name: str, stride: Callable[[int], int] | None = None) -> Sensor:
    """Return a sensor by name; ``stride`` maps its number of beams to n, and only every n-th column is cast."""
    sensor = SENSORS[name]()
    nth = 1 if stride is None else max(1, stride(len(sensor.beams(0))))
    if nth == 1:
        return sensor
    group, beams = _GROUP.get(name, 1), sensor.beams

    def thinned(frame: int) -> Floats:
        rays = beams(frame)
        # different columns in each frame, which together cover all
        return np.asarray(rays[(np.arange(len(rays)) // group + frame) % nth == 0])

    return replace(sensor, beams=thinned)


TRAINED_DIRT = ("mounting", "beams", "grass")
"""Kinds of dirt that training drives can have."""

_STRONGEST = 2.0  # greatest multiple of the simulator's default
_ON_GROUND = 0.15  # metres above the ground below which grass hides points
_STEEPEST = 0.05  # least cosine of the incidence: bounds the path of flat beams through grass


class DriveDirt(NamedTuple):
    """Dirt of one drive; None for kinds that are off."""

    T_body_sensor: Pose  # (4, 4), of a sensor whose points are sent as if in the body frame
    beams: Beams | None  # width and noise of its beams
    grass: Grass | None  # here everywhere, not only off the roads
    rng: np.random.Generator  # random numbers of all dirt

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
        """Return one frame (N, 3) in the robot's assumed body frame, metres; see :meth:`Sensor.scan`."""
        T, rays = T_scene_body @ self.T_body_sensor, lidar.beams(frame)
        distance, strength = self._hits(caster, ground, T, rays, porosity)
        sigma = np.full(len(rays), noise)
        if self.beams is not None:
            aside = self.beams.aside(rays, self.rng)
            second, fainter = self._hits(caster, ground, T, aside, porosity)
            distance, share = self.beams.mixed(distance, second, self.rng)
            strength = (1.0 - share) * strength + share * fainter
            sigma = np.hypot(sigma, self.beams.noise * np.where(np.isfinite(distance), distance, 0.0))
        detected = lidar.detects(distance, strength, self.rng.random(len(rays)))
        noisy = distance + sigma * self.rng.normal(size=len(rays))
        return (rays[detected] * noisy[detected, None]).astype(np.float32)

    def _hits(
        self, caster: Caster, ground: Callable[[Floats, Floats], Floats], T: Pose, rays: Floats, porosity: float
    ) -> tuple[Floats, Floats]:
        """Return ranges (N,) and cosines of the incidence (N,) along ``rays`` (N, 3) in the sensor frame."""
        origins = np.broadcast_to(T[:3, 3].astype(np.float32), rays.shape)
        hits = caster.trace(origins, (rays @ T[:3, :3].T).astype(np.float32), self.rng, porosity)
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
