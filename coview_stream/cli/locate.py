"""``coview-stream locate``: localize a recorded run, offline."""

from __future__ import annotations

import argparse
import shlex
import sys
from dataclasses import replace
from pathlib import Path

from coview_stream.cli.map_argument import add_map, open_map_argument
from coview_stream.cli.options import acceptance_config, add_initial, add_shared, initial_guess, lidar_config, mount_of

HELP = "localize a recorded run on a base map, offline"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add_map(parser)
    add_shared(parser, "run_path")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="directory to write")
    parser.add_argument(
        "--odometry",
        default="auto",
        metavar="auto|FILE|kiss-icp",
        help="odometry of the run, of a file, or made of the clouds (auto)",
    )
    add_shared(parser, "--gravity", "--mount", "--cloud-delay", "--cloud-topic", "--odometry-topic")
    parser.add_argument(
        "--export", metavar="A,B", help="also trajectory.csv, .kitti, .geojson or .gpx: csv,kitti,geojson,gpx"
    )
    parser.add_argument(
        "--smooth", action="store_true", help="poses by the whole run, also before the first fix and in interruptions"
    )
    add_initial(parser)
    add_shared(parser, "--reloc", "--risk", "--verify-key")
    parser.add_argument("--no-pictures", action="store_true", help="write no png files")
    add_shared(parser, "--progress")


def run(args: argparse.Namespace) -> int:
    """Localize and write; exit code 1 if no frame was localized, or a fault says that no pose is to be trusted."""
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.clouds.progress import progress_bar
    from coview_stream.config import LocalizerConfig
    from coview_stream.errors import InputError
    from coview_stream.localization.offline import DESCRIPTORS_PNG, FILTERED, TRAJECTORY_PNG, locate, summary, write
    from coview_stream.odometry.lidar_odometry import LidarOdometry
    from coview_stream.recordings.open_run import open_run
    from coview_stream.report.export import chosen_formats, export, reference_for, trajectory_of

    acceptance = acceptance_config(args.risk)
    formats = () if args.export is None else chosen_formats(args.export)
    mount = mount_of(args)
    guess = initial_guess(args.initial, args.within)
    lidar_options = lidar_config(args.odometry, args.gravity, delay=args.cloud_delay)
    config = LocalizerConfig(
        acceptance=acceptance, sensor_leans=lidar_options is None, cloud_delay=args.cloud_delay or 0.0
    )
    lidar = None if lidar_options is None else LidarOdometry(lidar_options)  # now: its library may be missing
    if args.output.exists() and not args.output.is_dir():
        raise InputError(f"{args.output}: is a file; give a directory for the results")
    if args.run_path.is_dir() and args.run_path.resolve() in (here := args.output.resolve(), *here.parents):
        raise InputError(f"{args.output}: lies in the run, which is only read; give another directory for the results")
    draws = not args.no_pictures and _can_draw()
    asked = _doctor_command(args)
    open_map_argument(args)
    base_map = BaseMap.load(args.map, verify_key=args.verify_key)
    geo = reference_for(base_map.crs, formats)  # before anything slow: the map may have none
    missing = base_map.require_features(args.reloc)
    if missing is not None:
        print(f"{args.map}: {missing}", file=sys.stderr)
    shown = args.progress or sys.stderr.isatty()
    with progress_bar("odometry", shown and lidar is not None, "frame") as follow:
        recorded = open_run(args.run_path, args.odometry, args.cloud_topic, args.odometry_topic, lidar, follow, mount)
    for note in recorded.notes:
        print(note, file=sys.stderr)
    config = replace(config, reloc=args.reloc if missing is None else "coview")
    with progress_bar("locating", shown, "frame") as bar:
        located = locate(
            base_map, recorded, config, lambda *at: bar(*at[:2], at[2] and at[2].state.reported), guess, args.smooth
        )
    write(located, base_map, args.output)
    written = ["trajectory.tum", *([FILTERED] if args.smooth else []), "result.json"]
    if formats:
        kinds = None if located.smoothed is None else [pose.kind.value for pose in located.smoothed]
        track = trajectory_of(args.run_path.name, *located.trajectory, geo, kinds)
        written += [path.name for path in export(track, args.output, formats)]
    if draws:
        from coview_stream.report.plots import draw_run

        draw_run(located, base_map, args.output)
        written += [name for name in (TRAJECTORY_PNG, DESCRIPTORS_PNG) if (args.output / name).exists()]
    print(summary(located))
    print(f"{'written':<18} {args.output}: {', '.join(written)}")
    if not located.posed or located.faults:
        print(f"why, and what to do: {asked}")
    return 0 if located.trusted else 1


def _doctor_command(args: argparse.Namespace) -> str:
    """Return the shell command that diagnoses the same data; ``args`` name the map as the user gave it."""
    words = ["coview-stream", "doctor", str(args.map), "--run", str(args.run_path)]
    for name in ("around", "odometry", "mount", "cloud_delay", "cloud_topic", "odometry_topic"):
        value = getattr(args, name)
        words += [] if value in (None, "auto") else [f"--{name.replace('_', '-')}={value}"]  # may begin with a minus
    return shlex.join(words)


def _can_draw() -> bool:
    """Whether pictures can be drawn; if not, print why and go on: poses matter most."""
    from coview_stream.errors import DependencyError, require_library

    try:
        require_library("matplotlib", "matplotlib>=3.8", "no pictures")
    except DependencyError as error:
        print(error, file=sys.stderr)
        return False
    return True
