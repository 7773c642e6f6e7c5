"""Start of a node, from a map file and options."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.joined import load_map
from coview_stream.basemap.map_parts import MapParts
from coview_stream.basemap.signature import Trust, VerifyKey
from coview_stream.config import LocalizerConfig
from coview_stream.config.node import NodeConfig
from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.errors import MapError
from coview_stream.stream.node.engine_process import (
    CancelledError,
    DiedError,
    EngineChild,
    EngineProcess,
    start_children,
)
from coview_stream.stream.transport.keys import NodeKeys, RobotKeys, check_disjoint

if TYPE_CHECKING:
    from coview_stream.basemap.site.fetch import Mirror
    from coview_stream.localization.search.hints import PlaceGuess
    from coview_stream.stream.node.health import Notifier
    from coview_stream.stream.node.node import Node, OpenedMap, Service
    from coview_stream.stream.transport.transport import Transport

log = logging.getLogger("coview_stream.node")


@dataclass(frozen=True)
class NetworkOptions:
    """Endpoints to connect to and to listen on, and a zenoh JSON5 file; or a ROS 2 node instead of zenoh."""

    connect: Sequence[str] = ()
    listen: Sequence[str] = ()
    zenoh_config: Path | None = None
    ros2: Any = None  # from :func:`~coview_stream.stream.transport.ros2_node.start_node`
    check_frames: bool = True  # for ROS 2: refuse clouds in a frame that /tf_static does not join to odometry's body


@dataclass(frozen=True)
class CodecOptions:
    """Encodings of messages."""

    cloud: str | None = None  # for all clouds, overriding their own encoding; None: their own
    odometry: str | None = None  # the same for odometry
    pose: str | None = None  # of the poses; None: the preset's
    geo: str | None = None  # of the poses as places on Earth; None: not published


@dataclass(frozen=True)
class ServeOptions:
    """Options of ``serve``; ConfigError if the keys do not distinguish the robots."""

    map_path: Path  # argument of :func:`~coview_stream.basemap.joined.load_map`
    keys: Sequence[RobotKeys]  # of each robot
    network: NetworkOptions = field(default_factory=NetworkOptions)  # access to the network
    codecs: CodecOptions = field(default_factory=CodecOptions)  # encodings of messages
    node: NodeConfig = field(default_factory=NodeConfig)  # rates and limits
    localizer: LocalizerConfig = field(default_factory=LocalizerConfig)  # of the engines
    lidar: LidarOdometryConfig | None = None  # how odometry is computed from clouds; None: robots send it
    state: Path | None = None  # directory of the robots' last places; None: not kept
    # guesses of robots' places, by name: tried, never trusted
    guesses: Mapping[str, PlaceGuess] = field(default_factory=dict)
    mirrors: Sequence[Mirror] = ()  # of the remote sites that form the map, whose changes are followed
    # public key that must have signed the map, also after a reload; None: any map
    verify_key: VerifyKey | None = None
    # key prefix of the fleet of nodes that share the robots; None: this node serves them all
    fleet: str | None = None
    node_keys: NodeKeys | None = None  # keys of the node itself; None: none
    metrics: str | None = None  # ``HOST:PORT`` for health and metrics over HTTP; None: none

    def __post_init__(self) -> None:
        check_disjoint(self.keys)


def open_node(
    options: ServeOptions,
    cancelled: Callable[[], bool] = lambda: False,
    children: Mapping[str, EngineChild] | None = None,
    notifier: Notifier | None = None,
) -> Node:
    """Load the map in the engines, open the network and start; an error leaves nothing running.

    ``cancelled`` is polled; True gives up. ``children`` come from :func:`start_children`, if the engines have been
    started. With ``notifier`` the caller reports to systemd that the service ends.

    Raises:
        MapError: the map is unusable. TransportError: no network.
        CancelledError: cancelled. CoViewError: a library that the options need is missing.
    """
    names = ", ".join(k.robot for k in options.keys)
    begin = time.monotonic()
    if children is None:
        children = start_children(options.lidar is not None)
    engines: Mapping[str, EngineProcess] = {}
    transport = None
    try:
        # for errors and its hash, while the engines start: they map the file themselves
        base_map, engines = start_engines(options, children)
        # imported meanwhile, as the engines take longer to start
        from coview_stream.messages import CLOUD_CODECS, ODOMETRY_CODECS, POSE_CODECS, prepare
        from coview_stream.stream.node.health import Notifier

        notifier = notifier or Notifier()
        transport = _open_transport(options)
        node = _make_node(options, base_map, engines, transport, notifier)
        for session in node.sessions:
            if (guess := options.guesses.get(session.keys.robot)) is not None:
                session.guess_place(guess)
        prepare(*CLOUD_CODECS, *ODOMETRY_CODECS, *POSE_CODECS)
        for name, engine in engines.items():
            if name != "search":  # the search engine may become ready later
                engine.wait_ready(cancelled)
        engines["search"].start()
        _give_up_if(cancelled)
        node.start(_services(options, node, notifier))
    except BaseException as error:
        _close(engines, children)
        if transport is not None:
            transport.close()
        if isinstance(error, DiedError):
            raise MapError(f"{options.map_path}: {error} while it opened the map") from error
        raise
    where = ", ".join(mirror.source.name for mirror in options.mirrors) or options.map_path
    log.info("ready after %.1f s: map %s, robots %s", time.monotonic() - begin, where, names)
    notifier.ready(f"serves {names}")
    return node


def _open_transport(options: ServeOptions) -> Transport:
    network = options.network
    if network.ros2 is not None:
        from coview_stream.stream.transport.ros2_transport import Ros2Transport

        return Ros2Transport(network.ros2, options.keys, network.check_frames)
    from coview_stream.stream.node.fleet import LEASE_MS
    from coview_stream.stream.transport.zenoh_transport import open_transport

    lease_ms = None if options.fleet is None else LEASE_MS
    endpoints = network.connect, network.listen, network.zenoh_config
    return open_transport(*endpoints, options.node.max_payload, lease_ms)


def _make_node(
    options: ServeOptions,
    base_map: BaseMap,
    engines: Mapping[str, EngineProcess],
    transport: Transport,
    notifier: Notifier,
) -> Node:
    from coview_stream.stream.node.node import Node
    from coview_stream.stream.node.robot_endpoints import GeoOutput

    names = ", ".join(k.robot for k in options.keys)
    opened = _opened(options, base_map, engines)
    files = {opened.sha256: opened.file or options.map_path}
    geo = options.codecs.geo
    return Node(
        opened,
        transport,
        options.node,
        pose_format=options.codecs.pose,
        geo=None if geo is None else GeoOutput(files, opened.sha256, geo),
        shared=options.fleet is not None,
        open_map=lambda served, cancelled: open_map(options, served, cancelled),
        on_reload=lambda busy: notifier.reloading(busy, "changing the map" if busy else names),
        map_files=files,
    )


def _services(options: ServeOptions, node: Node, notifier: Notifier) -> dict[str, Service]:
    """Return the services that the options ask for: places, sources, fleet, health, systemd."""
    from coview_stream.stream.maps.map_follower import MapFollower
    from coview_stream.stream.node.fleet import Fleet
    from coview_stream.stream.node.health import NodeHealth, metrics_server
    from coview_stream.stream.node.last_place_keeper import LastPlaceKeeper

    services: dict[str, Service] = {}
    follower, fleet = None, None
    if options.state is not None:
        services["last-pose"] = LastPlaceKeeper(options.state, node.sessions).run
    if options.mirrors and node.reloader is not None:
        reloader = node.reloader
        follower = MapFollower(options.mirrors, reloader.request, lambda: reloader.outcome)
        services["map source"] = follower.run
    if options.fleet is not None:
        fleet = Fleet(
            options.fleet, node.identity.node, node.endpoints, node.transport,
            lambda: all(engine.ready for engine in node.feeds[0].engines.values()), node.identity.period,
        )  # fmt: skip
        services["fleet"] = fleet.run
    health = NodeHealth(node, bool(options.network.connect), follower, fleet)
    if (keys := options.node_keys) is not None:
        health.answer(keys)
        services["health"] = lambda stopping: health.run(stopping, keys)
    if options.metrics is not None:
        services["metrics"] = metrics_server(options.metrics, health.document).run
    if notifier.watchdog_period is not None:
        services["systemd"] = lambda stopping: notifier.run(stopping, lambda: not health.live_reasons())
    return services


def start_engines(
    options: ServeOptions, children: Mapping[str, EngineChild], base_map: BaseMap | None = None
) -> tuple[BaseMap, dict[str, EngineProcess]]:
    """Check the map and let the engines, which take over ``children``, start opening it; return both.

    The caller starts the search engine: it would take cores from the engines that the node waits for. ``base_map`` is
    the map, if it is already loaded and verified. After an error the caller closes the children.

    Raises:
        MapError: the map is unusable. CoViewError: it lacks an array that the options need.
    """
    base_map = base_map or load_map(options.map_path, options.verify_key)
    # the engines do not read again a file that was verified here, while it stays the same
    trust = None if options.verify_key is None else Trust(options.verify_key, base_map.identity)
    path = options.map_path
    if base_map.path is not None and base_map.path != path.absolute():
        # the sources of this working file may change before an engine restarts: engines open this file of known hash
        path, trust = base_map.path, None
    config = replace(options.localizer, sensor_leans=options.lidar is None)
    # where features are optional, the search engine checks whether the network loads: that takes 60 MB
    if (missing := base_map.require_features(config.reloc, load=config.reloc == "learned")) is not None:
        log.warning("%s: %s", options.map_path, missing)
        config = replace(config, reloc="coview")  # or the engines would repeat the warning
    engines = {
        kind: EngineProcess(kind, str(path), base_map.sha256, config, trust=trust, child=child)
        for kind, child in children.items()
    }
    for kind, engine in engines.items():
        if kind != "search":
            engine.start()
    return base_map, engines


def open_map(options: ServeOptions, served: str, cancelled: Callable[[], bool]) -> OpenedMap | None:
    """Open the map file again in new engines, until they are ready for jobs; None if it is the ``served`` map.

    Raises:
        MapError: the map is unusable. CoViewError, DiedError: the engines cannot open it. CancelledError: cancelled.
    """
    from coview_stream.stream.maps.fetch_map import prepare_map

    prepare_map(options.map_path, cancelled)
    _give_up_if(cancelled)
    base_map = load_map(options.map_path, options.verify_key)
    if base_map.sha256 == served:
        return None
    children = start_children(options.lidar is not None)
    engines: Mapping[str, EngineProcess] = {}
    try:
        _, engines = start_engines(options, children, base_map)
        engines["search"].start()
        for engine in engines.values():
            engine.wait_prepared(cancelled)
        _give_up_if(cancelled)
        return _opened(options, base_map, engines)
    except BaseException:
        _close(engines, children)
        raise


def _opened(options: ServeOptions, base_map: BaseMap, engines: Mapping[str, EngineProcess]) -> OpenedMap:
    """Return the map with a new session for each robot."""
    from coview_stream.stream.node.node import OpenedMap
    from coview_stream.stream.node.session import Session

    parts = MapParts.of(base_map.parameters)
    codecs = options.codecs.cloud, options.codecs.odometry
    site = str(base_map.parameters.get("site") or base_map.sha256)
    sessions = [
        Session(keys, base_map.sha256, options.node, codecs, parts, options.lidar, site, base_map)
        for keys in options.keys
    ]
    return OpenedMap(base_map.sha256, engines, sessions, base_map.path or options.map_path)


def _give_up_if(cancelled: Callable[[], bool]) -> None:
    if cancelled():
        raise CancelledError("the node is no longer wanted")


def _close(engines: Mapping[str, EngineProcess], children: Mapping[str, EngineChild]) -> None:
    for engine in engines.values():
        engine.close()
    for child in children.values():
        child.close()
