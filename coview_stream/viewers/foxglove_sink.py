"""Sink for Foxglove: a WebSocket server, an MCAP recording, or both, with the same messages (``foxglove-sdk``)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from coview_stream.basemap.summary import MapView
from coview_stream.clouds.files import read_cloud
from coview_stream.clouds.trajectory import read_tum
from coview_stream.config.mount import Mount
from coview_stream.errors import ConfigError, InputError, require_library
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, inverse, pose_to_tum, rot_z, transform
from coview_stream.messages.types import HypothesesMessage, PoseMessage
from coview_stream.recordings.open_run import open_run
from coview_stream.viewers.scene import Scan, Sink

_NS = 1_000_000_000
_FRAME = "map"
"""Frame of all that is drawn: the map's axes at its origin, because viewers draw in float32."""
_SOURCE = "map_source"
"""Frame of the map's sources (UTM, for example), the parent of ``map``."""
_SIGMAS = 3.0  # of the covariance ellipsoid
_COLOURS = {"TRACKING": (0.1, 0.7, 0.3), "AMBIGUOUS": (0.9, 0.6, 0.0), "LOST": (0.85, 0.15, 0.15)}
_GREY = (0.4, 0.5, 0.7)


class FoxgloveSink(Sink):
    """Foxglove messages for a map and its robots.

    Topics: ``/map``, ``/tf``, and for each robot ``/robots/NAME/`` ``pose``, ``scene`` (covariance), ``scan``,
    ``hypotheses``, ``status`` (the node's JSON) and ``state`` (changes, as a log).

    Args:
        by_stamp: log messages at their own stamps, as for recorded runs; otherwise at the current time.

    Raises:
        DependencyError: foxglove-sdk is missing.
    """

    def __init__(self, by_stamp: bool = False) -> None:
        self._sdk = require_library("foxglove", "foxglove-sdk>=0.20", "Foxglove")
        self._messages = require_library("foxglove.messages", "foxglove-sdk>=0.20", "Foxglove")
        self._kinds = require_library("foxglove.channels", "foxglove-sdk>=0.20", "Foxglove")
        self._context = self._sdk.Context()
        self._channels: dict[str, Any] = {}
        self._closing: list[Callable[[], object]] = []
        self._recording: Path | None = None
        self._by_stamp = by_stamp
        self._newest_ns = 0
        self._origin: Floats = np.zeros(3)
        self._map: MapView | None = None
        self._states: dict[str, str] = {}

    def serve(self, host: str, port: int) -> int:
        """Open a WebSocket server and return its port; ConfigError if the address cannot be bound."""
        sink = self

        class Greeter(self._sdk.ServerListener):  # type: ignore[misc, name-defined]  # the SDK is optional
            """Sends the map to each client that connects later: the server keeps no messages."""

            def on_subscribe(self, client: Any, channel: Any) -> None:
                if channel.topic == "/map" and sink._map is not None:
                    sink._log_map(sink._map)

        try:
            server = self._sdk.start_server(
                name="coview_stream", host=host, port=port, context=self._context, server_listener=Greeter()
            )
        except Exception as error:  # RuntimeError or OSError, depending on the version
            raise ConfigError(
                f"--foxglove {host}:{port}: cannot be listened on ({error}); name another port"
            ) from error
        self._closing.append(server.stop)
        return int(server.port)

    def record(self, path: Path) -> None:
        """Record into an MCAP file from now on; :meth:`close` completes it, or removes it if nothing came.

        Raises:
            InputError: it exists already, or cannot be written.
        """
        if path.exists():
            raise InputError(f"{path}: is there already; name another file")
        try:
            writer = self._sdk.open_mcap(path, context=self._context)
        except Exception as error:
            raise InputError(f"{path}: cannot be written ({error}); check the directory") from error
        self._closing.append(writer.close)
        self._recording = path

    def map(self, view: MapView) -> None:
        """Draw the map."""
        self._map, self._origin = view, view.origin
        self._log_map(view)

    def _log_map(self, view: MapView) -> None:
        self._log("/map", "PointCloud", self._cloud(view.points, 0, view.is_ground.astype(np.float32)))
        place, turn = self._vector(self._origin), self._messages.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
        frames = {"parent_frame_id": _SOURCE, "child_frame_id": _FRAME}
        origin = self._messages.FrameTransform(translation=place, rotation=turn, **frames)
        self._log("/tf", "FrameTransforms", self._messages.FrameTransforms(transforms=[origin]))

    def pose(self, pose: PoseMessage) -> None:
        """Draw a pose and its uncertainty."""
        m, stamp, name = self._messages, self._stamp(pose.stamp_ns), pose.robot
        T = pose.T_map_body
        place, (position, turn) = self._pose(T), self._parts(T)
        frames = {"parent_frame_id": _FRAME, "child_frame_id": f"{name}/base_link"}
        at = m.FrameTransform(timestamp=stamp, translation=position, rotation=turn, **frames)
        self._log("/tf", "FrameTransforms", m.FrameTransforms(transforms=[at]), pose.stamp_ns)
        self._log(f"/robots/{name}/pose", "PoseInFrame", m.PoseInFrame(timestamp=stamp, frame_id=_FRAME, pose=place))
        spread = pose.covariance[:3, :3]
        if np.isfinite(spread).all():
            sigmas, axes = np.linalg.eigh(spread)
            axes[:, 0] *= np.sign(np.linalg.det(axes))
            turned = np.eye(4)
            turned[:3, :3], turned[:3, 3] = axes, T[:3, 3]
            size = 2.0 * _SIGMAS * np.sqrt(np.maximum(sigmas, 1e-6))
            red, green, blue = _COLOURS.get(self._states.get(name, "TRACKING"), _GREY)
            colour = m.Color(r=red, g=green, b=blue, a=0.4)
            ball = m.SpherePrimitive(pose=self._pose(turned), size=self._vector(size), color=colour)
            entity = m.SceneEntity(timestamp=stamp, frame_id=_FRAME, id=name, spheres=[ball])
            self._log(f"/robots/{name}/scene", "SceneUpdate", m.SceneUpdate(entities=[entity]))

    def status(self, robot: str, status: dict[str, Any]) -> None:
        """Pass on a status, and log a change of state."""
        topic = f"/robots/{robot}/status"
        if topic not in self._channels:
            self._channels[topic] = self._sdk.Channel(topic, message_encoding="json", context=self._context)
        self._channels[topic].log(status, log_time=self._newest_ns if self._by_stamp else None)
        state, reason = str(status.get("state"))[:40], str(status.get("reason"))[:500]
        if self._states.get(robot) != state:
            self._states[robot] = state
            level = self._messages.LogLevel.Info if state == "TRACKING" else self._messages.LogLevel.Warning
            line = self._messages.Log(level=level, name=robot, message=f"{state}: {reason}")
            self._log(f"/robots/{robot}/state", "Log", line)

    def hypotheses(self, hypotheses: HypothesesMessage) -> None:
        """Draw the places that a search considers."""
        poses = []
        for x, y, z, yaw, *_ in hypotheses.places.tolist():
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = rot_z(yaw), (x, y, z)
            poses.append(self._pose(T))
        message = self._messages.PosesInFrame(timestamp=self._stamp(hypotheses.stamp_ns), frame_id=_FRAME, poses=poses)
        self._log(f"/robots/{hypotheses.robot}/hypotheses", "PosesInFrame", message, hypotheses.stamp_ns)

    def scan(self, scan: Scan) -> None:
        """Draw a scan if its pose is known."""
        if scan.T_map_body is None:
            return
        T = scan.T_map_body.copy()
        T[:3, 3] -= self._origin
        points = transform(T, scan.points.astype(np.float64)).astype(np.float32)
        cloud = self._cloud(points, scan.stamp_ns, points[:, 2])
        self._log(f"/robots/{scan.robot}/scan", "PointCloud", cloud, scan.stamp_ns)

    def close(self) -> None:
        """End the server and complete the recording."""
        for close in self._closing:
            close()
        self._closing.clear()
        if self._recording is not None and not self._channels:
            self._recording.unlink(missing_ok=True)
        self._recording = None

    def _log(self, topic: str, kind: str, message: Any, stamp_ns: int | None = None) -> None:
        if stamp_ns is not None:
            self._newest_ns = stamp_ns
        if topic not in self._channels:
            self._channels[topic] = getattr(self._kinds, f"{kind}Channel")(topic, context=self._context)
        self._channels[topic].log(message, log_time=self._newest_ns if self._by_stamp else None)

    def _cloud(self, points: Points, stamp_ns: int, value: Floats | Any) -> Any:
        m = self._messages
        rows = np.column_stack([points, np.asarray(value, dtype=np.float32)]).astype("<f4")
        number = m.PackedElementFieldNumericType.Float32
        fields = [
            m.PackedElementField(name=n, offset=4 * k, type=number) for k, n in enumerate(("x", "y", "z", "value"))
        ]
        here = m.Pose(position=self._vector(np.zeros(3)), orientation=m.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0))
        layout = {"point_stride": 16, "fields": fields, "data": rows.tobytes()}
        return m.PointCloud(timestamp=self._stamp(stamp_ns), frame_id=_FRAME, pose=here, **layout)

    def _pose(self, T: Pose) -> Any:
        position, turn = self._parts(T)
        return self._messages.Pose(position=position, orientation=turn)

    def _parts(self, T: Pose) -> tuple[Any, Any]:
        x, y, z, qx, qy, qz, qw = pose_to_tum(T).tolist()
        position = self._vector(np.array([x, y, z]) - self._origin)
        return position, self._messages.Quaternion(x=qx, y=qy, z=qz, w=qw)

    def _vector(self, values: Floats) -> Any:
        x, y, z = np.asarray(values, dtype=np.float64).tolist()
        return self._messages.Vector3(x=x, y=y, z=z)

    def _stamp(self, stamp_ns: int) -> Any:
        seconds, rest = divmod(max(0, int(stamp_ns)), _NS)
        return self._messages.Timestamp(seconds, rest)


