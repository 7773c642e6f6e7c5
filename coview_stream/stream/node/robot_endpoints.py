"""Endpoints of one robot on the network: poses, places on Earth, statuses and answers, such as the map view."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from coview_stream.basemap.basemap import BaseMap, load_served
from coview_stream.basemap.map_parts import MapParts
from coview_stream.basemap.summary import POINTS_ON_WIRE, MapView
from coview_stream.clouds.reference_system import GeoReference
from coview_stream.errors import CoViewError, InputError
from coview_stream.geometry.transforms import yaw_of
from coview_stream.messages import encode_location, encode_pose
from coview_stream.messages.types import Encoded, LocationMessage, PoseMessage, Sample
from coview_stream.stream.node.last_place import decode_guess, guess_of_fields
from coview_stream.stream.node.session import Session
from coview_stream.stream.node.status import Reporter
from coview_stream.stream.transport import rmw
from coview_stream.stream.transport.transport import Publisher, Transport

log = logging.getLogger("coview_stream.node")

_ROS_NODE = "coview_stream"


class RobotEndpoints:
    """One robot's subscriptions, queryables, publishers and liveliness tokens, around its session.

    ``wake_engines`` is called with the session when there may be a job. ``pose_format`` is the codec of the poses;
    None: the robot's keys decide. ``geo`` also publishes poses as places on Earth.
    """

    def __init__(
        self, session: Session, transport: Transport, reporter: Reporter, wake_engines: Callable[[Session], None],
        pose_format: str | None = None, geo: GeoOutput | None = None,
    ) -> None:  # fmt: skip
        self._sessions: tuple[Session, ...] = (session,)  # in force; during a change, also on the new map
        self._switching = threading.Lock()  # no pose of the old session is published after the switch
        self._transport = transport
        self._reporter = reporter
        self._wake_engines = wake_engines
        self._pose_format = pose_format or session.keys.pose_format
        self._bare = session.keys.hint is not None and pose_format is None
        self._geo = geo
        self._publisher: Publisher | None = None
        self._locations: Publisher | None = None
        self._endings: list[Callable[[], None]] = []  # ends of subscriptions and answers

    @property
    def session(self) -> Session:
        """The session in force."""
        return self._sessions[0]

    def add_session(self, session: Session) -> None:
        """Hand all messages also to a session on another map."""
        self._sessions = (self._sessions[0], session)

    def switch_session(self) -> None:
        """Put the added session in force; it continues the old one's counters and newest pose."""
        with self._switching:
            old, new = self._sessions
            new.continue_from(old)
            self._sessions = (new,)

    def declare(self, node_id: str, number: int) -> None:
        """Declare the outputs of this robot, the ``number``-th, from 1, of our ROS node ``node_id``."""
        keys, transport = self.session.keys, self._transport
        self._publisher = transport.publisher(keys.pose, "realtime")
        if keys.rmw:
            token = rmw.publisher_token(keys.pose, node_id, _ROS_NODE, number)
            if number == 1:
                transport.announce(rmw.node_token(int(keys.pose.split("/")[0]), node_id, _ROS_NODE))
            transport.announce(token)
            self._publisher = rmw.RmwPublisher(self._publisher, token, time.time_ns)
        if self._geo is not None:
            self._locations = transport.publisher(keys.location, "data")
        self._reporter.declare(self.session)

    @property
    def serving(self) -> bool:
        """Whether this node serves the robot: reads its messages, answers its queries, publishes poses and statuses."""
        return bool(self._endings)

    def begin_serving(self) -> None:
        """Start to read the robot's messages and answer its queries."""
        keys, transport = self.session.keys, self._transport
        if self.session.inputs.odometry_source == "robot":
            self._endings.append(transport.subscribe(keys.odometry, self.on_odometry, "all"))
        self._endings += [
            transport.subscribe(keys.cloud, self.on_cloud, "newest"),
            transport.subscribe(keys.initial_pose, self.on_initial_pose, "all"),
            transport.answer(keys.relocalize, self.relocalize),
            transport.answer(keys.reset, self.reset),
            transport.answer(keys.suggest, self.suggest),
        ]
        self._reporter.served.add(keys.robot)

    def end_serving(self) -> None:
        """Stop reading messages and answering queries: another node does, and a client takes the first reply."""
        self._reporter.served.discard(self.session.keys.robot)
        endings, self._endings = self._endings, []
        for end in endings:
            end()

    def on_cloud(self, sample: Sample) -> None:
        """Handle a cloud."""
        for session in self._sessions:
            session.on_cloud(sample, time.monotonic())
            self._wake_engines(session)

    def on_odometry(self, sample: Sample) -> None:
        """Handle an odometry sample."""
        for session in self._sessions:
            session.on_odometry(sample, time.monotonic())
            self._wake_engines(session)

    def on_initial_pose(self, sample: Sample) -> None:
        """Handle a guess of the place."""
        try:
            guess = decode_guess(sample)
            for session in self._sessions:
                session.guess_place(guess)
        except InputError as error:
            self.session.errors.add_first(f"{sample.key}: initial poses of no use", str(error))

    def relocalize(self, parameters: dict[str, str]) -> dict[str, Any]:
        """Answer ``rpc/relocalize``."""
        for session in self._sessions:
            session.restart_search("asked to search again", forget=True)
        return self._answer()

    def reset(self, parameters: dict[str, str]) -> dict[str, Any]:
        """Answer ``rpc/reset``."""
        for session in self._sessions:
            session.reset()
        return self._answer()

    def suggest(self, parameters: dict[str, str]) -> dict[str, Any]:
        """Answer ``rpc/suggest``; InputError, which is sent as the reply, if ``parameters`` are not a guess."""
        guess, notes = guess_of_fields(parameters), []
        for session in self._sessions:
            try:
                taken = session.guess_place(guess)
                notes.append("" if taken else "the place is known, the guess is ignored; ask rpc/relocalize first")
            except InputError as error:
                notes.append(str(error))
        return self._answer() | {"taken": "" in notes, "note": "" if "" in notes else notes[0]}

    def _answer(self) -> dict[str, Any]:
        self._reporter.changed.set()
        state, reason = self.session.state()
        return {"ok": True, "robot": self.session.keys.robot, "state": state.reported, "reason": reason}

    def publish_pose(self, now: float) -> None:
        """Advance time in the session, and publish the pose if it is known."""
        if not self.serving:
            return
        with self._switching:
            for session in self._sessions:
                session.tick(now)
            pose = self.session.pose()
            if pose is not None and self._publisher is not None:
                encoded = encode_pose(pose, self._pose_format)
                self._publisher.put(Encoded(encoded.payload) if self._bare else encoded)
                if self._geo is not None and self._locations is not None:
                    self._geo.publish(pose, self._locations)
                self._reporter.rates[pose.robot].add(now)
        self._reporter.report_change(self.session)


