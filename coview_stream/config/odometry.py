"""Settings of lidar odometry, and the direction of gravity."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from coview_stream.config.checks import all_positive, check_types, require
from coview_stream.errors import ConfigError
from coview_stream.geometry.arrays import Floats

Gravity = Literal["ground", "level"] | tuple[float, float, float]
"""Direction of down: estimated from the ground, along the body's -z, or a vector in the body frame (any length)."""

MAX_TILT = math.radians(60.0)
"""Radians from upright; a body frame has z up (x forward), so a larger lean is a mistake."""


@dataclass(frozen=True)
class LidarOdometryConfig:
    """Lidar odometry; set by hand.

    Attributes:
        gravity: direction of down: of the ``ground``, ``level`` (the body's -z), or a vector in the body frame; an
            accelerometer at rest points up, not down.
        min_range: metres; nearer points are the robot itself, or a cover of the sensor.
        max_range: metres; farther points are left out.
        voxel: edge of the local map's voxels, metres.
        min_points: points between the two ranges; a frame with fewer is not placed.
        max_gap: seconds without a usable frame after which a new local map starts at the last frame's pose, as the
            motion since is unknown.
        max_speed: metres per second; a faster registration is refused, and a new local map starts.
        keep_level: correct drift and registration errors of roll and pitch by the walls and the ground around.
        threads: threads of kiss-icp.
    """

    gravity: Gravity = "ground"
    min_range: float = 1.0
    max_range: float = 100.0
    voxel: float = 1.0
    min_points: int = 100
    max_gap: float = 1.5
    max_speed: float = 50.0
    keep_level: bool = True
    threads: int = 1

    def __post_init__(self) -> None:
        check_types(self)
        all_positive(self, "gravity", "keep_level")
        require(self.max_range > self.min_range, self, "max_range", f"beyond min_range ({self.min_range} m)")
        if self.gravity not in ("ground", "level"):
            down(self.gravity)


def down(gravity: Gravity) -> Floats:
    """Return the unit vector (3,) that points down, in the body frame; not for ``"ground"``.

    ConfigError for no vector, or one that leaves the body lying or upside down.
    """
    vector = np.array((0.0, 0.0, -1.0) if gravity == "level" else gravity, dtype=object)
    try:
        g = vector.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"gravity is {gravity!r}; give ground, level, or three numbers X Y Z") from error
    length = float(np.linalg.norm(g))
    if g.shape != (3,) or not (math.isfinite(length) and length > 0):
        raise ConfigError(f"gravity is {gravity!r}; give ground, level, or three numbers X Y Z, not all zero")
    g /= length
    if -g[2] < math.cos(MAX_TILT):
        raise ConfigError(
            f"gravity {gravity!r} does not point down in the body frame (x forward, z up), where a level sensor has "
            "0 0 -1; an accelerometer at rest shows the opposite: turn the signs"
        )
    return g


def parse_gravity(text: str) -> Gravity:
    """Read the value of an option: ``ground``, ``level`` or ``X,Y,Z``; ConfigError for others."""
    if text in ("ground", "level"):
        return "ground" if text == "ground" else "level"
    try:
        x, y, z = (float(number) for number in text.split(","))
    except ValueError as error:
        raise ConfigError(f"--gravity={text}: give ground, level, or three numbers X,Y,Z") from error
    down((x, y, z))
    return x, y, z
