"""Scans of a robot with dirt: from the beams that leave to the frame that its odometry straightens."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.geometry.transforms import Points, Pose, Poses
from coview_stream.sim.caster import MeshCaster
from coview_stream.sim.dirt.config import Dirt
from coview_stream.sim.dirt.ground_cover import Cover
from coview_stream.sim.dirt.motion import Track, beam_times
from coview_stream.sim.dirt.recording import Recording
from coview_stream.sim.dirt.streams import Stream
from coview_stream.sim.dirt.surfaces import Echoes, Surfaces
from coview_stream.sim.dirt.traffic import Movers
from coview_stream.sim.scenes import Scene
from coview_stream.sim.sensors import FRAME_PERIOD, RANGE_NOISE, Sensor


class Scanner:
    """Lidar in a dirty world; frames are asked for in order, as each goes on with the random numbers."""

    def __init__(
        self, scene: Scene, sensor: Sensor, dirt: Dirt, height: float, rng: Callable[[Stream], np.random.Generator]
    ) -> None:
        """Take the scene as it is now; ``rng`` gives the random numbers of a purpose, ``height`` is the sensor's.

        Raises:
            DependencyError: Open3D cannot be loaded.
        """
        self._sensor, self._dirt, self._height = sensor, dirt, height
        covered = dirt.snow is not None or dirt.grass is not None
        cover = Cover(scene.site, dirt.snow, dirt.grass, rng(Stream.COVER)) if covered else None
        self._surfaces = Surfaces(scene, cover, dirt.glass, rng(Stream.GLASS))
        self._movers = None if dirt.traffic is None else Movers(scene.site, dirt.traffic, rng(Stream.TRAFFIC))
        self.T_body_sensor = np.eye(4) if dirt.mounting is None else dirt.mounting.draw(rng(Stream.MOUNTING))
        self._rng, self._sky = rng(Stream.BEAMS), rng(Stream.WEATHER)

    def frames(
        self, stamps: Floats, T_scene_body: Poses, T_odom_body: Poses, recording: Recording | None = None
    ) -> Iterator[Points]:
        """Yield frames (N, 3) float32 metres, in what the robot takes for its body frame.

        Args:
            stamps: (N,) seconds.
            T_scene_body: (N, 4, 4) true poses.
            T_odom_body: (N, 4, 4) odometry, by which raw sweeps are deskewed.
            recording: takes the raw sweeps as well, where the robot moves during a sweep.
        """
        motion = self._dirt.motion
        track = None if motion is None else Track(stamps, T_scene_body, T_odom_body)
        for k, T in enumerate(T_scene_body):
            points, times = self.sweep(k, T, track)
            if track is not None and motion is not None:
                if recording is not None:
                    recording.add(points, times, track.segment(k, motion.rate))
                if motion.deskewed:
                    points = track.straightened(k, points, times, motion.rate)
            yield points

    def sweep(self, frame: int, T_scene_body: Pose, track: Track | None) -> tuple[Points, Floats]:
        """Return points (N, 3), sensor frame at their times, and these times (N,), seconds after the frame's stamp.

        Without a track all beams leave at once, at the stamp.
        """
        rays = self._sensor.beams(frame)
        times = beam_times(len(rays))
        if track is None:
            poses, which = T_scene_body[None], np.zeros(len(rays), np.intp)
        else:
            poses, which = track.along(frame, times)
        poses = poses @ self.T_body_sensor
        origins, towards = poses[which, :3, 3].astype(np.float32), poses[which, :3, :3]
        moving = None
        if self._movers is not None:
            moving = MeshCaster([self._movers.around(T_scene_body, frame * FRAME_PERIOD)], {})
        echoes = self._echoes(origins, rays, towards, moving)
        distance = self._weather(echoes, rays)
        noise = np.full(len(rays), RANGE_NOISE)
        if (beams := self._dirt.beams) is not None:
            noise = np.hypot(noise, beams.noise * np.where(np.isfinite(distance), distance, 0.0))
        strength = echoes.strength
        if self._dirt.rain is not None:
            strength = strength * np.exp(-2.0 * self._dirt.rain.extinction * np.where(distance < 1e4, distance, 0.0))
        seen = self._sensor.detects(distance, strength, self._rng.random(len(rays)))
        noisy = distance + noise * self._rng.normal(size=len(rays))
        return (rays[seen] * noisy[seen, None]).astype(np.float32), times[seen]

    def _echoes(self, origins: Floats32, rays: Floats, towards: Floats, moving: MeshCaster | None) -> Echoes:
        """Return what beams of finite width, (N, 3) unit ``rays`` in the sensor frame, come back from."""
        first = self._met(origins, _turned(towards, rays), moving)
        if (beams := self._dirt.beams) is not None:
            second = self._met(origins, _turned(towards, beams.aside(rays, self._rng)), moving)
            distance, share = beams.mixed(first.distance, second.distance, self._rng)
            strength = (1.0 - share) * first.strength + share * second.strength
            first = Echoes(distance, strength, np.where(share < 0.5, first.signs, second.signs))
        if self._dirt.reflectors is not None:
            bloomed = self._dirt.reflectors.halo(rays, first.distance, first.signs, self._rng)
            lit = first.signs | (bloomed < first.distance)
            first = Echoes(bloomed, np.where(lit, 1.0, first.strength), first.signs)
        return first

    def _met(self, origins: Floats32, rays: Floats32, moving: MeshCaster | None) -> Echoes:
        found = self._surfaces.echoes(origins, rays, self._rng)
        if moving is None:
            return found
        met = moving.trace(origins, rays, self._rng, 0.0)
        nearer = met.distance < found.distance
        distance = np.where(nearer, met.distance, found.distance)
        return Echoes(distance, np.where(nearer, met.incidence, found.strength), found.signs & ~nearer)

    def _weather(self, echoes: Echoes, rays: Floats) -> Floats:
        """Return the ranges (N,) of surfaces, drops and dust, whichever is nearer; drops and dust are seen anyway."""
        distance = echoes.distance
        in_air = np.full(len(rays), np.inf)
        if self._dirt.rain is not None:
            in_air = self._dirt.rain.returns(len(rays), self._sky)
        if self._dirt.dust is not None:
            at, axes = self.T_body_sensor[:3, 3], self.T_body_sensor[:3, :3]
            origins = np.broadcast_to(at, rays.shape)
            in_air = np.minimum(in_air, self._dirt.dust.returns(origins, rays @ axes.T, self._height, self._sky))
        before = in_air < distance
        echoes.strength[before] = 1.0
        return np.where(before, in_air, distance)


def _turned(towards: Floats, rays: Floats) -> Floats32:
    return np.asarray(np.einsum("nij,nj->ni", towards, rays), dtype=np.float32)
