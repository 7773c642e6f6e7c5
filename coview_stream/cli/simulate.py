"""``coview-stream simulate``: a simulated world on disk."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from coview_stream.cli.options import add_shared, add_world, mount_of
from coview_stream.errors import ConfigError, InputError, counted, require_library

HELP = "simulate a base map and a robot's lidar run through the same place, with the truth"

_UTM = (412_000.0, 5_318_000.0, 240.0)  # metres; an offset typical of UTM coordinates


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments; names and ranges are checked by SimulationConfig."""
    parser.add_argument("out", type=Path, metavar="OUT", help="directory to write; new or empty")
    add_world(parser, 240.0, 80.0)
    parser.add_argument(
        "--drive-seed", type=int, default=0, help="others give other runs through the same world, for `fuse` (0)"
    )
    parser.add_argument("--density", type=float, default=20.0, help="airborne pulses per square metre (20)")
    parser.add_argument("--speed", type=float, default=1.5, help="speed of the robot, metres per second (1.5)")
    parser.add_argument(
        "--changed", type=float, default=0.0, help="share of trees, cars and poles changed since the map (0)"
    )
    parser.add_argument("--drift", type=float, default=1.0, help="factor on the drift of the odometry (1)")
    parser.add_argument(
        "--dirt",
        default="",
        metavar="KINDS",
        help="imperfections, e.g. rain,snow:0.4 (a number says how strong); real is all of motion, traffic, rain, "
        "dust, beams, reflectors, glass, mounting, gravity, odometry, slip, strips, density, seasons, years, grass, "
        "snow; the imperfections, with units, are printed at the end (none)",
    )
    parser.add_argument("--dirt-seed", type=int, default=0, help="seed of the dirt alone (0)")
    parser.add_argument("--utm", action="store_true", help="put the map at UTM-like coordinates")
    parser.add_argument(
        "--origin", type=float, nargs=3, metavar=("X", "Y", "Z"), help="put the map at these coordinates"
    )
    parser.add_argument(
        "--mcap",
        type=Path,
        metavar="F.mcap",
        help="record survey, scans, truth and odometry for Foxglove or rerun as well (extra: foxglove)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace a world simulated there before")
    add_shared(parser, "--mount", "--progress")


def run(args: argparse.Namespace) -> int:
    """Write the world and print its counts."""
    from coview_stream.config.mount import Mount
    from coview_stream.sim import OdometryConfig, SimulationConfig, parse_dirt, simulate

    if args.utm and args.origin:
        raise ConfigError("--utm and --origin: give one of them")
    if not 0.0 <= args.drift <= 20.0:
        raise ConfigError(f"drift: {args.drift!r} is out of range; use 0 to 20")
    if args.mcap is not None:
        require_library("foxglove", "foxglove-sdk>=0.20", "--mcap")
        if args.mcap.exists() or not args.mcap.parent.is_dir():
            raise InputError(f"{args.mcap}: is there already, or its directory is not; name a new file")
    drift = OdometryConfig()
    config = SimulationConfig(
        scene=args.scene,
        sensor=args.sensor,
        seed=args.seed,
        drive_seed=args.drive_seed,
        size=args.size,
        length=args.length,
        density=args.density,
        speed=args.speed,
        changed=args.changed,
        origin=_UTM if args.utm else tuple(args.origin or (0.0, 0.0, 0.0)),
        odometry=OdometryConfig(
            yaw_walk=args.drift * drift.yaw_walk,
            scale_error=args.drift * drift.scale_error,
            position_walk=args.drift * drift.position_walk,
            tilt_noise=args.drift * drift.tilt_noise,
        ),
        dirt=parse_dirt(args.dirt, args.dirt_seed),
        mount=mount_of(args) or Mount(),
    )
    progress = args.progress or sys.stderr.isatty()
    world = simulate(args.out, config, progress=progress, overwrite=args.overwrite)
    facts = f"{world.base_points} map points, {counted(world.frames, 'frame')}, {world.distance:.1f} m driven"
    print(f"{world.directory}: {facts}")
    if args.mount is not None:
        print(f"frames are the sensor's: coview-stream locate ... --mount={args.mount}")
    for line in config.dirt.describe():
        print(f"dirt: {line}")
    if args.mcap is not None:
        from coview_stream.viewers.foxglove_sink import record_world

        print(f"{args.mcap}: {counted(record_world(args.out, args.mcap, config.mount), 'frame')}")
    return 0
