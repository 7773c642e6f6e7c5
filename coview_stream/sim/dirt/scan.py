"""Robot scans with dirt, from beams to deskewed frames, and the recording of raw sweeps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from enum import IntEnum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from coview_stream.config.mount import Mount
from coview_stream.geometry.arrays import Bools, Floats, Floats32
from coview_stream.geometry.transforms import Points, Pose, Poses, inverse, transform
from coview_stream.messages import ros2
from coview_stream.messages.types import CloudMessage, Encoded, OdometryMessage
from coview_stream.odometry.buffer import Segment
from coview_stream.sim import furniture, vegetation
from coview_stream.sim.dirt.config import Dirt
from coview_stream.sim.dirt.optics import Glass, panes, windows
from coview_stream.sim.dirt.robot import Track, beam_times
from coview_stream.sim.dirt.scene import Cover, Movers, Seasons, drawn_parts
from coview_stream.sim.mesh import join
from coview_stream.sim.scenes import Parts, Scene
from coview_stream.sim.sensors import POROSITY, RANGE_NOISE, MeshCaster, Sensor

CLOUDS, ODOMETRY = "/points", "/odom"
"""Topics of the recording."""

_BAG_VERSION = 9  # of rosbag2's metadata, readable by current ROS


class Recording:
    """Writer of a rosbag2 directory (mcap); a context manager."""

    def __init__(self, path: Path) -> None:
        from rosbags.rosbag2 import StoragePlugin, Writer

        self._writer = Writer(path, version=_BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
        self._topics: dict[str, Any] = {}
        self._newest = -1

    def __enter__(self) -> Recording:
        self._writer.open()
        for topic, kind in ((ODOMETRY, ros2.ODOMETRY), (CLOUDS, ros2.CLOUD)):
            self._topics[topic] = self._writer.add_connection(topic, kind, typestore=ros2.store())
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def add(self, points: Points, times: Floats, segment: Segment) -> None:
        """Add new odometry samples of a segment, then a sweep stamped at the segment's end.

        ``points`` (N, 3) float32 metres are in the sensor frame at their ``times`` (N,), seconds relative to the stamp.
        """
        for stamp, pose in zip(segment.stamps.tolist(), segment.poses, strict=True):
            if stamp > self._newest:
                self._write(ODOMETRY, stamp, ros2.encode_odometry(OdometryMessage(stamp, pose)))
        self._newest = int(segment.stamps[-1])
        self._write(CLOUDS, self._newest, ros2.encode_cloud(CloudMessage(self._newest, points, times)))

    def _write(self, topic: str, stamp: int, message: Encoded) -> None:
        self._writer.write(self._topics[topic], stamp, message.payload)


class Stream(IntEnum):
    """Purposes with their own random numbers."""

    COVER, GLASS, TRAFFIC, MOUNTING, BEAMS, WEATHER, ODOMETRY, SLIP, GRAVITY, STRIPS, DENSITY, YEARS = range(1, 13)


_DIRT = 200  # distinct from the streams of scene, flight and drive


def stream(world_seed: int, seed: int, purpose: Stream) -> np.random.Generator:
    """Return the random numbers of one purpose."""
    return np.random.default_rng([world_seed, _DIRT, seed, int(purpose)])


GROUND, _, GLAZED, SIGN, LEAVES = range(5)
"""Indices of the meshes of :class:`Surfaces`."""

_CONIFER = vegetation.TREE_COLUMNS.index("conifer")


class Echoes(NamedTuple):
    """Echoes of (N,) beams."""

    distance: Floats  # (N,) measured range, metres; inf without a return
    strength: Floats  # (N,) cosine of the incidence, reduced by the loss at glass
    signs: Bools  # (N,) whether a retro-reflecting sign returned it


class Surfaces:
    """Scene for the robot's beams, with ground cover and with windows in some walls."""

    def __init__(self, scene: Scene, cover: Cover | None, glass: Glass | None, rng: np.random.Generator) -> None:
        """Take the present state of the scene; ``rng`` draws the buildings with windows."""
        self._site, self._cover, self._glass = scene.site, cover, glass
        parts = drawn_parts(scene)[1]
        with_windows = rng.random(len(scene.houses)) < (0.0 if glass is None else glass.share)
        glazed = {house for house, drawn in zip(scene.houses, with_windows, strict=True) if drawn}
        below = scene.site.z(parts.trees[:, 0], parts.trees[:, 1])
        street = [furniture.cars(parts.cars, scene.site), furniture.poles(parts.poles, scene.site)]
        walls = [mesh for k, mesh in enumerate(parts.built) if k not in glazed]
        meshes = [
            scene.site.mesh(None if cover is None else cover.depth),
            join([*walls, *parts.fixed, *street, vegetation.trunks(parts.trees, below)]),
            join(mesh for k, mesh in enumerate(parts.built) if k in glazed),
            furniture.sign_plates(parts.poles, scene.site),
            join([*parts.bushes, vegetation.crowns(parts.trees, below)]),
        ]
        self._caster = MeshCaster(meshes, {LEAVES: None})

    def echoes(self, origins: Floats32, rays: Floats32, rng: np.random.Generator) -> Echoes:
        """Return the echoes of unit rays (N, 3) from origins (N, 3), scene frame, metres."""
        hits = self._caster.trace(origins, rays, rng, POROSITY)
        distance, strength = hits.distance.astype(np.float64), hits.incidence.astype(np.float64)
        if self._cover is not None:
            ground = np.flatnonzero(hits.mesh == GROUND)
            at = origins[ground] + rays[ground] * hits.distance[ground, None]
            x, y = at[:, 0].astype(np.float64), at[:, 1].astype(np.float64)
            distance[ground] += self._cover.sink(x, y, strength[ground], rng)
        if self._glass is not None:
            hit = np.flatnonzero(hits.mesh == GLAZED)
            points = origins[hit].astype(np.float64) + distance[hit, None] * rays[hit]
            normal = hits.normal[hit].astype(np.float64)
            is_pane = windows(points, normal, points[:, 2] - self._site.z(points[:, 0], points[:, 1]))
            hit, points, normal = hit[is_pane], points[is_pane], normal[is_pane]
            _, on = panes(self._glass, points, rays[hit].astype(np.float64), normal, rng)
            beyond = self._caster.trace(on.origins, on.rays, rng, POROSITY)
            which = hit[on.which]
            distance[which] += beyond.distance.astype(np.float64)
            strength[which] = self._glass.strength * beyond.incidence
        return Echoes(distance, strength, hits.mesh == SIGN)


