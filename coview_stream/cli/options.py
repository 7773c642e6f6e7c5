"""Where ``serve`` keeps what it knows from one start to the next: its two options."""

# FOLDED coview_stream/cli/options.py: """Options of lidar odometry, the same for every command that can make it."""
# FOLDED coview_stream/cli/options.py: """The option that says who names the places to look at, the same for every command that localizes."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coview_stream.config.odometry import LidarOdometryConfig


def add_state(parser: argparse.ArgumentParser) -> None:
    """Declare ``--state`` and ``--no-state``."""
    group = parser.add_argument_group("from one start to the next")
    either = group.add_mutually_exclusive_group()
    either.add_argument(
        "--state",
        metavar="DIR",
        help="keep each robot's last pose here, to be tried first at the next start, and verified like any other "
        "place (the user's state directory, such as ~/.local/state/coview-stream)",
    )
    either.add_argument("--no-state", action="store_true", help="keep nothing, read nothing")


def state_folder(args: argparse.Namespace) -> Path | None:
    """Return where to keep it, None for nowhere; ConfigError for an empty ``--state``."""
    import logging

    from coview_stream.errors import ConfigError
    from coview_stream.stream.node.last_pose import default_folder

    if args.no_state:
        return None
    if args.state is not None:
        if not args.state:
            raise ConfigError("--state '': name a directory, or leave it out, or use --no-state")
        return Path(args.state)
    try:
        return default_folder()
    except ConfigError as error:  # a service without a home has to run all the same
        logging.getLogger("coview_stream.node").warning("%s", error)
        return None


def ready_state(args: argparse.Namespace) -> Path | None:
    """Return what :func:`state_folder` does, tried out, and log it: a robot must not find out where it is first.

    Raises:
        InputError: ``--state`` names what cannot be used. ConfigError: it is empty.
    """
    import logging

    from coview_stream.errors import InputError
    from coview_stream.stream.node.last_pose import try_out

    log = logging.getLogger("coview_stream.node")
    folder = state_folder(args)
    if folder is None:
        return None
    try:
        try_out(folder)
    except OSError as error:
        text = f"{folder}: the last poses cannot be kept here ({error.strerror or error})"
        if args.state is not None:
            raise InputError(
                f"--state {text}; name a directory that can be written, or use --no-state"
            ) from error
        log.warning("%s; use --state DIR or --no-state", text)  # and go on: a disk may come later
    else:
        log.info("the last poses are kept in %s", folder)
    return folder


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
    from coview_stream.config.odometry import LidarOdometryConfig, parse_gravity
    from coview_stream.errors import ConfigError

    if odometry != KISS_ICP:
        if gravity is not None:
            raise ConfigError(f"--gravity goes with --odometry {KISS_ICP}: other odometry is gravity aligned")
        return None
    down = parse_gravity("ground" if gravity is None else gravity)
    return LidarOdometryConfig(gravity=down, max_speed=max_speed)


def add_reloc(parser: argparse._ActionsContainer) -> None:
    """Declare ``--reloc``."""
    parser.add_argument(
        "--reloc",
        choices=("auto", "coview", "learned"),
        default="auto",
        help="who names places to look at: co-view descriptors, learned features, or both on maps that have "
        "features (auto)",
    )
