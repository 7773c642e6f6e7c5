"""Start of a node: a map file and options in, a running node out."""

from __future__ import annotations

import logging
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.joined import load_map
from coview_stream.basemap.map_parts import MapParts
from coview_stream.basemap.signature import Trust, VerifyKey
from coview_stream.config import AcceptanceConfig, RegistrationMethod, Reloc
from coview_stream.config.node import NodeConfig
from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.errors import MapError
from coview_stream.stream.node.engine_child import EngineChild, start_children
from coview_stream.stream.node.engine_process import CancelledError, DiedError, EngineProcess
from coview_stream.stream.transport.keys import NodeKeys, RobotKeys, check_disjoint

if TYPE_CHECKING:
    from coview_stream.basemap.site.fetch import Mirror
    from coview_stream.localization.search.place_guess import PlaceGuess
    from coview_stream.stream.node.node import Node
    from coview_stream.stream.node.reload import OpenedMap
    from coview_stream.stream.node.session import Session
    from coview_stream.stream.node.systemd import Notifier

log = logging.getLogger("coview_stream.node")


@dataclass(frozen=True)
class ServeOptions:
    """Options of ``serve``.

    Attributes:
        map_path: a ``.coview`` file.
        keys: of each robot.
        connect: endpoints to connect to.
        listen: endpoints to listen on.
        zenoh_config: a zenoh JSON5 file, or None.
        node: rates and limits.
        cloud_codec: of all clouds, against what they say themselves; None believes them.
        odometry_codec: likewise.
        pose_codec: of the poses; None is the preset's.
        lidar: how odometry is made of the clouds; None if the robots send theirs.
        registration: how scans are registered to the map.
        state: directory that keeps the last known poses; None for none.
        reloc: recognizers that propose the places to search at.
        risk: probability of a wrong place below which a search gives one.
        node_keys: of the node's own; None for none.
        metrics: ``HOST:PORT`` at which health and metrics can be read over HTTP; None for none.
        geo: encoding in which poses go out as places on Earth as well; None: they do not.
        guesses: of the places of robots, by name: tried, never trusted.
        mirrors: of the sites elsewhere that the map is made of, whose changes are followed.
        fleet: name of the fleet of nodes that share the robots; None: this one serves all, or stands by for all.
        base: first part of the fleet's keys.
        verify_key: public key that the map has to be signed with, also one that is loaded later; None for any map.
    """

    map_path: Path
    keys: Sequence[RobotKeys]
    connect: Sequence[str] = ()
    listen: Sequence[str] = ()
    zenoh_config: Path | None = None
    node: NodeConfig = field(default_factory=NodeConfig)
    cloud_codec: str | None = None
    odometry_codec: str | None = None
    pose_codec: str | None = None
    lidar: LidarOdometryConfig | None = None
    registration: RegistrationMethod = "trimmed-icp"
    state: Path | None = None
    reloc: Reloc = "auto"
    risk: float = AcceptanceConfig.risk
    node_keys: NodeKeys | None = None
    metrics: str | None = None
    verify_key: VerifyKey | None = None
    geo: str | None = None
    guesses: Mapping[str, PlaceGuess] = field(default_factory=dict)
    mirrors: Sequence[Mirror] = ()
    fleet: str | None = None
    base: str = "coview"


