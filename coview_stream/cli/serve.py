"""``coview-stream serve``: the node; takes lidar frames and odometry, publishes poses in the map frame, over zenoh."""

from __future__ import annotations

import argparse
import contextlib
import functools
import logging
import os
import socket
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coview_stream.cli.map_argument import add_map, open_map_argument
from coview_stream.cli.options import (
    KISS_ICP,
    ROBOT,
    acceptance_config,
    add_fields,
    add_initial,
    add_network,
    add_shared,
    add_state,
    blaming_file,
    check_codec,
    fill_from_settings,
    hide_rare,
    host_port,
    initial_guesses,
    lidar_config,
    mount_of,
    state_folder,
)
from coview_stream.cli.view import add_view
from coview_stream.config.node import METRICS_ADDRESS, NodeConfig
from coview_stream.errors import ConfigError, require_installed

if TYPE_CHECKING:
    from coview_stream.cli.process import Stop
    from coview_stream.stream.node.engine_process import EngineChild
    from coview_stream.stream.node.node import Node
    from coview_stream.stream.node.serve import ServeOptions
    from coview_stream.viewers.scene import Sink
    from coview_stream.viewers.session_feed import SessionFeed

HELP = "localize live robots: frames in, poses out at 10 Hz, over zenoh"

_LIMITS = {
    "pose_rate": "HZ",
    "odometry_timeout": "S",
    "max_outage": "S",
    "max_speed": "M/S",
    "dead_reckoning_timeout": "S",
    "max_payload": "BYTES",
}
"""Fields of NodeConfig that are options, with their units."""

TABLES = ("node", "localizer", "lidar_odometry")
"""Tables of ``--config``: fields of NodeConfig, LocalizerConfig and LidarOdometryConfig; other keys are options."""

NOT_IN_TABLES = {"sensor_leans": ("localizer", "odometry decides it"), "mount": ("node", "set it above")}
"""Fields that a table may not set, with the reason."""

_DEFAULTS = {"preset": "native", "base": "coview", "domain": 0, "odometry": ROBOT, "reloc": None, "risk": None}
"""Options whose defaults --config may replace; None: the configuration's."""

_TWICE = {
    "risk": ("localizer", "acceptance", "risk"),
    "reloc": ("localizer", "reloc"),
    "cloud_delay": ("localizer", "cloud_delay"),
    "gravity": ("lidar_odometry", "gravity"),
    **{name: ("node", name) for name in _LIMITS},
}
"""Options that are also fields of a table: a file sets one of the two."""

_RARE = (
    *("ros_args", "domain", "humble", "cloud_key", "odometry_key", "pose_key", "cloud_encoding", "odometry_encoding"),
    *("pose_encoding", "geo", "gravity", "no_deskew", "reloc", "log_json", "around", "foxglove"),
    *("cloud_delay", "within", "record", "rerun", *_LIMITS),
)
"""Options shown only by --help-all."""

_PARAMETERS = "ROS parameters"

_TOPICS = ("points", "odom", "pose")
"""ROS 2 topics of a robot's clouds, odometry and poses, in its namespace."""

_OF_ZENOH = ("preset", "connect", "listen", "zenoh_config", "fleet", "domain", "humble", "pose_encoding", "geo")
"""Options without meaning for a ROS 2 node."""

