"""A robot that sends nothing but clouds: its odometry is made of them here, and then taken in as if it had sent it."""

# FOLDED coview_stream/stream/node/lidar_session.py: """Frames that odometry is to be made of: in the order of their stamps, and never many at once."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from coview_stream.config.node import NodeConfig
from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.messages.types import CloudMessage, OdometryMessage
from coview_stream.odometry.buffer import OdometryBuffer, SampleKind
from coview_stream.stream.node.counters import Counters
from coview_stream.stream.node.decoding import last_line
from coview_stream.stream.node.jobs import OdometryJob, OdometryResult
from coview_stream.stream.node.session import Session
from coview_stream.stream.transport.keys import RobotKeys


class LidarSession(Session):
    """A session whose frames go through lidar odometry before they are paired with it.

    Whenever lidar odometry begins anew, the robot does: what it drove in between is not known.
    """

    odometry_source = "kiss-icp"

    def __init__(
        self,
        keys: RobotKeys,
        map_sha256: str,
        config: NodeConfig | None = None,
        options: tuple[str | None, str | None] = (None, None),
        lidar: LidarOdometryConfig | None = None,
    ) -> None:
        """As of a :class:`Session`; ``lidar`` says how odometry is made."""
        self.lidar = lidar or LidarOdometryConfig()
        self._generation = 0
        super().__init__(keys, map_sha256, config, options)

    def _clear(self) -> None:
        super()._clear()
        self._generation += 1
        self._first_generation = self._generation  # what was under way before is nobody's
        self._sweeps = LidarFrameQueue(self.keys.robot, self.config, self.lidar, self.counters)
        self._seen = float("-inf")  # local time of the newest readable cloud

    def _take_in(self, message: CloudMessage, now: float) -> None:
        """Have a cloud's odometry made first."""
        self._seen = now
        if self._sweeps.put(message, now) is SampleKind.RESTART:
            self.counters.clock_restarts += 1
            self._odometry_anew("the sender's clock started anew")

    def take_sweep(self) -> OdometryJob | None:
        """Hand out a frame to make odometry of; its result or failure must be reported before the next one."""
        with self._lock:
            return self._sweeps.take(self._generation)

    def sweep_done(self, job: OdometryJob, result: OdometryResult, now: float) -> None:
        """Take in the odometry of a frame, and the frame."""
        with self._lock:
            if job.generation < self._first_generation:
                return
            sweep = self._sweeps.over()
            if sweep is None or job.generation != self._generation:
                self.counters.dropped += 1
                return
            if result.begun and self.odometry.newest is not None:
                self.odometry.clear()
                self.begin_anew("lidar odometry began anew")
            made = OdometryMessage(job.stamp_ns, result.T_odom_body)
            self.counters.odometry_received += 1
            self._continue(self.odometry.add(made, now), made)
            self._pairing.add(_placed(sweep.message, result), sweep.received)
            self._pair(now)

    def sweep_failed(self, job: OdometryJob, reason: str, rejected: bool) -> None:
        """Take note that no odometry could be made of a frame; if not ``rejected``, the robot's has been forgotten."""
        with self._lock:
            if job.generation < self._first_generation:
                return
            self._sweeps.over()
            self.counters.count("rejected" if rejected else "engine_errors")
            kind = (
                "frames that lidar odometry cannot place"
                if rejected
                else "frames that lidar odometry failed at"
            )
            self.complaints.add_first(f"{self.keys.robot}: {kind}", last_line(reason))
            if not rejected and job.generation == self._generation:
                self._odometry_anew("lidar odometry failed on a frame")

    def engine_restarted(self, kind: str = "track", why: str = "it died") -> None:
        """As of a session; that of ``odometry`` knew where odometry had come to."""
        with self._lock:
            super().engine_restarted(kind, why)
            if kind == "odometry":
                self._odometry_anew(f"lidar odometry was started again: {why}")

    def _odometry_anew(self, reason: str) -> None:
        self._generation += 1
        self.odometry.clear()
        self.begin_anew(reason)

    def _silence(self, now: float) -> str:
        timeout = self.config.odometry_timeout
        if now - self._seen > timeout:
            return f"no clouds for {timeout:g} s"
        return f"lidar odometry has placed no frame for {timeout:g} s; see errors and counters"


def _placed(message: CloudMessage, result: OdometryResult) -> CloudMessage:
    """Return the frame as odometry left it: with nothing to be deskewed any more."""
    points = message.points if result.points is None else result.points
    return replace(message, points=points, times=None, rings=None)


_WAITING = 2  # frames at most: odometry wants every one, and yet none that is old


@dataclass(frozen=True)
class LidarFrame:
    """A frame and the local time at which it came, seconds."""

    message: CloudMessage
    received: float


class LidarFrameQueue:
    """Keeps a robot's newest frames until their turn, one of which is under way; counts those that end here.

    What a stamp is to those before it is asked of an :class:`OdometryBuffer`: the same strays, pauses and clocks that
    start anew, only that nothing is known of the motion yet.
    """

    def __init__(
        self, robot: str, config: NodeConfig, lidar: LidarOdometryConfig, counters: Counters
    ) -> None:
        self.robot = robot
        self.config = config
        self.lidar = lidar
        self.counters = counters
        self._stamps = OdometryBuffer(config)
        self._waiting: deque[LidarFrame] = deque()
        self._busy: LidarFrame | None = None

    def put(self, message: CloudMessage, now: float) -> SampleKind:
        """Take in a frame that came at local time ``now``, and say what it was to those before it."""
        intake = self._stamps.add(OdometryMessage(message.stamp_ns, np.eye(4)), now)
        if intake is SampleKind.DUPLICATE:
            self.counters.duplicate += 1
        elif intake is SampleKind.OUT_OF_ORDER:
            self.counters.out_of_order += 1
        else:
            if intake is SampleKind.RESTART:
                self.counters.dropped += len(self._waiting)
                self._waiting.clear()
            elif len(self._waiting) == _WAITING:
                self.counters.dropped += 1
                self._waiting.popleft()
            self._waiting.append(LidarFrame(message, now))
        return intake

    def take(self, generation: int) -> OdometryJob | None:
        """Hand out the oldest frame; None while one is under way."""
        if self._busy is not None or not self._waiting:
            return None
        self._busy = self._waiting.popleft()
        message = self._busy.message
        times = message.times if self.config.deskew else None
        return OdometryJob(self.robot, generation, message.stamp_ns, message.points, times, self.lidar)

    def over(self) -> LidarFrame | None:
        """Return what was under way."""
        busy, self._busy = self._busy, None
        return busy
