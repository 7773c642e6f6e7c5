"""Lidars of robots: beam directions, range, noise and lost pulses.

The sensor frame is x forward, y left, z up. A frame takes 0.1 s, or is the scan of a terrestrial scanner, for which the
robot stops. Numbers are set by hand, after the sensors' data sheets.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from coview_stream.geometry.arrays import Bools, Floats, Floats32, Indices, Reals
from coview_stream.geometry.transforms import Points, Pose
from coview_stream.sim.casting import caster_of
from coview_stream.sim.mesh import Mesh
from coview_stream.sim.scenes import SceneState

BLOCK = 200_000
"""Rays cast at a time, which bounds memory to about 30 MB."""

_THREADS = 2
_MAX_LAYERS = 6  # surfaces of foliage that a ray may pass
_LEAF_DEPTH = 0.12  # metres; mean depth below a crown's hull at which a leaf is hit
_STEP = 2e-3  # metres beyond a leaf at which the ray continues


class Hits(NamedTuple):
    """First hits of (N,) rays."""

    distance: Floats32  # (N,) metres; inf without a hit
    incidence: Floats32  # (N,) absolute cosine of the angle of incidence; 1 on foliage
    mesh: Indices  # (N,) index of the mesh; -1 without a hit
    normal: Floats32  # (N, 3) unit normals of the surfaces, of either sign; zeros without a hit


class MeshCaster:
    """Ray caster for meshes, on ``threads`` cores.

    ``foliage`` maps the index of a mesh to the probability that a ray passes one of its surfaces, None for the
    ``porosity`` of :meth:`trace`; leaves are hit ``leaf_depth`` metres below the surface on average.
    """

    def __init__(
        self,
        meshes: Sequence[Mesh],
        foliage: Mapping[int, float | None],
        threads: int = _THREADS,
        leaf_depth: float = _LEAF_DEPTH,
    ) -> None:
        self._cast, self._leaf_depth = caster_of(meshes, threads), leaf_depth
        self._foliage = dict(foliage)

    def trace(self, origins: Floats32, rays: Floats32, rng: np.random.Generator, porosity: float) -> Hits:
        """Return the first hits of unit rays (N, 3) from origins (N, 3), scene frame, metres."""
        parts = [
            self._trace_block(origins[i : i + BLOCK], rays[i : i + BLOCK], rng, porosity)
            for i in range(0, len(rays), BLOCK)
        ]
        if not parts:
            nothing = np.zeros(0, np.float32)
            return Hits(nothing, nothing, np.zeros(0, np.intp), np.zeros((0, 3), np.float32))
        return Hits(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _trace_block(self, origins: Floats32, rays: Floats32, rng: np.random.Generator, porosity: float) -> Hits:
        count = len(rays)
        distance, incidence = np.full(count, np.inf, np.float32), np.zeros(count, np.float32)
        struck, normals = np.full(count, -1, np.intp), np.zeros((count, 3), np.float32)
        passing = np.full(max(self._foliage, default=-1) + 2, np.nan)  # by mesh; the last place is the sky's
        for index, share in self._foliage.items():
            passing[index] = porosity if share is None else share
        alive: Indices = np.arange(count, dtype=np.intp)
        start = np.zeros(count, np.float32)
        for layer in range(_MAX_LAYERS):
            t, mesh, normal = self._cast(origins[alive] + rays[alive] * start[alive, None], rays[alive])
            through = passing[np.where(mesh < len(passing), mesh, -1)]
            leaf = np.isfinite(through)
            t += start[alive]
            depth = (rng.exponential(self._leaf_depth, len(t)) * leaf).astype(np.float32)
            cosine = np.abs(np.einsum("ij,ij->i", normal, rays[alive]))
            distance[alive], incidence[alive] = t + depth, np.where(leaf, 1.0, cosine)
            struck[alive], normals[alive] = mesh, normal
            if layer + 1 == _MAX_LAYERS:
                break
            passed = leaf & (rng.random(len(t)) < through)
            alive = alive[passed]
            start[alive] = t[passed] + _STEP
            if not len(alive):
                break
        return Hits(distance, incidence, struck, normals)


class Caster(MeshCaster):
    """Ray caster for one state of a scene; its foliage has the ``porosity`` of :meth:`trace`."""

    def __init__(self, scene: SceneState, threads: int = _THREADS, leaf_depth: float = _LEAF_DEPTH) -> None:
        super().__init__((scene.solid, scene.foliage), {1: None}, threads, leaf_depth)


FRAME_PERIOD = 0.1
"""Seconds between frames, except for a robot that stops to scan."""

RANGE_NOISE = 0.02
"""Metres, one sigma."""

POROSITY = 0.3
"""Probability that a beam passes one surface of foliage, seen from the side."""

_LOST_PULSES = 0.01  # share of pulses without a return, on any surface


@dataclass(frozen=True)
class Sensor:
    """Lidar of a robot."""

    name: str  # as on the command line
    beams: Callable[[int], Floats]  # frame number -> (N, 3) unit directions in the sensor frame
    min_range: float  # metres; nearer returns are dropped
    max_range: float  # metres, at perpendicular incidence
    stop: float = 0.0  # metres between the scans of a robot that stops to scan; 0: it scans while driving
    stand: float = 0.0  # seconds of each stop

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
        """Return one deskewed frame (N, 3) in the sensor frame, float32 metres, with range ``noise`` (one sigma).

        ``T_scene_body`` is the pose (4, 4) of the sensor: with a mount, ``T_scene_body @ T_body_sensor``.
        """
        rays = self.beams(frame)
        origins = np.broadcast_to(T_scene_body[:3, 3].astype(np.float32), rays.shape)
        turned = (rays @ T_scene_body[:3, :3].T).astype(np.float32)
        hits = caster.trace(origins, turned, rng, porosity)
        t = hits.distance.astype(np.float64)
        noisy = t + rng.normal(0, noise, len(t))
        detected = self.detects(t, hits.incidence, rng.random(len(t)))
        return (rays[detected] * noisy[detected, None]).astype(np.float32)

    def detects(self, distance: Floats, strength: Reals, luck: Floats) -> Bools:
        """Mask the pulses (N,) that return from distances (N,) in metres.

        ``strength`` is the cosine of the incidence, reduced by losses; ``luck`` is uniform in [0, 1).
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
    """Return the beams of all columns, clockwise seen from above; each leads or lags by its ``offsets``, radians."""
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


