"""``coview-stream replay``: feed a recorded run as a live robot."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from coview_stream.cli.options import KISS_ICP

HELP = "feed a recorded run into zenoh as a live robot"

_NONE = "none"
_LOOK = 0.5  # seconds; a session learns of subscribers a moment after it first asks
_SPARSE = 0.4  # seconds; the node takes odometry older than 0.5 s for lost, and some jitter has to fit in


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments; ranges are checked by ReplayConfig."""
    parser.add_argument(
        "run_path", type=Path, metavar="RUN", help="run directory, cloud file, or rosbag2, mcap, bag"
    )
    parser.add_argument("--robot", required=True, metavar="NAME", help="whose frames these are")
    parser.add_argument(
        "--connect", action="append", metavar="EP", help="endpoint to connect to (tcp/127.0.0.1:7447)"
    )
    parser.add_argument("--listen", action="append", metavar="EP", help="endpoint to be connected to on")
    parser.add_argument("--config", type=Path, metavar="FILE", help="zenoh configuration, JSON5")
    parser.add_argument("--base", default="coview", help="first part of the keys (coview)")
    parser.add_argument("--preset", default="native", help="native, ros2dds, rmw_zenoh or keelson (native)")
    parser.add_argument(
        "--rate", type=float, metavar="HZ", help="frames per second (as the run's stamps say)"
    )
    parser.add_argument(
        "--speed", type=float, default=1.0, metavar="X", help="times faster than recorded (1)"
    )
    parser.add_argument("--loop", action="store_true", help="start over until interrupted; stamps go on")
    parser.add_argument("--encoding", metavar="NAME", help="xyz, xyzi, foxglove or cdr (the preset's)")
    parser.add_argument("--odometry-encoding", metavar="NAME", help="json or cdr (the preset's)")
    parser.add_argument(
        "--odometry-rate", type=float, metavar="HZ", help="odometry per second, interpolated (one per frame)"
    )
    parser.add_argument(
        "--odometry",
        default="auto",
        metavar="auto|FILE|none",
        help="odometry to send: the run's, a file's, or none, for `serve --odometry kiss-icp` (auto)",
    )
    parser.add_argument(
        "--cloud-topic", metavar="TOPIC", help="clouds of a recording with several such topics"
    )
    parser.add_argument("--odometry-topic", metavar="TOPIC", help="its odometry, likewise")
    parser.add_argument(
        "--wait", type=float, default=10.0, metavar="SECONDS", help="for a node to subscribe (10)"
    )
    parser.add_argument("--progress", action="store_true", help="draw a progress bar even without a terminal")
    parser.epilog = "Exit code 1 if nobody subscribed to the clouds, neither at the beginning nor at the end."


def run(args: argparse.Namespace) -> int:
    """Wait for a subscriber, send the run, print what was done; exit code 1 if nobody ever listened."""
    from tqdm import tqdm

    from coview_stream.cli.signals import stop_on_signals
    from coview_stream.errors import ConfigError
    from coview_stream.recordings.lidar_runs import open_bare_run
    from coview_stream.recordings.open_run import open_run
    from coview_stream.stream.client.replay import replay
    from coview_stream.stream.client.replay_schedule import ReplayConfig, odometry_spacing
    from coview_stream.stream.client.sender import Sender
    from coview_stream.stream.transport.keys import robot_keys
    from coview_stream.stream.transport.rpc import open_client

    if not args.wait >= 0:
        raise ConfigError(f"--wait {args.wait!r}: give seconds, 0 or more")
    if args.odometry == KISS_ICP:
        raise ConfigError(
            f"--odometry {KISS_ICP}: the node makes it, by `serve --odometry {KISS_ICP}`; send clouds alone, "
            "by `replay --odometry none`"
        )
    bare = args.odometry == _NONE
    config = ReplayConfig(args.rate, args.speed, args.odometry_rate, clouds_only=bare, loop=args.loop)
    keys = robot_keys(args.preset, args.base, args.robot)
    if bare:
        if args.odometry_topic is not None:
            raise ConfigError("--odometry none and --odometry-topic: give one of them")
        recorded = open_bare_run(args.run_path, args.cloud_topic)
    else:
        recorded = open_run(args.run_path, args.odometry, args.cloud_topic, args.odometry_topic)
    for note in recorded.notes:
        print(note, file=sys.stderr)
    transport = open_client(args.connect, args.listen, args.config)
    try:
        sender = Sender(transport, keys, args.encoding, args.odometry_encoding)
        if not bare and (spacing := odometry_spacing(recorded, config)) > _SPARSE:
            print(
                f"one odometry sample in {spacing:.2f} s is too few for a node's defaults; see --odometry-rate",
                file=sys.stderr,
            )
        with stop_on_signals() as stop:
            heard = transport.await_subscriber(sender.cloud_key, args.wait, stop.wait)
            if not heard and not stop.requested:
                print(f"nobody subscribes to {sender.cloud_key} yet; sending all the same", file=sys.stderr)
            total = None if args.loop else len(recorded)
            quiet = not (args.progress or sys.stderr.isatty())
            with tqdm(total=total, desc=f"replaying {args.robot}", unit="frame", disable=quiet) as bar:
                report = replay(recorded, sender, config, stop, lambda frames: bar.update(frames - bar.n))
        report.heard = heard or transport.await_subscriber(sender.cloud_key, _LOOK)
        sender.settle()
    finally:
        transport.close()
    print(report.text())
    return 0 if report.heard else 1
