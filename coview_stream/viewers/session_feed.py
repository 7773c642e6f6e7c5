"""Feed of a session: subscribes to robots' poses, statuses, hypotheses and clouds, and hands them to sinks.

The network's threads only queue. One thread decodes and calls the sinks; another requests the map.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from operator import methodcaller
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from coview_stream.basemap.summary import MAX_WIRE_BYTES, MapView
from coview_stream.config.mount import Mount
from coview_stream.errors import MessageError
from coview_stream.messages import decode_cloud, decode_pose
from coview_stream.messages.json_messages import decode_hypotheses, read_status
from coview_stream.messages.types import HypothesesMessage, PoseMessage, Sample
from coview_stream.stream.client.latest_queue import LatestQueue
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.keys import RobotKeys, check_prefix
from coview_stream.stream.transport.transport import Policy, Transport
from coview_stream.viewers.scene import PoseTrack, Scan, Sink

_TIMEOUT = 10.0  # seconds for a query: at the first one the node thins its map

MapSource = Callable[[str], MapView]
"""Takes a robot's name, and returns the map on which its node localizes it; a CoViewError if there is none."""


def asked_of_node(transport: Transport, base: str) -> MapSource:
    """Return a map source that queries a robot's node."""

    def ask(robot: str) -> MapView:
        key = f"{base}/{robot}/rpc/map_view"
        return MapView.from_json(transport.query(key, timeout=_TIMEOUT, max_bytes=MAX_WIRE_BYTES))

    return ask


def read_from_files(files: Mapping[str, Path], sha256: Callable[[], str]) -> MapSource:
    """Return a map source that reads a node's files, given the hash of the served map: ``sha256()``."""
    from coview_stream.basemap.basemap import load_served

    return lambda robot: MapView.of(load_served(files, sha256()))


TopicKind = Literal["pose", "status", "hypotheses", "cloud"]


class Topic(NamedTuple):
    """One key expression to subscribe to."""

    key: str
    kind: TopicKind
    robot: str | None = None
    """Robot of all messages; None: it is in the samples' keys, after ``depth`` chunks."""
    hint: str | None = None
    """Codec of messages without Encoding."""
    depth: int = 0
    codec: str | None = None
    """Codec of all messages; their Encoding is ignored."""

    def robot_of(self, sample: Sample) -> str:
        """Return the robot that a sample belongs to."""
        return self.robot or sample.key.split("/")[self.depth]


def topics_of_robots(keys: Sequence[RobotKeys], cloud_codec: str | None = None) -> list[Topic]:
    """Return the topics of named robots, for any preset; ``cloud_codec`` as in ``serve --cloud-encoding``."""
    topics = []
    for k in keys:
        topics += [Topic(k.pose, "pose", k.robot, k.hint)]
        topics += [Topic(k.cloud, "cloud", k.robot, k.hint, codec=cloud_codec)]
        topics += [Topic(k.status, "status", k.robot), Topic(k.hypotheses, "hypotheses", k.robot)]
    return topics


def topics_of_base(base: str) -> list[Topic]:
    """Return the topics of all robots under a base, with native keys; ConfigError if it cannot start a key."""
    base = check_prefix(base, "--base")
    depth = len(base.split("/"))
    ends: tuple[tuple[str, TopicKind], ...] = (
        ("out/pose", "pose"), ("out/status", "status"), ("out/hypotheses", "hypotheses"), ("in/cloud", "cloud"),
    )  # fmt: skip
    return [Topic(f"{base}/*/{end}", kind, depth=depth) for end, kind in ends]


_log = logging.getLogger(__name__)

MAX_ROBOTS = 256
"""Limit of robots in view: names come from the network."""
_MAX_QUEUED = 4_000  # messages waiting for slow sinks
_POLL = 0.05  # seconds without an event until clouds are looked at
_SCAN_PERIOD = 0.2  # seconds between decoded scans of a robot
_SCAN_POINTS = 6_000  # points of a scan that sinks get
_POSE_WAIT = 0.4  # seconds that a scan waits for a pose at its time
_JOIN_TIMEOUT = 0.2  # seconds for a thread to end; the map's thread may be busy longer
_MAP_RETRY = 5.0  # seconds between requests for a map