INCLINATION = float(np.radians(45.0))
"""Inclination of the axis of the rotating VLP-16, radians."""

TURNS = 0.5
"""Rotations of the whole sensor about the vertical, per second."""


def _inclined() -> Sensor:
    """Return FGLoc6D's inclined VLP-16, which rotates about the vertical; its frames do not rotate with it."""
    upright = _vlp16()
    rays, c, s = upright.beams(0), np.cos(INCLINATION), np.sin(INCLINATION)
    x, y, z = (rays @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]])).T
    within = np.arange(len(rays)) // 16 / 1800

    def beams(frame: int) -> Floats:
        angle = 2 * np.pi * TURNS * FRAME_PERIOD * (frame + within)
        c, s = np.cos(angle), np.sin(angle)
        return np.column_stack([c * x - s * y, s * x + c * y, z])

    return Sensor("vlp16-inclined", beams, upright.min_range, upright.max_range)


def _bpearl() -> Sensor:
    """Return RoboSense's RS-Bpearl, a hemisphere: 32 rings from 2.3 to 89.5 degrees, a column every 0.2 degrees."""
    elevation = np.radians(2.3125 + 2.8125 * np.arange(32))
    return Sensor("bpearl", _spinning(elevation, np.zeros(32), 1800), 0.1, 100.0)


def _blk360() -> Sensor:
    """Return Leica's BLK360 (2017), a terrestrial scanner with 360 x 300 degrees, on a robot that stops every 5 m.

    Its beams, 0.1 degrees apart in its fastest scan, are thinned to 0.6 degrees, which leaves 150,000.
    """
    elevation = np.radians(np.arange(-59.7, 90.0, 0.6))
    return Sensor("blk360", _spinning(elevation, np.zeros(250), 600), 0.6, 60.0, stop=5.0, stand=40.0)


def _os64(name: str = "os64", columns: int = 512) -> Sensor:
    elevation = np.radians(np.linspace(22.5, -22.5, 64))
    staggered: Floats = np.radians(np.tile([3.16, 1.05, -1.05, -3.16], 16))
    return Sensor(name, _spinning(elevation, staggered, columns), 0.5, 120.0)


def _mid360_beams(frame: int) -> Floats:
    """Return a non-repetitive lidar's beams: 200,000 per second, -7 to 52 degrees, a new pattern in each frame."""
    count, low, high = 20_000, np.radians(-7.0), np.radians(52.0)
    t = (frame * count + np.arange(count)) * FRAME_PERIOD / count
    # two frequencies without a common multiple fill the field of view in about a second
    triangle = np.abs(2 * ((t * 1163.6180340) % 1.0) - 1)
    return _spherical(2 * np.pi * 37.3819660 * t, low + (high - low) * triangle)


SENSORS: dict[str, Callable[[], Sensor]] = {
    "vlp16": _vlp16,
    "vlp16-inclined": _inclined,
    "os64": _os64,
    "os64-2048": partial(_os64, "os64-2048", 2048),  # its densest mode, 131,072 beams
    "mid360": partial(Sensor, "mid360", _mid360_beams, 0.1, 70.0),
    "bpearl": _bpearl,
    "blk360": _blk360,
}
