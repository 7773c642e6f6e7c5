"""``coview-stream serve``: the node; lidar frames and odometry in, map-frame poses out, over zenoh."""

from __future__ import annotations

import argparse
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from coview_stream.cli.map_argument import add_map, open_map_argument
from coview_stream.cli.options import (
    KISS_ICP,
    ROBOT,
    acceptance_config,
    add_gravity,
    add_initial,
    add_mount,
    add_registration,
    add_reloc,
    add_risk,
    add_state,
    add_verify_key,
    check_codec,
    initial_guesses,
    lidar_config,
    mount_of,
    writable_state_folder,
)
from coview_stream.cli.view import add_view
from coview_stream.config.node import METRICS_ADDRESS
from coview_stream.errors import ConfigError

if TYPE_CHECKING:
    from coview_stream.cli.signals import Stop
    from coview_stream.stream.node.engine_process import EngineChild
    from coview_stream.stream.node.node import Node
    from coview_stream.stream.node.serve import ServeOptions
    from coview_stream.viewers.scene import Sink
    from coview_stream.viewers.session_feed import SessionFeed

HELP = "localize live robots: frames in, poses out at 10 Hz, over zenoh"

_MAX_SHUTDOWN = 1.5  # seconds after a signal: docs/operate.md promises two


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments; values are checked where they are used."""
    add_map(parser, several=True)
    parser.add_argument(
        "--robot", nargs="+", action="extend", required=True, metavar="NAME", help="one or several robots"
    )
    network = parser.add_argument_group("network (with none of these: --listen tcp/127.0.0.1:7447)")
    network.add_argument("--connect", action="append", default=[], metavar="EP", help="tcp/HOST:PORT of a router")
    network.add_argument("--listen", action="append", default=[], metavar="EP", help="wait for peers here")
    network.add_argument("--config", type=Path, metavar="FILE", help="zenoh JSON5: TLS, users, ACL, namespace ...")
    keys = parser.add_argument_group("keys and encodings")
    keys.add_argument("--preset", default="native", help="native, ros2dds, rmw_zenoh or keelson (native)")
    keys.add_argument("--base", default="coview", metavar="KEY", help="first part of our keys (coview)")
    keys.add_argument("--domain", type=int, default=0, help="ROS domain id, for rmw_zenoh (0)")
    keys.add_argument(
        "--humble", action="store_true", help="for rmw_zenoh: name types as ROS 2 Humble does, without a hash"
    )
    keys.add_argument("--cloud-key", metavar="KEY", help="instead of the preset's; {base} and {robot} are filled in")
    keys.add_argument("--odometry-key", metavar="KEY", help="likewise")
    keys.add_argument("--pose-key", metavar="KEY", help="likewise")
    keys.add_argument("--cloud-encoding", metavar="CODEC", help="xyz, xyzi, cdr, foxglove or keelson, for all frames")
    keys.add_argument("--odometry-encoding", metavar="CODEC", help="json, cdr, foxglove or keelson, likewise")
    keys.add_argument("--pose-encoding", metavar="CODEC", help="json, cdr, foxglove or keelson (the preset's)")
    keys.add_argument(
        "--geo", nargs="?", const="json", choices=("json", "cdr", "foxglove"),
        help="publish latitude, longitude and height as well: JSON, NavSatFix or foxglove.LocationFix (json)",
    )  # fmt: skip
    source = parser.add_argument_group("odometry")
    source.add_argument(
        "--odometry",
        choices=(ROBOT, KISS_ICP),
        default=ROBOT,
        help="who makes it: the robot, or this node out of the clouds (robot)",
    )
    add_gravity(source)
    limits = parser.add_argument_group("rates and limits")
    limits.add_argument("--pose-rate", type=float, default=10.0, metavar="HZ", help="(10)")
    limits.add_argument("--odometry-timeout", type=float, default=0.5, metavar="S", help="older: no pose (0.5)")
    limits.add_argument(
        "--max-outage", type=float, default=2.0, metavar="S", help="after longer without: search anew (2)"
    )
    limits.add_argument(
        "--max-speed", type=float, default=50.0, metavar="M/S", help="odometry that is faster has jumped (50)"
    )
    limits.add_argument(
        "--coast", type=float, default=5.0, metavar="S", help="poses go on this long without frames (5)"
    )
    limits.add_argument(
        "--max-payload", type=int, default=16 << 20, metavar="BYTES", help="larger is not looked at (16 MiB)"
    )
    limits.add_argument("--no-deskew", action="store_true", help="ignore per-point times")
    add_mount(limits)
    add_initial(parser, of_robots=True)
    add_registration(parser)
    add_reloc(parser)
    add_risk(parser)
    add_verify_key(parser)
    add_state(parser)
    operation = parser.add_argument_group("operation (docs/operate.md)")
    operation.add_argument(
        "--node",
        metavar="NAME",
        help="the node's own name in its keys (the first robot's; of a fleet the host's and a number)",
    )
    operation.add_argument(
        "--fleet", metavar="NAME", help="share the robots with the other nodes of this fleet, each on one of them"
    )
    operation.add_argument(
        "--metrics",
        nargs="?",
        const=METRICS_ADDRESS,
        type=_host_port,
        metavar="HOST:PORT",
        help=f"answer GET /metrics and /health there (no port is opened; {METRICS_ADDRESS} if none is named)",
    )
    add_view(operation)
    operation.add_argument("--log-json", action="store_true", help="log one JSON object a line")
    operation.add_argument("--quiet", action="store_true", help="log errors only")


def _host_port(text: str) -> str:
    if not text.rpartition(":")[2].isdecimal():  # the map, say, that follows an option without a value
        raise argparse.ArgumentTypeError(f"{text!r} is no HOST:PORT; write --metrics={METRICS_ADDRESS}")
    return text


def run(args: argparse.Namespace) -> int:
    """Run until a signal comes; exit code 0 then."""
    from coview_stream.stream.node.engine_process import start_children

    # first of all: the engines take longest to start, and nothing that they need is known better later
    children = start_children(args.odometry == KISS_ICP)
    try:
        return _run(args, children)
    finally:
        for child in children.values():
            child.close()


def _run(args: argparse.Namespace, children: dict[str, EngineChild]) -> int:
    import logging
    import os
    import socket

    from coview_stream.basemap.signature import read_verify_key
    from coview_stream.cli.logs import start_logging
    from coview_stream.cli.signals import stop_on_signals
    from coview_stream.cli.view import open_sinks
    from coview_stream.config import LocalizerConfig, RegistrationConfig
    from coview_stream.config.node import NodeConfig
    from coview_stream.messages import CLOUD_CODECS, ODOMETRY_CODECS, POSE_CODECS
    from coview_stream.stream.node.serve import CodecOptions, NetworkOptions, ServeOptions
    from coview_stream.stream.transport.keys import check_chunk, node_keys, robot_keys
    from coview_stream.stream.transport.zenoh_transport import DEFAULT_ENDPOINT

    start_logging(logging.ERROR if args.quiet else logging.INFO, args.log_json)
    check_codec("--cloud-encoding", args.cloud_encoding, CLOUD_CODECS)
    check_codec("--odometry-encoding", args.odometry_encoding, ODOMETRY_CODECS)
    check_codec("--pose-encoding", args.pose_encoding, POSE_CODECS)
    verify_key = None if args.verify_key is None else read_verify_key(args.verify_key)
    localizer = LocalizerConfig(
        registration=RegistrationConfig(method=args.registration),
        acceptance=acceptance_config(args.risk),
        reloc=args.reloc,
    )
    lidar = lidar_config(args.odometry, args.gravity, args.max_speed)
    if lidar is not None and (args.odometry_key or args.odometry_encoding):
        raise ConfigError(f"--odometry {KISS_ICP} reads no odometry: leave --odometry-key and -encoding out")
    given = (args.cloud_key, args.odometry_key, args.pose_key, args.domain, args.humble)
    keys = [robot_keys(args.preset, args.base, robot, *given) for robot in args.robot]
    fleet = None if args.fleet is None else f"{args.base}/fleet/{check_chunk(args.fleet, '--fleet')}"
    # nodes of a fleet have the same robots
    default_node = args.robot[0] if fleet is None else f"{socket.gethostname()}-{os.getpid()}"
    if not 0 < args.coast < float("inf"):  # the configuration names the field otherwise
        raise ConfigError(f"--coast is {args.coast}; it must be a positive, finite number of seconds")
    by_default = not (args.connect or args.listen or args.config)
    node = NodeConfig(
        pose_rate=args.pose_rate,
        odometry_timeout=args.odometry_timeout,
        max_gap=max(0.5, args.odometry_timeout),  # a pause that keeps the pose up keeps its frames as well
        max_outage=args.max_outage,
        max_speed=args.max_speed,
        dead_reckoning_timeout=args.coast,
        max_payload=args.max_payload,
        deskew=not args.no_deskew,
        mount=mount_of(args),
    )
    opened = open_map_argument(args)
    options = ServeOptions(
        map_path=opened.path,
        keys=keys,
        network=NetworkOptions(args.connect, [DEFAULT_ENDPOINT] if by_default else args.listen, args.config),
        codecs=CodecOptions(args.cloud_encoding, args.odometry_encoding, args.pose_encoding, args.geo),
        node=node,
        localizer=localizer,
        lidar=lidar,
        state=writable_state_folder(args),
        guesses=initial_guesses(args.initial, args.robot, args.within),
        mirrors=opened.mirrors,
        verify_key=verify_key,
        fleet=fleet,
        node_keys=node_keys(args.base, args.node or default_node),
        metrics=args.metrics,
    )
    sinks = open_sinks(args)
    hangups: list[int] = []
    try:
        with stop_on_signals(lambda: hangups.append(1)) as stop:
            ended = _serve(options, stop, children, hangups, sinks)
    finally:
        for sink in sinks:  # a feed that was never opened has not closed them
            sink.close()
    if not ended:
        _exit_now()
    return 0


def _serve(
    options: ServeOptions,
    stop: Stop,
    children: dict[str, EngineChild] | None = None,
    hangups: Sequence[int] = (),
    sinks: Sequence[Sink] = (),
) -> bool:
    """Open the node and run it until asked to stop; False if a thread hangs. Each hangup reloads the map.

    A thread of its own opens the node: a signal must end a wait for a host that does not answer, too.
    """
    from coview_stream.cli.view import feed_of_node
    from coview_stream.stream.node.engine_process import CancelledError
    from coview_stream.stream.node.serve import open_node
    from coview_stream.stream.node.systemd import Notifier

    notifier = Notifier()
    opened: list[Node] = []
    failed: list[BaseException] = []
    feeds: list[SessionFeed | None] = []

    def work() -> None:
        try:
            opened.append(node := open_node(options, lambda: stop.requested, children, notifier))
            feeds.append(feed_of_node(node, options.keys, options.node.mount, sinks))
        except CancelledError:
            pass
        except BaseException as error:
            failed.append(error)

    opening = threading.Thread(target=work, name="coview-open", daemon=True)
    opening.start()
    while opening.is_alive() and not stop.wait(0.05):
        pass
    answered = 0
    while not failed:
        if len(hangups) > answered:  # before the wait, too: one may have come while the node was opened
            answered = len(hangups)
            for node in opened:
                node.reload()
        if stop.wait(60.0):
            break
    notifier.stopping()
    if failed and not stop.requested:
        raise failed[0]
    end = stop.now() + _MAX_SHUTDOWN
    for feed in filter(None, feeds):
        feed.close()
    opening.join(_MAX_SHUTDOWN)
    return not opening.is_alive() and all(node.close(end - stop.now()) for node in opened)


def _exit_now() -> None:
    """End the process; a regular exit would wait for the thread that is stuck in the network."""
    import logging
    import os
    import sys

    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)