class SessionFeed:
    """Subscriptions to robots' poses, statuses, hypotheses and clouds, decoded for sinks; a context manager.

    Args:
        transport: the caller closes it.
        map_view: map to show from the start; None: none.
        map_source: called with a robot's name when its status names an unknown map; None: no further map.
        clouds: whether to subscribe to clouds, most of the traffic.
        mount: pose of the lidars on their robots, as in ``serve --mount``, where a cloud comes without its own.
        policy: of all subscriptions but those to clouds, which always take ``newest``; give ``newest`` in the node's
            own process, so that a full queue cannot block the node.
    """

    def __init__(
        self,
        transport: Transport,
        topics: Sequence[Topic],
        map_view: MapView | None = None,
        map_source: MapSource | None = None,
        clouds: bool = True,
        mount: Mount | None = None,
        policy: Policy = "all",
    ) -> None:
        self._transport = transport
        self._topics = [topic for topic in topics if clouds or topic.kind != "cloud"]
        self._policy: Policy = policy
        self._mount = mount or Mount()
        self._map_source = map_source
        self._errors = RateLimitedErrors(_log)
        self._inbox: LatestQueue[tuple[Topic, Sample] | MapView] = LatestQueue(_MAX_QUEUED)
        self._clouds: dict[str, tuple[Topic, Sample]] = {}  # newest of each robot
        self._lock = threading.Lock()  # of the newest clouds and the sinks
        self._sinks: list[Sink] = []
        self._maps: dict[str, MapView] = {}
        self._wanted: LatestQueue[str] = LatestQueue(8)  # robots whose map is unknown
        self._asked: dict[str, float] = {}  # time of the last request, by hash
        self._robots: set[str] = set()
        self._tracks: dict[str, PoseTrack] = {}
        self._pending: dict[str, tuple[float, Scan]] = {}  # scans that wait for a pose, and until when
        self._next_scan: dict[str, float] = {}  # not before this time
        self._stopping = threading.Event()
        self._threads: list[threading.Thread] = []
        if map_view is not None:
            self._inbox.put(map_view)

    def add(self, sink: Sink) -> None:
        """Hand all further events, and the known maps, to a sink."""
        with self._lock:
            self._sinks.append(sink)
            maps = list(self._maps.values())
        for view in maps:  # on the feed's thread, and again to all sinks
            self._inbox.put(view)

    def start(self) -> None:
        """Subscribe, and start the threads."""
        for name, run in (("feed", self._run), ("map", self._run_map_source)):
            thread = threading.Thread(target=run, name=f"coview-view-{name}", daemon=True)
            self._threads.append(thread)
            thread.start()
        for topic in self._topics:
            policy: Policy = "newest" if topic.kind == "cloud" else self._policy
            self._transport.subscribe(topic.key, self._receiver(topic), policy)

    def close(self) -> None:
        """End the threads and close the sinks; subscriptions end with the transport."""
        if self._stopping.is_set():
            return
        self._stopping.set()
        self._inbox.close()
        self._wanted.close()
        for thread in self._threads:
            thread.join(_JOIN_TIMEOUT)
        for sink in self._sinks:
            with self._errors.catch("viewer"):
                sink.close()

    def __enter__(self) -> SessionFeed:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ---- the network's threads

    def _receiver(self, topic: Topic) -> Callable[[Sample], None]:
        def receive(sample: Sample) -> None:
            if topic.kind != "cloud":
                self._inbox.put((topic, sample))
                return
            robot = topic.robot_of(sample)
            with self._lock:
                if robot in self._clouds or len(self._clouds) < MAX_ROBOTS:
                    self._clouds[robot] = topic, sample

        return receive

    # ---- the feed's thread

    def _run(self) -> None:
        while not self._stopping.is_set():
            item = self._inbox.get(timeout=_POLL)
            with self._errors.catch("viewer"):
                if item is not None:
                    self._take(item)
                self._take_clouds(time.monotonic())

    def _take(self, item: tuple[Topic, Sample] | MapView) -> None:
        if isinstance(item, MapView):
            with self._lock:
                self._maps[item.sha256] = item
            self._hand_out("map", lambda sink: sink.map(item))
            return
        topic, sample = item
        robot = topic.robot_of(sample)
        if not self._admits(robot):
            return
        try:
            if topic.kind == "pose":
                pose = self._on_view(replace(decode_pose(sample, hint=topic.hint), robot=robot))
                self._tracks.setdefault(robot, PoseTrack()).add(pose.stamp_ns, pose.T_map_body)
                self._hand_out("pose", lambda sink: sink.pose(pose))
            elif topic.kind == "status":
                self._take_status(robot, read_status(sample))
            else:
                message = self._places_on_view(replace(decode_hypotheses(sample), robot=robot))
                self._hand_out("hypotheses", lambda sink: sink.hypotheses(message))
        except MessageError as error:
            self._errors.report(sample.key, error)

    def _admits(self, robot: str) -> bool:
        """Add a robot, up to the limit; return whether it is in view."""
        if len(self._robots) < MAX_ROBOTS:
            self._robots.add(robot)
        return robot in self._robots

    def _on_view(self, pose: PoseMessage) -> PoseMessage:
        """Return a pose in the frame of the view, which shows several maps side by side."""
        view = self._maps.get(pose.map_sha256)
        for part in (view.parts if view else None) or ():
            if part.name == pose.frame_id:
                return replace(pose, T_map_body=part.joined(pose.T_map_body), T_map_odom=None)
        return pose

    def _places_on_view(self, message: HypothesesMessage) -> HypothesesMessage:
        view = self._maps.get(message.map_sha256)
        if view is None or view.parts is None or len(message.maps) != len(message.places):
            return message
        shifts = {part.name: part.shift for part in view.parts}
        places = message.places.copy()
        places[:, :3] += np.array([shifts.get(name, (0.0, 0.0, 0.0)) for name in message.maps]).reshape(-1, 3)
        return replace(message, places=places)

    def _take_status(self, robot: str, status: dict[str, Any]) -> None:
        sha256 = status.get("map_sha256")
        if isinstance(sha256, str) and self._map_source is not None and sha256 not in self._maps:
            now = time.monotonic()
            if now - self._asked.get(sha256, -_MAP_RETRY) >= _MAP_RETRY and len(self._asked) < MAX_ROBOTS:
                self._asked[sha256] = now
                self._wanted.put(robot)
        self._hand_out("status", lambda sink: sink.status(robot, status))

    def _take_clouds(self, now: float) -> None:
        """Decode the clouds that are due, and hand out the scans that no longer wait for a pose."""
        with self._lock:
            due = [robot for robot in self._clouds if self._next_scan.get(robot, 0.0) <= now]
            clouds = {robot: self._clouds.pop(robot) for robot in due if robot not in self._pending}
        for robot, (topic, sample) in clouds.items():
            if not self._admits(robot):
                continue
            self._next_scan[robot] = now + _SCAN_PERIOD
            try:
                message = decode_cloud(sample, topic.codec, topic.hint).limited(2 * _SCAN_POINTS)
            except MessageError as error:
                self._errors.report(sample.key, error)
                continue
            points = message.points[np.isfinite(message.points).all(axis=1)]
            points = points[:: max(1, -(-len(points) // _SCAN_POINTS))]
            points = np.array((sample.mount or self._mount).to_body(points), dtype=np.float32)
            self._pending[robot] = now + _POSE_WAIT, Scan(robot, message.stamp_ns, points, None)
        for robot, (until, scan) in list(self._pending.items()):
            track = self._tracks.get(robot)
            if now >= until or (track is not None and track.reaches(scan.stamp_ns)):
                del self._pending[robot]
                known = scan if track is None else replace(scan, T_map_body=track.at(scan.stamp_ns))
                self._hand_out("scan", methodcaller("scan", known))

    def _hand_out(self, event: str, call: Callable[[Sink], None]) -> None:
        with self._lock:
            sinks = list(self._sinks)
        for sink in sinks:
            with self._errors.catch(f"{type(sink).__name__}.{event}"):
                call(sink)

    # ---- the map's thread

    def _run_map_source(self) -> None:
        while not self._stopping.is_set():
            robot = self._wanted.get(timeout=1.0)
            if robot is None or self._map_source is None:
                continue
            try:
                self._inbox.put(self._map_source(robot))
            except Exception as error:  # the next map may succeed
                self._errors.report(f"map of {robot}", error)
