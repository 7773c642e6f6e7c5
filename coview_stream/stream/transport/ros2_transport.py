"""A ROS 2 node as a transport: topics instead of zenoh keys, through rclpy.

Clouds, odometry and initial poses are read by our own codec from the middleware's bytes. Poses, statuses and the map
view are published as the messages that RViz and Nav2 read; everything else stays in this process.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import logging
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np

from coview_stream.basemap.summary import MapView
from coview_stream.config.mount import Mount
from coview_stream.errors import ConfigError, CoViewError, MessageError, TransportError, printable
from coview_stream.geometry.transforms import Pose
from coview_stream.messages import json_messages, ros2, ros2_outputs
from coview_stream.messages.types import Encoded, Sample
from coview_stream.recordings.frame_tree import FrameTree
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.keys import RobotKeys
from coview_stream.stream.transport.ros2_node import latched, message_type
from coview_stream.stream.transport.transport import MAX_REPLY, Connection, Policy, Publisher, Urgency
from coview_stream.stream.transport.zenoh_io import THREADS, Inbox, Inboxes

_log = logging.getLogger(__name__)

_QUEUE = 1024  # samples; 5 s of 200 Hz odometry
_CACHE = 10.0  # seconds of transforms in a tf2 buffer: older stamps find none
_JOIN = 0.3  # seconds for each thread at closing
RETRY = 10.0  # seconds until a map view that failed is requested again
_NO_TF = "as ROS package tf2_msgs is missing"
_MAP_TOPIC, _GUESS_TOPIC = "map_points", "initialpose"  # relative: a namespace moves them


@dataclass
class _Robot:
    """A robot's topics and frames. ``check_frames``: /tf_static must join a cloud's frame to the odometry's body."""

    keys: RobotKeys
    prefix: str  # of its topics tf, tf_static and initialpose; empty if it is the only robot
    check_frames: bool
    map_frame: str = "map"
    odometry_frame: str = ""  # of the newest odometry
    body_frame: str = ""  # the frame that odometry locates
    frames: FrameTree = field(default_factory=FrameTree)  # from /tf_static
    T_map_odom: Pose | None = None  # of the newest pose; kept while there is no pose
    posed_at: float = 0.0  # local time of the newest pose
    heard_ns: int | None = None  # stamp of the last cloud or odometry
    last_ns: int | None = None  # stamp of the last odometry
    odometry_ns: int | None = None  # newest odometry stamp since its clock started
    restarts: int = 0  # of odometry's frame, counted by the node
    clock_said: bool = False  # whether a log line says that the stamps contradict this node's clock
    outputs: dict[str, Any] = field(default_factory=dict)  # rclpy's publishers
    lock: threading.Lock = field(default_factory=threading.Lock)  # guards ``T_map_odom`` with ``odometry_ns``

    def check_cloud(self, sample: Sample) -> Sample:
        """Return a cloud with its mount from /tf_static, or refused because of its frame."""
        self.heard_ns, frame = ros2.header_stamp(sample.payload), ros2.frame_id(sample.payload)
        self.frames.lidar = frame
        body = self.body_frame or self.frames.body()  # odometry may name no body
        if self.check_frames and frame and self.odometry_ns is None:
            return _refused(sample, "clouds before the first odometry, which names the body's frame, are not used")
        if not (self.check_frames and frame and body) or frame == body:
            return sample
        if (T_body_lidar := self.frames.mount(body)) is not None:
            return replace(sample, mount=Mount().moved(T_body_lidar))
        why = "/tf_static does not join them" if "tf" in self.outputs else f"/tf_static is not read, {_NO_TF}"
        return _refused(
            sample,
            f"the cloud is in frame {frame!r}, odometry is of {body!r}, and {why}: give the lidar's pose on it by "
            "--mount, --mount=0,0,0 if the two are one",
        )

    def check_odometry(self, sample: Sample) -> Sample:
        """Note the frames of odometry; refuse odometry from another localizer."""
        frame, stamp_ns = ros2.frame_id(sample.payload), ros2.header_stamp(sample.payload)
        if frame == self.map_frame:
            return _refused(sample, f"odometry in frame {frame!r}, which is the map's: is it another localizer's pose?")
        with self.lock:
            self.heard_ns = self.last_ns = stamp_ns
            self.odometry_ns = max(stamp_ns, self.odometry_ns or stamp_ns)
        self.odometry_frame, self.body_frame = frame, ros2.frame_id(sample.payload, 1)
        return sample

    def note_restarts(self, count: int) -> None:
        """Forget map -> odom if the node has found that odometry's frame restarted."""
        with self.lock:
            if count > self.restarts:
                self.T_map_odom, self.odometry_ns = None, self.last_ns
            self.restarts = count

    def clock(self, now_ns: int) -> str:
        """Return how the stamps contradict the node's clock; empty if they agree."""
        if self.heard_ns is None:
            return ""
        if not now_ns:
            return "use_sim_time is set and nothing comes on /clock"
        late = (now_ns - self.heard_ns) / 1e9
        if abs(late) <= _CACHE:
            return ""
        side = "before" if late > 0 else "after"
        return f"stamps lie {abs(late):.0f} s {side} this node's clock: is use_sim_time as the sender's?"