_MAX_SHUTDOWN = 1.5  # seconds after a signal: docs/operate.md promises two


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments; values are checked where they are used."""
    add_map(parser, several=True)
    parser.add_argument("--robot", nargs="+", action="extend", metavar="NAME", help="one or several robots")
    parser.add_argument("--config", type=Path, metavar="node.toml", help="settings; options given here replace them")
    add_network(parser, "--listen tcp/127.0.0.1:7447")
    parser.add_argument("--ros2", action="store_true", help="topics of ROS 2 in place of zenoh's keys (extra ros2)")
    parser.add_argument(
        "--ros-args", nargs=argparse.REMAINDER, metavar="...",
        help="the rest is for ROS: remappings, parameters, which are options by their names (--params-file F.yaml)",
    )  # fmt: skip
    keys = parser.add_argument_group("keys and encodings")
    add_shared(parser, "--preset")
    keys.add_argument("--domain", type=int, default=0, help="ROS domain id, for rmw_zenoh (0)")
    keys.add_argument(
        "--humble", action="store_true", help="for rmw_zenoh: name types as ROS 2 Humble does, without a hash"
    )
    keys.add_argument(
        "--cloud-key", "--cloud-topic", metavar="KEY",
        help="key or topic of clouds, {base} and {robot} filled in (the preset's; {robot}/points)",
    )  # fmt: skip
    keys.add_argument(
        "--odometry-key", "--odometry-topic", metavar="KEY",
        help="key or topic of odometry, written as --cloud-key (the preset's; {robot}/odom)",
    )  # fmt: skip
    keys.add_argument("--pose-key", metavar="KEY", help="key of poses, written as --cloud-key (the preset's)")
    keys.add_argument("--cloud-encoding", metavar="CODEC", help="of all clouds: xyz, xyzi, cdr, foxglove or keelson")
    keys.add_argument("--odometry-encoding", metavar="CODEC", help="of all odometry: json, cdr, foxglove or keelson")
    keys.add_argument("--pose-encoding", metavar="CODEC", help="of poses: json, cdr, foxglove, keelson (the preset's)")
    keys.add_argument(
        "--geo", nargs="?", const="json", choices=("json", "cdr", "foxglove"),
        help="publish latitude, longitude and height as well: JSON, NavSatFix or foxglove.LocationFix (json)",
    )  # fmt: skip
    parser.add_argument("--odometry", choices=(ROBOT, KISS_ICP), help="made by the robot, or of its clouds (robot)")
    add_shared(parser, "--gravity")
    limits = parser.add_argument_group("rates and limits")
    add_fields(limits, NodeConfig, _LIMITS)
    limits.add_argument("--no-deskew", action="store_true", help="ignore per-point times")
    add_shared(parser, "--mount", "--cloud-delay")
    add_initial(parser, of_robots=True)
    add_shared(parser, "--reloc", "--risk", "--verify-key")
    add_state(parser)
    operation = parser.add_argument_group("operation (coview-stream help operate)")
    operation.add_argument("--node", dest="node_name", metavar="NAME", help="node's name in keys (the first robot's)")
    operation.add_argument("--fleet", metavar="NAME", help="share the robots with the other nodes of this fleet")
    operation.add_argument(
        "--metrics", nargs="?", const=METRICS_ADDRESS, type=host_port("--metrics", METRICS_ADDRESS),
        metavar="HOST:PORT", help=f"serve GET /metrics and /health ({METRICS_ADDRESS} if no address is named)",
    )  # fmt: skip
    add_view(operation)
    operation.add_argument("--log-json", action="store_true", help="log one JSON object a line")
    add_shared(operation, "--quiet")
    parser.formatter_class = functools.partial(argparse.HelpFormatter, max_help_position=20)
    parser.usage = "%(prog)s SITE --robot NAME [options]"
    parser.set_defaults(**dict.fromkeys(_DEFAULTS))  # None: not given, --config decides
    hide_rare(parser, *_RARE)


def run(args: argparse.Namespace) -> int:
    """Run until a signal comes; then exit code 0."""
    from coview_stream.cli.process import start_logging, stop_on_signals
    from coview_stream.cli.view import open_sinks
    from coview_stream.stream.node.engine_process import start_children
    from coview_stream.stream.node.heap import bound_heaps

    tables = settings(args)
    require_installed("scipy", "coview-stream serve")  # before the messages' libraries, which are only part of [node]
    bound_heaps(2, map_large=True)
    # first: the engines take longest to start, and need nothing that is known later
    children = start_children(args.odometry == KISS_ICP)
    with contextlib.ExitStack() as closing, blaming_file(args):
        for child in children.values():
            closing.callback(child.close)
        start_logging(logging.ERROR if args.quiet else logging.INFO, args.log_json)
        options = serve_options(args, tables)
        hangups: list[int] = []
        with contextlib.ExitStack() as views:
            sinks = open_sinks(args, views)
            with stop_on_signals(lambda: hangups.append(1)) as stop:
                ended = _serve(options, stop, children, hangups, sinks)
        if not ended:  # a regular exit would wait for the thread that hangs in the network
            for child in children.values():
                child.process.kill()  # a compiling child would notice only later
            logging.shutdown()
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(0)
    return 0


def settings(args: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Complete arguments by ``--config`` and defaults; return its tables. ConfigError: a mistake, no map or robot."""
    tables: dict[str, dict[str, Any]] = {name: {} for name in TABLES}
    args.from_file, args.ros_node = set(), None
    declared = argparse.ArgumentParser()
    if args.config is not None or args.ros2:
        add_arguments(declared)
    parameters: dict[str, dict[str, Any]] = _ros_parameters(args, declared) if args.ros2 else {}
    in_file: set[str] = args.in_file if args.ros2 else set()
    if args.config is not None:
        from coview_stream.config.settings_file import read_settings

        tables |= fill_from_settings(args, read_settings(args.config), args.config, declared, TABLES)
        in_file |= args.in_file
    if args.ros2 and args.ros_node is None:  # the file requests it
        parameters = _ros_parameters(args, declared)
        in_file |= args.in_file
    _merge(tables, parameters)
    source = " and ".join(str(name) for name in (args.config, args.ros2 and _PARAMETERS) if name)
    for option, (table, *path) in _TWICE.items():
        field: Any = tables[table]
        for name in path:
            field = field.get(name) if isinstance(field, dict) else None
        if option in in_file and field is not None:
            raise ConfigError(f"{source}: {option} and [{'.'.join([table, *path[:-1]])}] {path[-1]}: set one of them")
    if args.ros_args is not None and not args.ros2:
        raise ConfigError("--ros-args goes with --ros2")
    if args.ros2 and (other := [f"--{name.replace('_', '-')}" for name in _OF_ZENOH if getattr(args, name)]):
        raise ConfigError(f"{other[0]} is for zenoh: leave it out with --ros2")
    for name, value in _DEFAULTS.items():
        if getattr(args, name) is None:
            setattr(args, name, value)
    for name, key, value in (("SITE", "site", args.map), ("--robot", "robot", args.robot)):
        if not value:
            raise ConfigError(f"{name} is missing: give it here, or as {key} = ... in the file of --config")
    return tables


