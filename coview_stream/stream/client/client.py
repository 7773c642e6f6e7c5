"""Client of a node for one robot: NumPy clouds and odometry out, poses in."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from time import monotonic
from typing import Any

import numpy.typing as npt

from coview_stream.errors import MessageError, TransportError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose
from coview_stream.messages import decode_pose
from coview_stream.messages.json_messages import read_status
from coview_stream.messages.types import PoseMessage, Sample
from coview_stream.stream.client.fleet_table import STALE
from coview_stream.stream.client.latest_queue import LatestQueue, Received
from coview_stream.stream.client.sender import Sender, nanoseconds
from coview_stream.stream.transport.keys import RobotKeys, robot_keys
from coview_stream.stream.transport.transport import Transport
from coview_stream.stream.transport.zenoh_transport import open_client

_log = logging.getLogger(__name__)

MAX_UNREAD_POSES = 100  # ten seconds of poses at 10 Hz; as many statuses are kept


class RobotClient:
    """Client that sends one robot's frames to a node and receives its poses; a context manager.

    >>> with RobotClient("rover1", "tcp/127.0.0.1:7447") as robot:     # doctest: +SKIP
    ...     robot.wait_for_node(10)                                    # earlier samples are lost
    ...     robot.send_odometry(T_odom_body, stamp)                    # before the cloud that it belongs to
    ...     robot.send_cloud(points, stamp)
    ...     for pose in robot.poses():
    ...         print(pose.T_map_body)

    Sending and reading may happen on different threads. The newest 100 unread poses are kept.

    In an event loop use ``async with`` and ``async for``; ``send_cloud`` and ``send_odometry`` never wait, and
    calls that do belong on a thread: ``await asyncio.to_thread(robot.wait_for_node, 10)``.

    Args:
        robot: its name, as given to ``coview-stream serve --robot``.
        endpoint: zenoh endpoint (or several) of the router or node; ``tcp/127.0.0.1:7447`` if neither this nor
            ``listen``, ``config`` or ``transport`` is given.
        listen: endpoint (or several) to wait for connections on.
        config: zenoh configuration file (JSON5).
        base: first part of the keys.
        preset: key convention, see :mod:`coview_stream.stream.transport.keys`.
        cloud_encoding: ``xyz``, ``xyzi``, ``foxglove``, ``cdr`` or ``keelson``; None: the preset's.
        odometry_encoding: ``json``, ``cdr``, ``foxglove`` or ``keelson``; None: the preset's.
        transport: an open transport, which the caller closes.

    Attributes:
        keys: keys of the messages sent and received.
        latest_status: newest status received; None before the first. Its ``stamp_ns`` is the node's Unix time.
        malformed: number of poses and statuses that could not be decoded.

    Raises:
        ConfigError: a name, preset or encoding is invalid.
        TransportError: the session cannot be opened. A missing router is no error: the client waits for it in the
            background.
    """

    def __init__(
        self,
        robot: str,
        endpoint: str | Sequence[str] | None = None,
        *,
        listen: str | Sequence[str] | None = None,
        config: str | Path | None = None,
        base: str = "coview",
        preset: str = "native",
        cloud_encoding: str | None = None,
        odometry_encoding: str | None = None,
        transport: Transport | None = None,
    ) -> None:
        self.keys: RobotKeys = robot_keys(preset, base, robot)
        self.robot = robot
        self.latest_status: dict[str, Any] | None = None
        self.malformed = 0
        self._owned = transport is None
        self._transport = transport if transport is not None else open_client(endpoint, listen, config)
        self._poses: LatestQueue[PoseMessage] = LatestQueue(MAX_UNREAD_POSES)
        self._statuses: LatestQueue[dict[str, Any]] = LatestQueue(MAX_UNREAD_POSES)
        self._latest_pose: tuple[float, PoseMessage] | None = None  # with its local arrival time
        self._closed = False
        try:
            self._sender = Sender(self._transport, self.keys, cloud_encoding, odometry_encoding)
            self._transport.subscribe(self.keys.pose, self._on_pose, "all")
            self._transport.subscribe(self.keys.status, self._on_status, "all")
        except BaseException:
            if self._owned:
                self._transport.close()
            raise

    @property
    def latest_pose(self) -> PoseMessage | None:
        """The newest pose received, while it is valid.

        None before the first, once a status has another state than TRACKING, and when no pose has come for 2 s of
        local time: a robot that is lost, or has lost its node, must not drive on an old pose.
        """
        newest = self._latest_pose
        if newest is None or monotonic() - newest[0] >= STALE or not _valid(self.latest_status):
            return None
        return newest[1]

    def send_cloud(self, points: npt.ArrayLike, stamp: float, times: Floats | None = None) -> None:
        """Publish one lidar frame; dropped if the link is busy with the previous one or nothing subscribes.

        Args:
            points: (N, 3), or (N, 4) with an unused intensity: body frame (x forward, z up), metres.
            stamp: sensor time, seconds, on the clock of the odometry.
            times: (N,) seconds after ``stamp`` at which each point was measured; None if the frame is deskewed. Raw
                rows have none: without an explicit encoding the client sends such a frame as foxglove.PointCloud.

        Raises:
            InputError: an array has the wrong shape, no point is finite, or the stamp is not in seconds.
            TransportError: the client is closed.
        """
        self._check_open()
        self._sender.put_cloud(self._sender.cloud(points, nanoseconds(stamp), times))

    def send_odometry(self, T_odom_body: Pose, stamp: float) -> None:
        """Publish one odometry sample: (4, 4) odometry <- body, metres, gravity aligned; ``stamp`` in seconds.

        Never waits. Up to 1024 samples queue for a congested link; then the oldest is dropped, which is logged.

        Raises:
            InputError: the matrix is not a rigid transform, or the stamp is not in seconds.
            TransportError: the client is closed.
        """
        self._check_open()
        self._sender.put_odometry(self._sender.odometry(T_odom_body, nanoseconds(stamp)))

    def poses(self, timeout: float | None = None) -> Received[PoseMessage]:
        """Iterate over poses as they arrive, oldest unread first, with ``for`` or ``async for``.

        Ends when the client is closed, or when no pose comes for ``timeout`` seconds (None: never). Several iterators
        share the poses: each pose is given once.
        """
        return Received(self._poses, timeout)

    def statuses(self, timeout: float | None = None) -> Received[dict[str, Any]]:
        """Iterate over the node's statuses as they arrive; as :meth:`poses`."""
        return Received(self._statuses, timeout)

    def wait_for_node(self, seconds: float) -> bool:
        """Wait until this robot's clouds have a subscriber (earlier samples are lost); False after ``seconds``.

        Raises:
            TransportError: the client is closed.
        """
        self._check_open()
        return self._transport.await_subscriber(self._sender.cloud_key, seconds)

    def relocalize(self, timeout: float = 5.0) -> dict[str, Any]:
        """Make the node forget the place and search the whole map again; return its reply.

        Raises:
            TransportError: no answer within ``timeout`` seconds, the node refused, or the client is closed.
        """
        self._check_open()
        return self._transport.query(self.keys.relocalize, timeout=timeout)

    def suggest(
        self,
        x: float,
        y: float,
        yaw: float | None = None,
        distance: float = 5.0,
        timeout: float = 5.0,
        map: str | None = None,
        within: float | None = None,
    ) -> dict[str, Any]:
        """Tell the node where the robot may be: one more place for its search to try, never trusted.

        Args:
            x: in the frame of the map's sources, metres.
            y: likewise.
            yaw: heading, radians, counter-clockwise from the map's x axis; None: any.
            distance: radius around x and y in which other places are tried as well, metres, at most 20.
            timeout: seconds.
            map: name of the map in whose frame x and y are; needed only if the node has several maps.
            within: radius around x and y, metres, at least 50; nothing outside is searched until the place is known.
                The search trusts this circle; it adds a quarter to the radius, and more with the distance driven.

        Returns:
            The reply; ``taken`` is False if the guess is refused, and ``note`` says why: the place is known, or the
            map has no ground there.

        Raises:
            TransportError: no answer within ``timeout`` seconds, the node refused, or the client is closed.
            InputError: a value is not a number or out of range.
        """
        from coview_stream.stream.node.last_place import guess_of_fields  # few clients need it

        self._check_open()
        given = {"x": x, "y": y, "yaw": yaw, "distance": distance, "map": map, "within": within}
        guess_of_fields(given)
        parameters = {k: str(v) if k == "map" else repr(float(v)) for k, v in given.items() if v is not None}
        return self._transport.query(self.keys.suggest, parameters, timeout)

    def reset(self, timeout: float = 5.0) -> dict[str, Any]:
        """Make the node forget all that it knows about this robot; return its reply. Errors as :meth:`relocalize`."""
        self._check_open()
        return self._transport.query(self.keys.reset, timeout=timeout)

    def close(self) -> None:
        """Undeclare, end all iterators and close the session unless the caller owns it; idempotent.

        Takes up to three seconds on a congested link.
        """
        self._poses.close()
        self._statuses.close()
        if self._owned and not self._closed:
            self._sender.settle()
        self._closed = True
        self._sender.close()
        if self._owned:
            self._transport.close()

    def __enter__(self) -> RobotClient:
        return self

    async def __aenter__(self) -> RobotClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        import asyncio

        await asyncio.to_thread(self.close)

    def __repr__(self) -> str:
        """Return the robot, its key and the state that the node reports, in one line."""
        status = self.latest_status
        state = "no status yet" if status is None else f"state {str(status.get('state'))[:20]}"
        return f"RobotClient({self.robot!r}, sends on {self._sender.cloud_key}, {'closed' if self._closed else state})"

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_open(self) -> None:
        if self._closed:
            raise TransportError(f"the client of robot {self.robot!r} is closed: open another one")

    def _on_pose(self, sample: Sample) -> None:
        try:
            pose = decode_pose(sample, hint=self.keys.hint)
        except MessageError as error:
            self._reject(sample, error)
            return
        pose = pose if pose.robot else replace(pose, robot=self.robot)
        self._latest_pose = monotonic(), pose
        self._poses.put(pose)

    def _on_status(self, sample: Sample) -> None:
        try:
            status = read_status(sample)
        except MessageError as error:
            self._reject(sample, error)
            return
        self.latest_status = status
        if not _valid(self.latest_status):
            self._latest_pose = None  # a later TRACKING does not make the old pose valid again
        self._statuses.put(status)

    def _reject(self, sample: Sample, error: MessageError) -> None:
        self.malformed += 1
        if self.malformed == 1:  # once: a wrong sender is wrong at every message
            _log.warning("%s: %s", sample.key, error)


def _valid(status: dict[str, Any] | None) -> bool:
    """Whether poses are valid under a status; True without one, as access rules may withhold statuses."""
    return status is None or status.get("state", "TRACKING") == "TRACKING"