def open_node(
    options: ServeOptions,
    cancelled: Callable[[], bool] = lambda: False,
    children: Mapping[str, EngineChild] | None = None,
    notifier: Notifier | None = None,
) -> Node:
    """Load the map in the engines, open the network and start; what fails leaves nothing running.

    Args:
        options: what to serve, and where.
        cancelled: asked now and then; True gives up.
        children: from :func:`start_children`, if the engines have been started already.
        notifier: tells systemd; the caller tells by it that the service ends.

    Raises:
        MapError: the map is unusable. ConfigError: robots cannot be told apart. TransportError: no network.
        CancelledError: as asked. CoViewError: a library that the options ask for is missing.
    """
    check_disjoint(options.keys)
    names = [k.robot for k in options.keys]
    begin = time.monotonic()
    if children is None:
        children = start_children(options.lidar is not None)
    engines: dict[str, EngineProcess] = {}
    transport = None
    try:
        # for its errors and hash, while the engines start: they map it themselves
        base_map, engines = start_engines(options, children)
        # imported while the engines start, which takes longer
        from coview_stream.messages import CLOUD_CODECS, ODOMETRY_CODECS, POSE_CODECS, prepare
        from coview_stream.stream.maps.map_follower import MapFollower
        from coview_stream.stream.node.election import Elections
        from coview_stream.stream.node.fleet import LEASE_MS, FleetShares
        from coview_stream.stream.node.fleet_member import FleetMember
        from coview_stream.stream.node.last_pose_keeper import LastPoseKeeper
        from coview_stream.stream.node.locations import LocationPublisher, MapReference
        from coview_stream.stream.node.map_view import MapViewAnswer
        from coview_stream.stream.node.node import Node
        from coview_stream.stream.node.reload import MapReloader
        from coview_stream.stream.node.systemd import Notifier
        from coview_stream.stream.transport.zenoh_transport import open_transport

        files = {base_map.sha256: base_map.path or options.map_path}  # what each map was opened from, by its hash
        reference = None if options.geo is None else MapReference(files, base_map.sha256)
        transport = open_transport(
            options.connect, options.listen, options.zenoh_config, options.node.max_payload,
            lease_ms=None if options.fleet is None else LEASE_MS,
        )  # fmt: skip
        elections: Elections | FleetShares
        if options.fleet is None:
            elections = Elections(options.keys, options.node.status_rate, needs_connection=bool(options.connect))
        else:
            name = uuid.uuid4().hex[:12]
            elections = FleetShares(options.fleet, options.keys, options.base, options.node.status_rate, name)
        elections.declare(transport)
        sessions = make_sessions(options, base_map)
        for session in sessions:
            if (guess := options.guesses.get(session.keys.robot)) is not None:
                session.guess_place(guess)
        prepare(*CLOUD_CODECS, *ODOMETRY_CODECS, *POSE_CODECS)
        for name, engine in engines.items():
            if name != "search":  # which has until the first keyframe
                engine.wait_ready(cancelled)
        if cancelled():
            raise CancelledError("the node is no longer wanted")
        background = {} if options.state is None else {"last-pose": LastPoseKeeper(options.state, sessions).run}
        node = Node(
            sessions, transport, engines["track"], engines["search"], options.node, options.pose_codec,
            engines.get("odometry"), background, elections,
        )  # fmt: skip
        node.map_files = files
        notifier = notifier or Notifier()
        node.reloader = reloader = MapReloader(
            node,
            lambda cancelled: open_map(options, node.map_sha256, cancelled, files),
            lambda busy: notifier.reloading(busy, "changing the map" if busy else ", ".join(names)),
        )
        node.run_beside("reload", reloader.run)
        if options.mirrors:
            node.map_follower = follower = MapFollower(options.mirrors, node.reload, lambda: reloader.outcome)
            node.run_beside("map source", follower.run)
        _add_health(node, options, notifier)
        if isinstance(elections, FleetShares):
            for endpoints in node.endpoints.values():
                endpoints.waits = True
            node.run_beside("fleet", FleetMember(elections, node.endpoints, transport).run)
        map_view = MapViewAnswer(files, lambda: node.map_sha256)
        for keys in options.keys:
            transport.answer(keys.map_view, map_view)
        if reference is not None and options.geo is not None:
            for keys in options.keys:
                publisher = transport.publisher(keys.location, "data")
                node.endpoints[keys.robot].beside.append(LocationPublisher(publisher, reference, options.geo))
        node.start()
    except BaseException as error:
        for engine in engines.values():
            engine.close()
        for child in children.values():
            child.close()
        if transport is not None:
            transport.close()
        if isinstance(error, DiedError):
            raise MapError(f"{options.map_path}: {error} while it opened the map") from error
        raise
    where = node.map_follower.name if node.map_follower is not None else options.map_path
    log.info("ready after %.1f s: map %s, robots %s", time.monotonic() - begin, where, ", ".join(names))
    notifier.ready(f"serves {', '.join(names)}")
    return node