def _merge(into: dict[str, Any], tables: Mapping[str, Any]) -> None:
    """Set the fields of nested tables in other tables."""
    for name, value in tables.items():
        if isinstance(value, Mapping) and isinstance(into.get(name), dict):
            _merge(into[name], value)
        else:
            into[name] = value


def _ros_parameters(args: argparse.Namespace, declared: argparse.ArgumentParser) -> dict[str, dict[str, Any]]:
    """Start the requested ROS 2 node, set options from its parameters, and return its tables."""
    from coview_stream.stream.transport.ros2_node import settings_of, start_node

    from_file = args.from_file
    args.ros_node = start_node(args.ros_args or ())
    tables = fill_from_settings(args, settings_of(args.ros_node), _PARAMETERS, declared, TABLES)
    args.from_file = from_file  # options from ``--config``, which errors name
    return tables


def serve_options(args: argparse.Namespace, tables: dict[str, dict[str, Any]]) -> ServeOptions:
    """Return the node's options from complete arguments and the tables of ``--config``, see :func:`settings`."""
    from coview_stream.basemap.file_format import load
    from coview_stream.basemap.joined import JOINED_SUFFIX
    from coview_stream.basemap.signature import read_verify_key
    from coview_stream.basemap.site.site_grid import PART_SUFFIX
    from coview_stream.config import LocalizerConfig
    from coview_stream.config.odometry import LidarOdometryConfig
    from coview_stream.config.settings_file import with_table
    from coview_stream.messages import CLOUD_CODECS, ODOMETRY_CODECS, POSE_CODECS
    from coview_stream.stream.node.serve import CodecOptions, NetworkOptions, ServeOptions
    from coview_stream.stream.transport.keys import check_chunk, node_keys, robot_keys
    from coview_stream.stream.transport.zenoh_config import compose
    from coview_stream.stream.transport.zenoh_transport import DEFAULT_ENDPOINT

    check_codec("--cloud-encoding", args.cloud_encoding, CLOUD_CODECS)
    check_codec("--odometry-encoding", args.odometry_encoding, ODOMETRY_CODECS)
    check_codec("--pose-encoding", args.pose_encoding, POSE_CODECS)
    verify_key = None if args.verify_key is None else read_verify_key(args.verify_key)
    source = args.config or _PARAMETERS
    for key, (name, remedy) in NOT_IN_TABLES.items():
        if key in tables[name]:
            raise ConfigError(f"{source}: [{name}]: {key} cannot be set here: {remedy}")
    localizer = with_table(LocalizerConfig(), tables["localizer"], f"{source}: [localizer]")
    delay = localizer.cloud_delay if args.cloud_delay is None else args.cloud_delay
    localizer = replace(localizer, reloc=args.reloc or localizer.reloc, cloud_delay=delay)
    if args.risk is not None:
        localizer = replace(localizer, acceptance=replace(localizer.acceptance, risk=acceptance_config(args.risk).risk))
    node = with_table(NodeConfig(), tables["node"], f"{source}: [node]")
    node = replace(
        node,
        **{name: value for name in _LIMITS if (value := getattr(args, name)) is not None},
        deskew=node.deskew and not args.no_deskew,
        mount=mount_of(args) or node.mount,
    )
    localizer = replace(localizer, mount_drawn=localizer.mount_drawn and node.mount.drawn)
    if "max_gap" not in tables["node"]:  # a pause of odometry too short to lose the pose must not lose frames
        node = replace(node, max_gap=max(node.max_gap, node.odometry_timeout))
    table = {"max_speed": node.max_speed} | tables["lidar_odometry"]
    odometry = with_table(LidarOdometryConfig(), table, f"{source}: [lidar_odometry]")
    lidar = lidar_config(args.odometry, args.gravity, node.max_speed, args.cloud_delay)
    if lidar is not None:
        gravity = odometry.gravity if args.gravity is None else lidar.gravity
        lidar = replace(odometry, gravity=gravity, max_speed=args.max_speed or odometry.max_speed)
    if lidar is not None and (args.odometry_key or args.odometry_encoding):
        raise ConfigError(f"--odometry {KISS_ICP} reads no odometry: leave --odometry-key and -encoding out")
    topics = [args.cloud_key, args.odometry_key, args.pose_key]
    if args.ros2:
        topics = [(topic or "{robot}/" + name).lstrip("/") for topic, name in zip(topics, _TOPICS, strict=True)]
    given: tuple[Any, ...] = (*topics, args.domain, args.humble)
    keys = [robot_keys(args.preset, args.base, robot, *given) for robot in args.robot]
    fleet = None if args.fleet is None else f"{args.base}/fleet/{check_chunk(args.fleet, '--fleet')}"
    # nodes of a fleet have the same robots, so a robot cannot name them
    default_node = args.robot[0] if fleet is None else f"{socket.gethostname()}-{os.getpid()}"
    by_default = not (args.connect or args.listen or args.zenoh_config)
    compose(args.connect or (), args.listen or (), args.zenoh_config)  # mistakes before anything is fetched or written
    opened = open_map_argument(args)
    if opened.path.is_file() and opened.path.suffix not in (JOINED_SUFFIX, PART_SUFFIX):
        load(opened.path, check=False)  # no map: refused before a folder is made; its bytes are checked when it opens
    options = ServeOptions(
        map_path=opened.path,
        keys=keys,
        network=NetworkOptions(
            args.connect,
            [DEFAULT_ENDPOINT] if by_default else args.listen,
            args.zenoh_config,
            ros2=args.ros_node,
            check_frames=args.mount is None and lidar is None,
        ),
        codecs=CodecOptions(args.cloud_encoding, args.odometry_encoding, args.pose_encoding, args.geo),
        node=node,
        localizer=localizer,
        lidar=lidar,
        guesses=initial_guesses(args.initial, args.robot, args.within),
        mirrors=opened.mirrors,
        verify_key=verify_key,
        fleet=fleet,
        node_keys=node_keys(args.base, args.node_name or default_node),
        metrics=args.metrics,
    )
    return replace(options, state=state_folder(args))  # last, because it logs the folder