def seasonal_caster(parts: Parts, scene: Scene, seasons: Seasons) -> MeshCaster:
    """Return the caster of a winter survey, in which broad-leaved trees and bushes are bare."""
    below = scene.site.z(parts.trees[:, 0], parts.trees[:, 1])
    conifers = parts.trees[:, _CONIFER] > 0.5
    green = vegetation.crowns(parts.trees[conifers], below[conifers])
    twigs = join([*parts.bushes, vegetation.crowns(parts.trees[~conifers], below[~conifers])])
    solid = parts.state(scene.site).solid
    return MeshCaster((solid, green, twigs), {1: None, 2: seasons.bare})


class Scanner:
    """Lidar in a dirty world; read frames in order, as they share random numbers."""

    def __init__(
        self,
        scene: Scene,
        sensor: Sensor,
        dirt: Dirt,
        height: float,
        rng: Callable[[Stream], np.random.Generator],
        mount: Mount = Mount(),  # noqa: B008 - immutable
    ) -> None:
        """Take the present scene; ``rng`` gives a purpose's random numbers, ``height`` is the body's above ground."""
        self._sensor, self._dirt, self._height, self._mount = sensor, dirt, height, mount
        covered = dirt.snow is not None or dirt.grass is not None
        cover = Cover(scene.site, dirt.snow, dirt.grass, rng(Stream.COVER)) if covered else None
        self._surfaces = Surfaces(scene, cover, dirt.glass, rng(Stream.GLASS))
        self._movers = None if dirt.traffic is None else Movers(scene.site, dirt.traffic, rng(Stream.TRAFFIC))
        leant = np.eye(4) if dirt.mounting is None else dirt.mounting.draw(rng(Stream.MOUNTING))
        self.T_body_sensor = leant @ mount.T_body_sensor
        self._rng, self._sky = rng(Stream.BEAMS), rng(Stream.WEATHER)

    def frames(
        self, stamps: Floats, T_scene_body: Poses, T_odom_body: Poses, recording: Recording | None = None
    ) -> Iterator[Points]:
        """Yield frames (N, 3) float32 metres, in the sensor frame, at stamps (N,), seconds.

        The odometry (N, 4, 4) deskews raw sweeps; ``recording`` also gets them if the dirt includes motion.
        """
        motion = None if self._sensor.stop else self._dirt.motion
        track = None if motion is None else Track(stamps, T_scene_body, T_odom_body)
        for k, T in enumerate(T_scene_body):
            points, times = self.sweep(k, T, track, float(stamps[k] - stamps[0]))
            if track is not None and motion is not None:
                if recording is not None:
                    recording.add(points, times, track.segment(k, motion.rate))
                if motion.deskewed:
                    straight = track.straightened(k, self._mount.to_body(points), times, motion.rate)
                    points = transform(inverse(self._mount.T_body_sensor), straight)
            yield points

    def sweep(self, frame: int, T_scene_body: Pose, track: Track | None, seconds: float) -> tuple[Points, Floats]:
        """Return points (N, 3) in the sensor frame at their times, and the times (N,), seconds relative to the stamp.

        The stamp is ``seconds`` after the first stamp. Without a track all beams are fired at the stamp.
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
            moving = MeshCaster([self._movers.around(T_scene_body, seconds)], {})
        echoes = self._echoes(origins, rays, towards, moving)
        distance = self._weather(echoes, rays)
        noise = np.full(len(rays), RANGE_NOISE)
        if (beams := self._dirt.beams) is not None:
            noise = np.hypot(noise, beams.noise * np.where(np.isfinite(distance), distance, 0.0))
        strength = echoes.strength
        if self._dirt.rain is not None:
            strength = strength * np.exp(-2.0 * self._dirt.rain.extinction * np.where(distance < 1e4, distance, 0.0))
        detected = self._sensor.detects(distance, strength, self._rng.random(len(rays)))
        noisy = distance + noise * self._rng.normal(size=len(rays))
        return (rays[detected] * noisy[detected, None]).astype(np.float32), times[detected]

    def _echoes(self, origins: Floats32, rays: Floats, towards: Floats, moving: MeshCaster | None) -> Echoes:
        """Return the echoes of beams of finite width along unit ``rays`` (N, 3) in the sensor frame."""
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
        surfaces = self._surfaces.echoes(origins, rays, self._rng)
        if moving is None:
            return surfaces
        met = moving.trace(origins, rays, self._rng, 0.0)
        nearer = met.distance < surfaces.distance
        distance = np.where(nearer, met.distance, surfaces.distance)
        return Echoes(distance, np.where(nearer, met.incidence, surfaces.strength), surfaces.signs & ~nearer)

    def _weather(self, echoes: Echoes, rays: Floats) -> Floats:
        """Return the range (N,) of the nearest surface, drop or dust; drops and dust get full strength."""
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
