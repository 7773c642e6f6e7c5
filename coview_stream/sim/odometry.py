"""Odometry as a robot has it: its own origin and heading, gravity aligned, drifting."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.spatial.transform import Rotation

from coview_stream.errors import ConfigError
from coview_stream.geometry import rot_z
from coview_stream.sim.mesh import Floats


@dataclass(frozen=True)
class OdometryConfig:
    """How the odometry errs.

    Attributes:
        yaw_walk: random walk of the heading, radians per square root of a metre driven, one sigma.
        scale_error: constant error of the scale over the run, one sigma.
        position_walk: random walk of the position, metres per square root of a metre, one sigma.
        tilt_noise: error of roll and pitch, radians, one sigma, independent from frame to frame.
        offset: the odometry starts anywhere within +- this, metres (a tenth of it in z).

    Raises:
        ConfigError: a negative value, or one that is no odometry any more.
    """

    yaw_walk: float = float(np.radians(0.15))
    scale_error: float = 0.008
    position_walk: float = 0.004
    tilt_noise: float = float(np.radians(0.05))
    offset: float = 400.0

    def __post_init__(self) -> None:
        for field in fields(self):
            limit = 1e5 if field.name == "offset" else 1.0
            if not 0.0 <= getattr(self, field.name) <= limit:
                raise ConfigError(
                    f"{field.name}: {getattr(self, field.name)!r} is not within 0 and {limit:g}"
                )


def drifting_odometry(T_map_body: Floats, config: OdometryConfig, rng: np.random.Generator) -> Floats:
    """Odometry (N, 4, 4) ``T_odom_body`` of a robot that really drove (N, 4, 4) ``T_map_body``.

    The frame is turned about z only: roll and pitch stay those of gravity.
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
    T_odom_body[:, :3, :3] = turns @ T_map_body[:, :3, :3] @ _small_tilts(tilts)
    T_odom_body[:, :3, 3] = origin + np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])
    return T_odom_body


def _small_tilts(tilts: Floats) -> Floats:
    """(N, 3, 3) rotations by (N, 2) roll and pitch angles that are too small for their order to matter."""
    return np.asarray(Rotation.from_rotvec(np.column_stack([tilts, np.zeros(len(tilts))])).as_matrix())