def _refused(sample: Sample, reason: str) -> Sample:
    return replace(sample, payload=b"", refused=reason)


@dataclass(frozen=True)
class _Input:
    topic: str
    kind: str
    check: Callable[[Sample], Sample] = lambda sample: sample
    then: Callable[[], None] = lambda: None  # called after the sample has been delivered


class _Output:
    """Publisher to this process and, through ``write``, to ROS."""

    def __init__(self, transport: Ros2Transport, key: str, write: Callable[[bytes], None] | None) -> None:
        self._transport = transport
        self._key = key
        self._write = write

    def put(self, message: Encoded) -> None:
        self._transport.deliver(Sample(self._key, message.payload, message.encoding, message.attachment))
        if self._write is not None and not self._transport.closed.is_set():
            with self._transport.guard.catch(self._key):
                self._write(message.payload)

    def close(self) -> None:
        self._write = None


class Ros2Transport:
    """A ROS 2 node's topics under the keys of its robots; any thread may call any method.

    Args:
        node: from :func:`~coview_stream.stream.transport.ros2_node.start_node`; :meth:`close` destroys it.
        keys: of the robots; clouds, odometry and poses are topics without the leading slash.
        check_frames: refuse clouds in a frame that no transform joins to that of the odometry's body.
    """

    def __init__(self, node: Any, keys: Sequence[RobotKeys], check_frames: bool = True) -> None:
        self.guard = RateLimitedErrors(_log)
        self._node = node
        self._inputs: dict[str, _Input] = {}
        self._writers: dict[str, Callable[[bytes], None]] = {}
        self._readers: dict[str, tuple[Inbox, ...]] = defaultdict(tuple)
        self._subscribed: dict[str, Any] = {}
        self._services: dict[str, str] = {}
        self._show_map: Callable[[], dict[str, Any]] | None = None
        self._map_publisher: Any = None
        self._shown = ""  # hash of the published map
        self._retry_at = 0.0  # local time
        self._lock = threading.RLock()
        self.closed = threading.Event()
        self._inboxes = Inboxes(self.guard)
        self._map_wanted = self._inboxes.open("map", lambda _: self._publish_map(), 1)
        self._robots = [_Robot(k, f"{k.robot}/" if len(keys) > 1 else "", check_frames) for k in keys]
        try:
            if find_spec("tf2_msgs") is None:
                _log.warning("there is no TF, %s", _NO_TF)
            self._diagnostics = self._create_publisher(ros2_outputs.DIAGNOSTICS, "/diagnostics")
            for robot in self._robots:
                self._declare(robot)
        except CoViewError:
            raise
        except Exception as error:  # a name that ROS does not allow
            raise ConfigError(f"--ros2: {printable(error)}") from error
        executors = import_module("rclpy.executors")
        self._executor = executors.SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        works = [self._spin, *[self._inboxes.run] * THREADS]
        self._threads = [threading.Thread(target=work, name="coview ros", daemon=True) for work in works]
        for thread in self._threads:
            thread.start()
        atexit.register(self.close)  # a thread inside rclpy at interpreter shutdown may abort the process

    def _declare(self, robot: _Robot) -> None:
        """Declare a robot's topics."""
        keys, prefix, outputs = robot.keys, robot.prefix, robot.outputs
        outputs["pose"] = self._create_publisher(ros2.POSE, f"/{keys.pose}")
        if find_spec("tf2_msgs") is not None:
            outputs["tf"] = self._create_publisher(ros2_outputs.TRANSFORMS, f"/{prefix}tf", 100)
            self._node.create_subscription(
                message_type(ros2_outputs.TRANSFORMS), f"/{prefix}tf_static", partial(self._on_static, robot),
                latched(100), raw=True,
            )  # fmt: skip
        self._inputs |= {
            keys.cloud: _Input(f"/{keys.cloud}", ros2.CLOUD, robot.check_cloud),
            keys.odometry: _Input(
                f"/{keys.odometry}", ros2.ODOMETRY, robot.check_odometry, lambda: self._broadcast(robot)
            ),
            keys.initial_pose: _Input(prefix + _GUESS_TOPIC, ros2.POSE),
        }
        self._writers |= {
            keys.pose: lambda payload: self._write_pose(robot, payload),
            keys.status: lambda payload: self._write_status(robot, payload),
        }
        self._services |= {keys.relocalize: f"/{keys.robot}/relocalize", keys.reset: f"/{keys.robot}/reset"}

    def _create_publisher(self, kind: str, topic: str, depth: Any = 10) -> Any:
        return self._node.create_publisher(message_type(kind), topic, depth)

    # ---- interface of Transport

    def subscribe(self, key: str, handler: Callable[[Sample], None], policy: Policy) -> Callable[[], None]:
        """As :meth:`Transport.subscribe`, for a robot's topic or for messages of this process."""
        inbox = self._inboxes.open(key, handler, 1 if policy == "newest" else _QUEUE)

        def end() -> None:
            inbox.close()
            with self._lock:
                self._readers[key] = tuple(other for other in self._readers[key] if other is not inbox)
                subscription = None if self._readers[key] else self._subscribed.pop(key, None)
                if subscription is not None and not self.closed.is_set():
                    self._node.destroy_subscription(subscription)

        with self._lock:
            if self.closed.is_set():
                raise TransportError(f"key {key!r}: the transport is closed")
            self._readers[key] = (*self._readers[key], inbox)
            source = self._inputs.get(key)
            if source is not None and key not in self._subscribed:
                self._subscribed[key] = self._subscription(key, source)
        return end

    def _subscription(self, key: str, source: _Input) -> Any:
        """Subscribe with the sensor-data QoS, which is compatible with every publisher; bytes, not Python objects."""
        qos = import_module("rclpy.qos")
        encoding = f"application/cdr;{source.kind}"

        def take(payload: bytes) -> None:
            with self.guard.catch(key):
                sample = Sample(key, payload, encoding)
                with contextlib.suppress(MessageError):  # without a header its codec will refuse it
                    sample = source.check(sample)
                self.deliver(sample)
                if not sample.refused:
                    source.then()

        depth = 5 if source.kind == ros2.CLOUD else _QUEUE
        profile = qos.QoSProfile(depth=depth, reliability=qos.ReliabilityPolicy.BEST_EFFORT)
        subscription = self._node.create_subscription(message_type(source.kind), source.topic, take, profile, raw=True)
        _log.info("%s comes on topic %s", source.kind, subscription.topic_name)
        return subscription

    def deliver(self, sample: Sample) -> None:
        """Hand a sample to this process's subscriptions to its key."""
        for inbox in self._readers.get(sample.key, ()):
            inbox.put(sample)

    def publisher(self, key: str, urgency: Urgency) -> Publisher:
        """As :meth:`Transport.publisher`."""
        return _Output(self, key, self._writers.get(key))

    def answer(self, key: str, handler: Callable[[dict[str, str]], dict[str, Any]]) -> Callable[[], None]:
        """Publish the map view; answer services if ``std_srvs`` is installed; ignore other queries."""
        if any(key == robot.keys.map_view for robot in self._robots):
            self._show_map = lambda: handler({})
        if key not in self._services or find_spec("std_srvs") is None:
            return lambda: None

        def reply(_: Any, response: Any) -> Any:
            try:
                answer = handler({})
                response.success, response.message = bool(answer["ok"]), f"{answer['state']}: {answer['reason']}"
            except Exception as error:
                self.guard.report(key, error)
                response.success, response.message = False, str(error)
            return response

        trigger = import_module("std_srvs.srv").Trigger
        service = self._node.create_service(trigger, self._services[key], reply)

        def end() -> None:
            if not self.closed.is_set():
                self._node.destroy_service(service)

        return end

    def announce(self, key: str) -> None:
        """Do nothing: ROS has a graph of its nodes."""

    def query(
        self, key: str, parameters: dict[str, str] | None = None, timeout: float = 5.0, max_bytes: int = MAX_REPLY
    ) -> dict[str, Any]:
        """Raise TransportError: no ROS node answers queries by key."""
        raise TransportError(f"{key}: no answer: ROS 2 has topics and services instead")

    def tokens(self, expression: str) -> list[str]:
        """Return none."""
        return []

    def await_subscriber(self, key: str, seconds: float, wait: Callable[[float], object] = time.sleep) -> bool:
        """As :meth:`Transport.await_subscriber`, for topic ``key``."""
        deadline = time.monotonic() + seconds
        while not self._node.count_subscribers(f"/{key}"):
            if time.monotonic() >= deadline or wait(0.05):
                return False
        return True

    def connection(self) -> Connection:
        """Return the ROS nodes that publish clouds and odometry; log publishers of another type."""
        names = set()
        with self._lock:
            subscribed = [(self._inputs[key], held.topic_name) for key, held in self._subscribed.items()]
        for source, topic in subscribed:
            if source.topic.endswith(_GUESS_TOPIC):
                continue
            for end in self._node.get_publishers_info_by_topic(topic):
                if "UNKNOWN" in end.node_name:  # briefly only the publisher is known, not its node
                    continue
                names.add(f"{end.node_namespace.rstrip('/')}/{end.node_name}")
                if end.topic_type != source.kind:
                    text = f"{end.node_name} sends {end.topic_type}, which is not heard; {source.kind} is read"
                    self.guard.report(topic, TransportError(text))
        return Connection(peers=tuple(sorted(names)))

    def close(self) -> None:
        """As :meth:`Transport.close`."""
        with self._lock:
            if self.closed.is_set():
                return
            self.closed.set()
        atexit.unregister(self.close)
        self._inboxes.end()
        with contextlib.suppress(Exception):  # rclpy's own exceptions while it shuts down
            self._executor.shutdown(_JOIN)
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(_JOIN)
        with contextlib.suppress(Exception):
            self._node.destroy_node()
        with contextlib.suppress(Exception):
            self._node.context.try_shutdown()

    def _spin(self) -> None:
        while not self.closed.is_set():
            with self.guard.catch("rclpy"):
                self._executor.spin()

    def _on_static(self, robot: _Robot, payload: bytes) -> None:
        with self.guard.catch("/tf_static"):
            robot.frames.add(payload, static=True)

    # ---- messages out

    def _write_pose(self, robot: _Robot, payload: bytes) -> None:
        pose = json_messages.decode_pose(Sample("", payload))
        with robot.lock:
            if robot.odometry_ns is not None:
                if pose.stamp_ns > robot.odometry_ns:
                    return  # from before the sender restarted
                # forgets a stray stamp far ahead, but not odometry that came after this pose was made
                robot.odometry_ns = max(pose.stamp_ns, robot.last_ns or pose.stamp_ns)
            robot.T_map_odom, robot.map_frame, robot.posed_at = pose.T_map_odom, pose.frame_id, time.monotonic()
        robot.outputs["pose"].publish(ros2.encode_pose(pose).payload)

    def _broadcast(self, robot: _Robot) -> None:
        """Broadcast map -> odom at the stamp of new odometry; while the place is lost, the last known transform.

        It follows odometry, not poses: so a lookup of the body at odometry's stamp need not wait for the next pose.
        An older stamp than the newest is skipped: it comes from a late sample, or perhaps from a restarted clock.
        """
        publisher, T, frame, stamp_ns = robot.outputs.get("tf"), robot.T_map_odom, robot.odometry_frame, robot.heard_ns
        if publisher is not None and T is not None and frame and stamp_ns is not None and stamp_ns == robot.odometry_ns:
            publisher.publish(ros2_outputs.encode_transform(T, stamp_ns, robot.map_frame, frame))

    def _write_status(self, robot: _Robot, payload: bytes) -> None:
        status = json.loads(payload)
        now_ns = self._node.get_clock().now().nanoseconds
        counters = status.get("counters", {})
        robot.note_restarts(sum(counters.get(name, 0) for name in ("clock_restarts", "odometry_jumps")))
        if status["map_sha256"] != self._shown and time.monotonic() >= self._retry_at:
            self._map_wanted.put(Sample("map", b""))
        clock = robot.clock(now_ns)
        if clock and not robot.clock_said:
            _log.warning("%s: %s", robot.keys.robot, clock)
        robot.clock_said = bool(clock)
        if robot.T_map_odom is None:
            transform = "none: the place has not been found yet"
        elif status["state"] == "TRACKING":
            transform = "follows the pose"
        else:
            transform = f"frozen for {time.monotonic() - robot.posed_at:.0f} s"
        self._diagnostics.publish(ros2_outputs.encode_diagnostics(status, now_ns, transform, clock))

    def _publish_map(self) -> None:
        """Publish the served map's points, latched for later subscribers, unless they have been published."""
        if self._show_map is None:
            return
        self._retry_at = time.monotonic() + RETRY
        answer = self._show_map()
        self._retry_at = 0.0
        if answer["map_sha256"] == self._shown:  # a robot is still on another map
            return
        view = MapView.from_json(answer)
        if self._map_publisher is None:
            self._map_publisher = self._create_publisher(ros2.CLOUD, _MAP_TOPIC, latched(1))
        points = (view.points + view.origin).astype(np.float32)
        self._map_publisher.publish(ros2_outputs.encode_map(points, self._node.get_clock().now().nanoseconds))
        self._shown = view.sha256