def _serve(
    options: ServeOptions,
    stop: Stop,
    children: dict[str, EngineChild] | None = None,
    hangups: Sequence[int] = (),
    sinks: Sequence[Sink] = (),
) -> bool:
    """Open the node and run it until asked to stop; False if a thread hangs. Each hangup reloads the map.

    Another thread opens the node, so that a signal can end the wait for a host that does not answer.
    """
    from coview_stream.cli.view import feed_of_node
    from coview_stream.stream.node.engine_process import CancelledError
    from coview_stream.stream.node.health import Notifier
    from coview_stream.stream.node.serve import open_node

    notifier = Notifier()
    opened: list[Node] = []
    failed: list[BaseException] = []
    feeds: list[SessionFeed | None] = []

    def work() -> None:
        try:
            opened.append(node := open_node(options, lambda: stop.requested, children, notifier))
            feeds.append(feed_of_node(node, options, sinks))
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
        if len(hangups) > answered:  # before the wait too: one may have come while the node opened
            answered = len(hangups)
            for node in opened:
                node.reload()
        if stop.wait(60.0):
            break
    notifier.stopping()
    if failed and not stop.requested:
        for node in opened:  # its views failed
            node.close(_MAX_SHUTDOWN)
        raise failed[0]
    end = stop.now() + _MAX_SHUTDOWN
    for feed in filter(None, feeds):
        feed.close()
    opening.join(_MAX_SHUTDOWN)
    return not opening.is_alive() and all(node.close(end - stop.now()) for node in opened)