class GeoOutput:
    """Publication of poses as places on Earth, in the reference system of the map in force, which may change.

    ``files`` are the node's map files by hash, ``sha256`` is the hash of the first map.

    Raises:
        InputError, DependencyError: as :class:`GeoReference`.
    """

    def __init__(self, files: Mapping[str, Path], sha256: str, encoding: str) -> None:
        self._files = files
        self._encoding = encoding
        self._lock = threading.Lock()
        loaded = BaseMap.load(files[sha256], check=False)
        self._sha256, self._references = loaded.sha256, _references(loaded)

    def publish(self, pose: PoseMessage, publisher: Publisher) -> None:
        """Publish a pose if the map has a reference system and the pose can be converted to latitude and longitude."""
        geo, position = self.reference(pose.map_sha256, pose.frame_id), pose.T_map_body[:3, 3]
        if geo is None:
            return
        latitude, longitude, height = geo.geodetic(position[None])[0].tolist()
        if not np.isfinite([latitude, longitude, height]).all():
            return
        message = LocationMessage(
            stamp_ns=pose.stamp_ns,
            robot=pose.robot,
            latitude=latitude,
            longitude=longitude,
            height=height,
            heading=geo.heading(position, yaw_of(pose.T_map_body)),
            covariance=geo.enu_covariance(position, pose.covariance),
            confidence=pose.confidence,
        )
        publisher.put(encode_location(message, self._encoding))

    def reference(self, sha256: str, name: str = "") -> GeoReference | None:
        """Return the reference of a map, by its hash and, if it joins several, a part's name; None without one."""
        with self._lock:
            if sha256 != self._sha256:
                try:
                    loaded = BaseMap.load(self._files[sha256], check=False)
                    self._sha256, self._references = loaded.sha256, _references(loaded)
                except (CoViewError, KeyError) as error:
                    log.warning("no latitude and longitude on the new map: %s", error)
                    self._sha256, self._references = sha256, {}
            if sha256 != self._sha256:  # the file now holds another map
                return None
            return self._references.get(name, self._references.get(""))


def _references(base_map: BaseMap) -> dict[str, GeoReference]:
    """Return the references of a map's parts by name; for a single map its own, under an empty name."""
    parts = MapParts.of(base_map.parameters)
    if parts is None:
        return {"": GeoReference(base_map.crs)}
    return {part.name: GeoReference(part.crs) for part in parts}


class MapViewAnswer:
    """Answer to ``rpc/map_view``: :meth:`~coview_stream.basemap.summary.MapView.to_json` of the served map.

    ``files`` are the node's map files by hash; ``sha256`` returns the hash of the served map.
    """

    def __init__(self, files: Mapping[str, Path], sha256: Callable[[], str]) -> None:
        self._files = files
        self._sha256 = sha256
        self._made: tuple[str, dict[str, Any]] | None = None

    def __call__(self, parameters: dict[str, str]) -> dict[str, Any]:
        """Return the view, built once per map; MapError if its file now holds another map."""
        served = self._sha256()
        if self._made is None or self._made[0] != served:
            self._made = served, MapView.of(load_served(self._files, served), POINTS_ON_WIRE).to_json()
        return self._made[1]
