"""``coview-stream replay``: feed a recorded run as a live robot."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from typing import TYPE_CHECKING

from coview_stream.cli.options import KISS_ICP, add_network, add_shared, mount_of

if TYPE_CHECKING:
    from coview_stream.stream.transport.transport import Transport

HELP = "feed a recorded run into zenoh as a live robot"

_NO_ODOMETRY = "none"
_LAST_WAIT = 0.5  # seconds, set by hand: a session learns of subscribers shortly after its first query
_STARTS = 120.0  # seconds for the engines to be ready, as EngineProcess.open_timeout; the first start compiles kernels
_NAMED = 5  # robots named in a message
_MAX_SPACING = 0.4  # seconds, set by hand: 0.1 s of jitter below NodeConfig.odometry_timeout


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments; ranges are checked by ReplayConfig."""
    add_shared(parser, "run_path")
    parser.add_argument("--robot", required=True, metavar="NAME", help="name of the robot")
    add_network(parser)
    add_shared(parser, "--preset")
    parser.add_argument("--rate", type=float, metavar="HZ", help="frames per second (as the run's stamps say)")
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help="times faster than recorded (1)")
    parser.add_argument("--loop", action="store_true", help="start over until interrupted; stamps go on")
    parser.add_argument("--encoding", metavar="NAME", help="xyz, xyzi, foxglove or cdr (the preset's)")
    parser.add_argument("--odometry-encoding", metavar="NAME", help="json or cdr (the preset's)")
    parser.add_argument(
        "--odometry-rate",
        type=float,
        metavar="HZ",
        help="odometry per second, interpolated (one per frame, more if those are rarer than 0.4 s)",
    )
    parser.add_argument(
        "--odometry",
        default="auto",
        metavar="auto|FILE|none",
        help="odometry to send: the run's, a file's, or none, for `serve --odometry kiss-icp` (auto)",
    )
    add_shared(parser, "--mount", "--cloud-delay", "--cloud-topic", "--odometry-topic")
    parser.add_argument(
        "--wait",
        type=float,
        default=10.0,
        metavar="S",
        help="wait for a node (10), then up to 120 s until its engines are ready; 0: for neither",
    )
    add_shared(parser, "--progress")
    parser.epilog = "Exit code 1 if nothing subscribed to the clouds, neither at the beginning nor at the end."


def run(args: argparse.Namespace) -> int:
    """Wait for a node, send the run, print a report; exit code 1 if there never was a subscriber."""
    from tqdm import tqdm

    from coview_stream.cli.process import stop_on_signals
    from coview_stream.errors import ConfigError
    from coview_stream.recordings.lidar_runs import open_bare_run
    from coview_stream.recordings.open_run import open_run
    from coview_stream.stream.client.replay import (
        ReplayConfig,
        await_engines,
        enough_odometry,
        odometry_spacing,
        replay,
    )
    from coview_stream.stream.client.sender import Sender
    from coview_stream.stream.transport.keys import robot_keys
    from coview_stream.stream.transport.zenoh_transport import open_client

    if not args.wait >= 0:
        raise ConfigError(f"--wait {args.wait!r}: give seconds, 0 or more")
    if args.odometry == KISS_ICP:
        raise ConfigError(
            f"--odometry {KISS_ICP}: the node makes it, by `serve --odometry {KISS_ICP}`; send clouds alone, "
            "by `replay --odometry none`"
        )
    bare = args.odometry == _NO_ODOMETRY
    config = ReplayConfig(args.rate, args.speed, args.odometry_rate, clouds_only=bare, loop=args.loop)
    mount = mount_of(args)
    keys = robot_keys(args.preset, args.base, args.robot)
    if bare:
        if args.odometry_topic is not None:
            raise ConfigError("--odometry none and --odometry-topic: give one of them")
        if args.cloud_delay:
            raise ConfigError("--odometry none and --cloud-delay: clouds alone are late after nothing")
        recorded = open_bare_run(args.run_path, args.cloud_topic, mount)
    else:
        recorded = open_run(args.run_path, args.odometry, args.cloud_topic, args.odometry_topic, mount=mount)
        recorded = recorded.with_late_clouds(args.cloud_delay or 0.0)
    for note in recorded.notes:
        print(note, file=sys.stderr)
    transport = open_client(args.connect, args.listen, args.zenoh_config)
    try:
        sender = Sender(transport, keys, args.encoding, args.odometry_encoding)
        if not bare and (spacing := odometry_spacing(recorded, config)) > _MAX_SPACING:
            rate = enough_odometry(recorded, config)
            said = f"one odometry sample in {spacing:.2f} s is too few for a node's defaults"
            if args.odometry_rate is None:
                config = replace(config, odometry_rate=rate)
                print(f"{said}: {rate:g} a second are sent, interpolated", file=sys.stderr)
            else:
                print(f"{said}; use --odometry-rate {rate:g}", file=sys.stderr)
        with stop_on_signals() as stop:
            heard = transport.await_subscriber(sender.cloud_key, args.wait, stop.wait)
            if not heard and not stop.requested:
                others = _served(transport, args.base, args.robot)
                print(f"nothing subscribes to {sender.cloud_key} yet{others}; sending all the same", file=sys.stderr)
            if heard and args.wait > 0 and not await_engines(transport, args.base, args.robot, _STARTS, stop.wait):
                print("the node's engines are not ready yet; sending all the same", file=sys.stderr)
            total = None if args.loop else len(recorded)
            quiet = not (args.progress or sys.stderr.isatty())
            with tqdm(total=total, desc=f"replaying {args.robot}", unit="frame", disable=quiet) as bar:
                report = replay(recorded, sender, config, stop, lambda frames: bar.update(frames - bar.n))
        report.heard = heard or transport.await_subscriber(sender.cloud_key, _LAST_WAIT)
        sender.settle()
    finally:
        transport.close()
    print(report.text())
    return 0 if report.heard else 1


def _served(transport: Transport, base: str, robot: str) -> str:
    """Return a clause on the robots that nodes name by liveliness tokens; empty if there are none."""
    from coview_stream.errors import TransportError, printable

    try:
        names = sorted({token.split("/")[-2] for token in transport.tokens(f"{base}/*/alive")})
    except TransportError:
        names = []
    if robot in names:
        return ": a node names the robot, but by other keys (--preset, --cloud-key), or does not serve it yet"
    return f": nodes serve {printable(', '.join(names[:_NAMED]))}{', ...' * (len(names) > _NAMED)}" * bool(names)