def _add_health(node: Node, options: ServeOptions, notifier: Notifier) -> None:
    """Have the node tell how it is: on zenoh, to systemd, and over HTTP where that is asked for."""
    from coview_stream.stream.node.health import NodeHealth, metrics_server

    health, keys = NodeHealth(node, needs_connection=bool(options.connect)), options.node_keys
    if keys is not None:
        health.answer(keys)
        node.run_beside("health", lambda stopping: health.run(stopping, keys))
    if options.metrics is not None:
        node.run_beside("metrics", metrics_server(options.metrics, health.document).run)
    if notifier.watchdog_period is not None:
        node.run_beside("systemd", lambda stopping: notifier.run(stopping, lambda: not health.live_reasons()))


def start_engines(
    options: ServeOptions, children: Mapping[str, EngineChild], base_map: BaseMap | None = None
) -> tuple[BaseMap, dict[str, EngineProcess]]:
    """Check the map and have the engines begin to open it; return it and them.

    Args:
        options: of the node.
        children: processes that become the engines.
        base_map: the map, if it has been loaded and verified already.

    Raises:
        MapError: the map is unusable. CoViewError: it has not what the options ask for.
    """
    base_map = base_map or load_map(options.map_path, options.verify_key)
    # what has been verified here they need not read again, as long as the file is the same
    trust = None if options.verify_key is None else Trust(options.verify_key, base_map.identity)
    path = options.map_path
    if base_map.path is not None and base_map.path != path.absolute():
        # what it is made of may change while they are started again: they open the very file, whose hash is known
        path, trust = base_map.path, None
    missing = base_map.require_features(options.reloc)
    if missing is not None:
        log.warning("%s: %s", options.map_path, missing)
    reloc: Reloc = options.reloc if missing is None else "coview"  # or the engines would say so again
    engines = {
        kind: EngineProcess(
            kind, str(path), base_map.sha256, None,
            registration=options.registration, reloc=reloc, risk=options.risk,
            sensor_leans=options.lidar is None, child=child, trust=trust,
        )
        for kind, child in children.items()
    }  # fmt: skip
    try:
        for engine in engines.values():
            engine.start()
    except BaseException:
        for engine in engines.values():
            engine.close()
        raise
    return base_map, engines


def open_map(
    options: ServeOptions, served: str, cancelled: Callable[[], bool], files: dict[str, Path] | None = None
) -> OpenedMap | None:
    """Open the map's file again, in new engines, until they would not keep a job waiting; None if it is the one served.

    Args:
        options: of the node.
        served: hash of the map that is served.
        cancelled: asked now and then; True gives up.
        files: what maps were opened from, by their hashes; of more than the one served and this one none is kept.

    Raises:
        MapError: the map is unusable. CoViewError, DiedError: the engines cannot open it. CancelledError: as asked.
    """
    from coview_stream.stream.maps.fetch_map import prepare_map
    from coview_stream.stream.node.reload import OpenedMap

    prepare_map(options.map_path, cancelled)
    if cancelled():
        raise CancelledError("the node is no longer wanted")
    base_map = load_map(options.map_path, options.verify_key)
    if base_map.sha256 == served:
        return None
    children = start_children(options.lidar is not None)
    engines: dict[str, EngineProcess] = {}
    try:
        _, engines = start_engines(options, children, base_map)
        for engine in engines.values():
            engine.wait_prepared(cancelled)
        if cancelled():
            raise CancelledError("the node is no longer wanted")
        opened = OpenedMap(base_map.sha256, engines, make_sessions(options, base_map))
        if files is not None:
            for old in files.keys() - {served}:
                files.pop(old)
            files[base_map.sha256] = base_map.path or options.map_path
        return opened
    except BaseException:
        for engine in engines.values():
            engine.close()
        for child in children.values():
            child.close()
        raise


def make_sessions(options: ServeOptions, base_map: BaseMap) -> list[Session]:
    """Return a session for each robot, which makes its odometry if the options ask for that."""
    from coview_stream.stream.node.lidar_session import LidarSession
    from coview_stream.stream.node.session import Session

    codecs = (options.cloud_codec, options.odometry_codec)
    parts, map_sha256 = MapParts.of(base_map.parameters), base_map.sha256
    made: list[Session]
    if options.lidar is None:
        made = [Session(keys, map_sha256, options.node, codecs, parts) for keys in options.keys]
    else:
        made = [LidarSession(keys, map_sha256, options.node, codecs, options.lidar, parts) for keys in options.keys]
    for session in made:
        session.site_sha256 = str(base_map.parameters.get("site") or base_map.sha256)
    return made