def record_world(world: Path, out: Path, mount: Mount | None = None) -> int:
    """Write a simulated world as ``out`` (MCAP, Foxglove's schemas), at the run's stamps.

    ``/robots/truth`` has the true poses and each scan in the map's frame; ``/robots/odometry`` starts at the
    first true pose and follows odometry. ``mount`` is the lidar's pose on the body.

    Returns:
        Number of frames.

    Raises:
        InputError: ``out`` exists already or cannot be written.
        DependencyError: foxglove-sdk is missing.
    """
    sink = FoxgloveSink(by_stamp=True)
    sink.record(out)
    try:
        survey = read_cloud(world / "base.laz")
        sink.map(MapView.of_cloud(survey.points, survey.origin))
        run = open_run(world / "run", mount=mount)
        _, truth = read_tum(world / "truth.tum")
        T_map_odom = truth[0] @ inverse(run.poses[0])
        for frame, T_map_body in zip(run, truth, strict=True):
            stamp_ns = round(frame.stamp * 1e9)
            sink.pose(_pose("truth", stamp_ns, T_map_body))
            sink.pose(_pose("odometry", stamp_ns, T_map_odom @ frame.T_odom_body))
            sink.scan(Scan("truth", stamp_ns, frame.points, T_map_body))
    finally:
        sink.close()
    return len(truth)


def _pose(robot: str, stamp_ns: int, T_map_body: Pose) -> PoseMessage:
    unknown = np.full((6, 6), np.nan)
    return PoseMessage(stamp_ns, robot, "TRACKING", T_map_body, unknown, np.nan, "")
