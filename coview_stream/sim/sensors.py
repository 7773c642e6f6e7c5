"""Lidars of robots: beam directions, range, noise and lost pulses.

Sensor frame: x forward, y left, z up; a frame is 0.1 s. Figures are set by hand, after the sensors' data sheets.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from coview_stream.geometry.arrays import Bools, Floats, Reals
from coview_stream.geometry.transforms import Points, Pose
from coview_stream.sim.caster import Caster

FRAME_PERIOD = 0.1
"""Seconds from frame to frame."""

RANGE_NOISE = 0.02
"""Metres, one sigma."""

POROSITY = 0.3
"""Probability that a beam passes one surface of foliage, seen from the side."""

_LOST_PULSES = 0.01  # share of pulses without a return, on any surface


@dataclass(frozen=True)
class Sensor:
    """Lidar of a robot.

    Attributes:
        name: as on the command line.
        beams: frame number -> (N, 3) unit directions in the sensor frame.
        min_range: metres; nearer returns are dropped.
        max_range: metres, at perpendicular incidence.
    """

    name: str
    beams: Callable[[int], Floats]
    min_range: float
    max_range: float

    def scan(
        self,
        caster: Caster,
        T_scene_body: Pose,
        frame: int,
        rng: np.random.Generator,
        *,
        porosity: float = POROSITY,
        noise: float = RANGE_NOISE,
    ) -> Points:
        """Return one deskewed frame (N, 3) in the sensor frame, float32 metres; ``noise`` is that of the range."""
        rays = self.beams(frame)
        origins = np.broadcast_to(T_scene_body[:3, 3].astype(np.float32), rays.shape)
        turned = (rays @ T_scene_body[:3, :3].T).astype(np.float32)
        hits = caster.cast(origins, turned, rng, porosity)
        t = hits.distance.astype(np.float64)
        noisy = t + rng.normal(0, noise, len(t))
        seen = self.detects(t, hits.incidence, rng.random(len(t)))
        return (rays[seen] * noisy[seen, None]).astype(np.float32)

    def detects(self, distance: Floats, strength: Reals, luck: Floats) -> Bools:
        """Tell which of (N,) pulses return, from (N,) distances in metres.

        ``strength`` is the cosine of the incidence, less what was lost on the way; ``luck`` is uniform in [0, 1).
        """
        with np.errstate(invalid="ignore"):
            # a Lambertian surface returns cos / r^2; below the threshold a pulse is lost more and more often
            signal = strength * (self.max_range / np.maximum(distance, 0.1)) ** 2
            near = (distance > self.min_range) & (distance < self.max_range)
            return np.asarray(near & (luck < (1 - _LOST_PULSES) * signal / 0.4))


def _spherical(azimuth: Floats, elevation: Floats) -> Floats:
    flat = np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def _spinning(elevations: npt.ArrayLike, offsets: Floats, columns: int) -> Callable[[int], Floats]:
    """Return the beams of all columns, clockwise as seen from above; each leads or lags by its ``offsets``, radians."""
    azimuth = -np.arange(columns)[:, None] * 2 * np.pi / columns + offsets[None]
    elevation = np.broadcast_to(np.asarray(elevations, dtype=np.float64), azimuth.shape)
    rays = _spherical(azimuth.ravel(), elevation.ravel())
    rays.setflags(write=False)
    return lambda frame: rays


def _vlp16() -> Sensor:
    # laser i of the data sheet: even ones below the horizon, odd ones above, 2 degrees apart
    elevation = np.radians([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15])
    firing: Floats = -2 * np.pi * np.arange(16, dtype=np.float64) * 2.304e-6 / FRAME_PERIOD
    return Sensor("vlp16", _spinning(elevation, firing, 1800), 0.5, 100.0)


def _os64(name: str = "os64", columns: int = 512) -> Sensor:
    elevation = np.radians(np.linspace(22.5, -22.5, 64))
    staggered: Floats = np.radians(np.tile([3.16, 1.05, -1.05, -3.16], 16))
    return Sensor(name, _spinning(elevation, staggered, columns), 0.5, 120.0)


def _mid360() -> Sensor:
    """Return a non-repetitive lidar: 200,000 points a second, -7 to 52 degrees, another pattern in each frame."""
    count = 20_000
    low, high = np.radians(-7.0), np.radians(52.0)

    def beams(frame: int) -> Floats:
        t = (frame * count + np.arange(count)) * FRAME_PERIOD / count
        # two frequencies without a common multiple fill the field of view in about a second
        azimuth = 2 * np.pi * 37.3819660 * t
        sweep = (t * 1163.6180340) % 1.0
        triangle = np.abs(2 * sweep - 1)
        return _spherical(azimuth, low + (high - low) * triangle)

    return Sensor("mid360", beams, 0.1, 70.0)


SENSORS: dict[str, Callable[[], Sensor]] = {
    "vlp16": _vlp16,
    "os64": _os64,
    "os64-2048": partial(_os64, "os64-2048", 2048),  # its densest mode, 131,072 beams
    "mid360": _mid360,
}
