"""Session of a robot that sends nothing but clouds: its odometry is made of them here."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from coview_stream.basemap.map_parts import MapParts
from coview_stream.config.node import NodeConfig
from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.messages.types import CloudMessage, OdometryMessage
from coview_stream.odometry.buffer import OdometryBuffer, SampleKind
from coview_stream.stream.node.counters import Counters, last_line
from coview_stream.stream.node.jobs import Job, OdometryJob, OdometryResult, Result
from coview_stream.stream.node.session import Session
from coview_stream.stream.transport.keys import RobotKeys

_MAX_WAITING = 2  # frames: odometry wants every one, and yet none that is old; set by hand


class LidarSession(Session):
    """Session whose frames go through lidar odometry before they are paired with it.

    Whenever lidar odometry restarts, so does the search: what the robot drove in between is not known.
    """

    odometry_source = "kiss-icp"

    def __init__(
        self,
        keys: RobotKeys,
        map_sha256: str,
        config: NodeConfig | None = None,
        codecs: tuple[str | None, str | None] = (None, None),
        lidar: LidarOdometryConfig | None = None,
        parts: MapParts | None = None,
    ) -> None:
        """As of a :class:`Session`; ``lidar`` says how odometry is made."""
        self.lidar = lidar or LidarOdometryConfig()
        self._odometry_epoch = 0  # number of the lidar odometry, counted through all resets
        super().__init__(keys, map_sha256, config, codecs, parts)

    def _clear(self) -> None:
        super()._clear()
        self._odometry_epoch += 1
        self._first_odometry_epoch = self._odometry_epoch  # jobs from before a reset are ignored
        self._lidar_frames = LidarFrameQueue(self.keys.robot, self.config, self.lidar, self.counters)

    def _add_cloud(self, message: CloudMessage, now: float) -> None:
        """Queue a cloud for the odometry engine."""
        if self._lidar_frames.put(message, now) is SampleKind.RESTART:
            self.counters.clock_restarts += 1
            self._restart_odometry("the sender's clock started anew")

    def take_lidar_frame(self) -> OdometryJob | None:
        """Hand the oldest frame to the odometry engine."""
        with self._lock:
            return self._lidar_frames.take(self._odometry_epoch)

    def has_job(self, engine: str) -> bool:
        """As of a session."""
        return self._lidar_frames.has_frame if engine == "odometry" else super().has_job(engine)

    def handle_result(self, job: Job, result: Result, now: float) -> None:
        """As of a session; the odometry of a frame is added like odometry that was sent, and the frame after it."""
        if not (isinstance(job, OdometryJob) and isinstance(result, OdometryResult)):
            super().handle_result(job, result, now)
            return
        with self._lock:
            if job.epoch < self._first_odometry_epoch:
                return
            frame = self._lidar_frames.take_under_way()
            if frame is None or job.epoch != self._odometry_epoch:
                self.counters.dropped += 1
                return
            if result.restarted and self.odometry.newest is not None:
                self.odometry.clear()
                self.restart_search("lidar odometry began anew")
            self.counters.odometry_received += 1
            self._add_odometry(OdometryMessage(job.stamp_ns, result.T_odom_body), now)
            self._frame_sync.add(_deskewed(frame.message, result), frame.received)
            self._queue_paired(now)

    def handle_failure(self, job: Job, reason: str, rejected: bool = False) -> None:
        """As of a session."""
        if not isinstance(job, OdometryJob):
            super().handle_failure(job, reason, rejected)
            return
        with self._lock:
            if job.epoch < self._first_odometry_epoch:
                return
            self._lidar_frames.take_under_way()
            self.counters.count("rejected" if rejected else "engine_errors")
            how = "cannot place" if rejected else "failed at"
            self.errors.add_first(f"{self.keys.robot}: frames that lidar odometry {how}", last_line(reason))
            if not rejected and job.epoch == self._odometry_epoch:
                self._restart_odometry("lidar odometry failed on a frame")

    def engine_restarted(self, engine: str = "track", why: str = "it died") -> None:
        """As of a session; the engine of ``odometry`` knew where odometry had come to."""
        with self._lock:
            super().engine_restarted(engine, why)
            if engine == "odometry":
                self._restart_odometry(f"lidar odometry was started again: {why}")

    def _restart_odometry(self, reason: str) -> None:
        self._odometry_epoch += 1
        self.odometry.clear()
        self.restart_search(reason)

    def _silence_reason(self, now: float) -> str:
        timeout = self.config.odometry_timeout
        if now - self._cloud_at > timeout:
            return f"no clouds for {timeout:g} s"
        return f"lidar odometry has placed no frame for {timeout:g} s; see errors and counters"


def _deskewed(message: CloudMessage, result: OdometryResult) -> CloudMessage:
    """Return the frame as lidar odometry left it: with nothing to be deskewed any more."""
    points = message.points if result.points is None else result.points
    return replace(message, points=points, times=None, rings=None)


@dataclass(frozen=True)
class LidarFrame:
    """A frame for the odometry engine.

    Attributes:
        message: the frame.
        received: local time at which it came, seconds.
    """

    message: CloudMessage
    received: float


class LidarFrameQueue:
    """Frames for the odometry engine, in the order of their stamps; one is under way, and few wait.

    An :class:`OdometryBuffer` classifies their stamps: the same strays, pauses and restarted clocks, only that nothing
    is known of the motion yet. Frames that end here are counted.
    """

    def __init__(self, robot: str, config: NodeConfig, lidar: LidarOdometryConfig, counters: Counters) -> None:
        self.robot = robot
        self.config = config
        self.lidar = lidar
        self.counters = counters
        self._stamps = OdometryBuffer(config)
        self._waiting: deque[LidarFrame] = deque()
        self._under_way: LidarFrame | None = None

    def put(self, message: CloudMessage, now: float) -> SampleKind:
        """Take in a frame that came at local time ``now``, and return what it is to those before it."""
        kind = self._stamps.add(OdometryMessage(message.stamp_ns, np.eye(4)), now)
        if kind is SampleKind.DUPLICATE:
            self.counters.duplicate += 1
        elif kind is SampleKind.OUT_OF_ORDER:
            self.counters.out_of_order += 1
        else:
            if kind is SampleKind.RESTART:
                self.counters.dropped += len(self._waiting)
                self._waiting.clear()
            elif len(self._waiting) == _MAX_WAITING:
                self.counters.dropped += 1
                self._waiting.popleft()
            self._waiting.append(LidarFrame(message, now))
        return kind

    @property
    def has_frame(self) -> bool:
        """Whether a frame may be taken."""
        return self._under_way is None and len(self._waiting) > 0

    def take(self, epoch: int) -> OdometryJob | None:
        """Hand out the oldest frame; None while one is under way."""
        if not self.has_frame:
            return None
        self._under_way = self._waiting.popleft()
        message = self._under_way.message
        times = message.times if self.config.deskew else None
        return OdometryJob(self.robot, epoch, message.stamp_ns, message.points, times, self.lidar)

    def take_under_way(self) -> LidarFrame | None:
        """Return the frame under way, which has come back."""
        frame, self._under_way = self._under_way, None
        return frame
