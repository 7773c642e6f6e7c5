"""Drives through sites, ray-cast frame by frame as they are asked for, and how a map may be wrong as a whole.

A map that is mirrored, scaled or tilted is not made: the robot's world is, the other way round, in the frame of the
scene that the map is right of. So one map serves all drives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points
from coview_stream.sim.caster import Caster
from coview_stream.sim.odometry import OdometryConfig, drifting_odometry
from coview_stream.sim.odometry import drive as poses_along
from coview_stream.sim.scenes import Scene
from coview_stream.sim.sensors import FRAME_PERIOD, SENSORS

SPEED = 4.0
SPEEDS = {"storey": 1.5}
"""Metres per second, set by hand: a frame every 0.4 m; those of kinds in which nothing goes that fast."""

HEIGHT = 1.5  # metres, of the sensor above the ground
FIRST_STAMP = 1000.0  # seconds
LENGTH = 60.0
"""Metres after which a run ends without a fix."""

_DRIVE, _ODOMETRY, _SENSOR = range(200, 203)  # random streams
_MIRROR_WORLD, _MIRROR_BODY = np.diag([-1.0, 1.0, 1.0]), np.array([1.0, -1.0, 1.0])


class World(NamedTuple):
    """How the robot's world follows from the scene that it is cast in, which the map is of.

    Attributes:
        poses: (N, 4, 4) scene <- body, to poses in the robot's world, where z is up and odometry measures.
        cloud: (K, 3) body frame in the scene, to what the robot sees.
        right: whether the pose in the scene is the right one on the map; else every pose is wrong.
    """

    poses: Callable[[Floats], Floats] = lambda poses: poses
    cloud: Callable[[Points], Points] = lambda points: points
    right: bool = True


AS_MAPPED = World()


def mirrored() -> World:
    """Return the world in which left is right: no pose on the map is right."""

    def poses(scene: Floats) -> Floats:
        out = scene.copy()
        out[:, :3, :3] = _MIRROR_WORLD @ scene[:, :3, :3] * _MIRROR_BODY  # two mirrors: a rotation again
        out[:, :3, 3] = scene[:, :3, 3] @ _MIRROR_WORLD
        return out

    return World(poses, lambda points: (points * _MIRROR_BODY).astype(np.float32), right=False)


def scaled(factor: float) -> World:
    """Return the world of which the map is ``factor`` times too large; right is the pose under the same scaling."""

    def poses(scene: Floats) -> Floats:
        out = scene.copy()
        out[:, :3, 3] /= factor
        return out

    return World(poses, lambda points: points / np.float32(factor))


def tilted(angle: float, heading: float) -> World:
    """Return the world of which the map is tilted by ``angle`` radians about a level axis; right is what fits."""
    axis = np.array([np.cos(heading), np.sin(heading), 0.0])
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    T = np.eye(4)
    T[:3, :3] += np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    return World(lambda scene: T @ scene)


@dataclass(frozen=True)
class Drive:
    """A drive.

    Attributes:
        poses: (N, 4, 4) true poses of the body in the scene that it is cast in.
        odometry: (N, 4, 4) odom <- body.
        truth: (N, 4, 4) map <- body, the only right poses; None where every fix is a false one.
        frame: number of a frame -> its cloud (K, 3), body frame, metres; in ascending order.
    """

    poses: Floats
    odometry: Floats
    truth: Floats | None
    frame: Callable[[int], Points]

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def stamps(self) -> Floats:
        """(N,) seconds."""
        return FIRST_STAMP + FRAME_PERIOD * np.arange(len(self), dtype=np.float64)

    @property
    def driven(self) -> Floats:
        """(N,) metres since the first frame."""
        steps = np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])


def through(
    scene: Scene,
    sensor: str,
    seed: int,
    length: float = LENGTH,
    route: Floats | None = None,
    world: World = AS_MAPPED,
    known: bool = True,
) -> Drive:
    """Drive on a scene's route, or another closed ``route`` (N, 2), from anywhere on it, in either direction.

    Without ``known`` the map is of another place: no pose is right.
    """

    def rng(stream: int) -> np.random.Generator:
        return np.random.default_rng([seed, stream])

    on = scene if route is None else replace(scene, route=route)
    poses = poses_along(on, length, SPEEDS.get(scene.kind, SPEED), HEIGHT, rng(_DRIVE))
    odometry = drifting_odometry(world.poses(poses), OdometryConfig(), rng(_ODOMETRY))
    lidar, noise, casters = SENSORS[sensor](), rng(_SENSOR), list[Caster]()

    def frame(k: int) -> Points:
        if not casters:
            casters.append(Caster(scene.now, threads=1))
        return world.cloud(lidar.scan(casters[0], poses[k], k, noise))

    return Drive(poses, odometry, poses if known and world.right else None, frame)
