"""Motion of a simulated robot: true poses along the route, and odometry that drifts from them.

The robot drives at constant speed and sways on uneven ground. Its odometry has its own origin and heading, and is
aligned to gravity.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.spatial.transform import Rotation

from coview_stream.config.checks import within
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import rot_z
from coview_stream.sim.layout import arc_lengths, directions
from coview_stream.sim.scenes import Scene
from coview_stream.sim.sensors import FRAME_PERIOD

_SWAY = float(np.radians(0.6))  # jitter of roll and pitch, radians, one sigma
_SWAY_MEMORY = 0.8  # share that persists from frame to frame; a body on wheels swings at about 1 Hz
_WANDER = 0.25  # metres around the middle of the lane
_WHEELBASE = 1.0  # metres over which the ground tilts the robot


@dataclass(frozen=True)
class OdometryConfig:
    """Errors of the odometry.

    Raises:
        ConfigError: a negative value, or one too large for odometry.
    """

    # random walk of the heading, radians per square root of a metre driven, one sigma
    yaw_walk: float = float(np.radians(0.15))
    scale_error: float = 0.008  # constant scale error of a run, one sigma
    position_walk: float = 0.004  # random walk of the position, metres per square root of a metre, one sigma
    # error of roll and pitch, radians, one sigma, independent between frames
    tilt_noise: float = float(np.radians(0.05))
    offset: float = 400.0  # the odometry starts within +- this of its origin in x and y, a tenth in z, metres

    def __post_init__(self) -> None:
        within(self, **{field.name: (0.0, 1e5 if field.name == "offset" else 1.0) for field in fields(self)})


def drive(
    scene: Scene, length: float, speed: float, height: float, rng: np.random.Generator, period: float = FRAME_PERIOD
) -> Floats:
    """Return poses ``T_scene_body`` (N, 4, 4), one every ``period`` seconds over ``length`` metres at ``speed``, m/s.

    Start and direction on the route are drawn; a long drive repeats the loop. The body's origin is ``height`` metres
    above the ground, with which the body pitches and rolls.
    """
    route = scene.route if rng.random() < 0.5 else scene.route[::-1]
    arc = arc_lengths(route)
    count = int(length / (speed * period)) + 1
    at = (rng.uniform(0, arc[-1]) + np.arange(count) * speed * period) % arc[-1]
    heading = np.interp(at, arc, np.unwrap(directions(route)))
    sideways = _WANDER * np.sin(2 * np.pi * at / rng.uniform(25, 45) + rng.uniform(0, 2 * np.pi))
    x = np.interp(at, arc, route[:, 0]) - sideways * np.sin(heading)
    y = np.interp(at, arc, route[:, 1]) + sideways * np.cos(heading)
    # roll and pitch from the ground under the wheels, and sway
    cx, cy = np.cos(heading) * _WHEELBASE / 2, np.sin(heading) * _WHEELBASE / 2
    ahead = scene.site.z(x + cx, y + cy) - scene.site.z(x - cx, y - cy)
    left = scene.site.z(x - cy, y + cx) - scene.site.z(x + cy, y - cx)
    fresh = rng.normal(size=(count, 2)) * _SWAY * np.sqrt(1 - _SWAY_MEMORY**2)
    sway = np.zeros((count, 2))
    for k in range(1, count):
        sway[k] = _SWAY_MEMORY * sway[k - 1] + fresh[k]
    tilts = np.arctan2(np.column_stack([left, -ahead]), _WHEELBASE) + sway
    poses = np.tile(np.eye(4), (count, 1, 1))
    angles = np.column_stack([heading, tilts[:, 1], tilts[:, 0]])
    poses[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    poses[:, :3, 3] = np.column_stack([x, y, scene.site.z(x, y) + height])
    return poses


def drifting_odometry(T_map_body: Floats, config: OdometryConfig, rng: np.random.Generator) -> Floats:
    """Return odometry ``T_odom_body`` (N, 4, 4) of a robot with true poses ``T_map_body`` (N, 4, 4).

    The two frames differ by a rotation about z and an offset; both are aligned to gravity.
    """
    count = len(T_map_body)
    steps = np.diff(T_map_body[:, :3, 3], axis=0)
    root = np.sqrt(np.linalg.norm(steps, axis=1))
    start = rng.uniform(-np.pi, np.pi)
    origin = rng.uniform(-1, 1, 3) * config.offset * (1, 1, 0.1)
    scale = 1.0 + np.clip(rng.normal(), -2, 2) * config.scale_error
    yaw = start + np.concatenate([[0.0], np.cumsum(rng.normal(size=count - 1) * root * config.yaw_walk)])
    noise = rng.normal(size=(count - 1, 3)) * root[:, None] * config.position_walk
    tilts = rng.normal(size=(count, 2)) * config.tilt_noise
    turns = np.stack([rot_z(angle) for angle in yaw])
    moved = np.einsum("nij,nj->ni", turns[:-1], steps) * scale + noise
    T_odom_body = np.tile(np.eye(4), (count, 1, 1))
    # so small that the order of roll and pitch does not matter
    tilted = Rotation.from_rotvec(np.column_stack([tilts, np.zeros(count)])).as_matrix()
    T_odom_body[:, :3, :3] = turns @ T_map_body[:, :3, :3] @ tilted
    T_odom_body[:, :3, 3] = origin + np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])
    return T_odom_body
