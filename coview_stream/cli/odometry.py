"""Options of lidar odometry, the same for every command that can make it."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coview_stream.odometry.config import LidarOdometryConfig

KISS_ICP = "kiss-icp"
ROBOT = "robot"


def add_gravity(parser: argparse._ActionsContainer) -> None:
    """Declare ``--gravity``."""
    parser.add_argument(
        "--gravity",
        metavar="ground|level|X,Y,Z",
        help="for kiss-icp: down is where the ground says, or the sensor's -z, or a vector in its frame, as in "
        "--gravity=-0.1,0,-9.8 (ground)",
    )


def lidar_options(odometry: str, gravity: str | None, max_speed: float = 50.0) -> LidarOdometryConfig | None:
    """Return how odometry is to be made; None if ``odometry`` is not kiss-icp. ConfigError for a wrong gravity."""
    from coview_stream.errors import ConfigError
    from coview_stream.odometry.config import LidarOdometryConfig, parse_gravity

    if odometry != KISS_ICP:
        if gravity is not None:
            raise ConfigError(f"--gravity goes with --odometry {KISS_ICP}: other odometry is gravity aligned")
        return None
    down = parse_gravity("ground" if gravity is None else gravity)
    return LidarOdometryConfig(gravity=down, max_speed=max_speed)
