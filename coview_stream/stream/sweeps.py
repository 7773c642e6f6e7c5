"""Frames that odometry is to be made of: in the order of their stamps, and never many at once."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from coview_stream.odometry.config import LidarOdometryConfig
from coview_stream.stream.config import NodeConfig
from coview_stream.stream.counters import Counters
from coview_stream.stream.jobs import SweepJob
from coview_stream.stream.messages import CloudMessage, OdometryMessage
from coview_stream.stream.odometry import Intake, OdometryBuffer

_WAITING = 2  # frames at most: odometry wants every one, and yet none that is old


@dataclass(frozen=True)
class Sweep:
    """A frame and the local time at which it came, seconds."""

    message: CloudMessage
    received: float


class Sweeps:
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
        self._waiting: deque[Sweep] = deque()
        self._busy: Sweep | None = None

    def put(self, message: CloudMessage, now: float) -> Intake:
        """Take in a frame that came at local time ``now``, and say what it was to those before it."""
        intake = self._stamps.add(OdometryMessage(message.stamp_ns, np.eye(4)), now)
        if intake is Intake.DUPLICATE:
            self.counters.duplicate += 1
        elif intake is Intake.OUT_OF_ORDER:
            self.counters.out_of_order += 1
        else:
            if intake is Intake.RESTART:
                self.counters.dropped += len(self._waiting)
                self._waiting.clear()
            elif len(self._waiting) == _WAITING:
                self.counters.dropped += 1
                self._waiting.popleft()
            self._waiting.append(Sweep(message, now))
        return intake

    def take(self, generation: int) -> SweepJob | None:
        """Hand out the oldest frame; None while one is under way."""
        if self._busy is not None or not self._waiting:
            return None
        self._busy = self._waiting.popleft()
        message = self._busy.message
        times = message.times if self.config.deskew else None
        return SweepJob(self.robot, generation, message.stamp_ns, message.points, times, self.lidar)

    def over(self) -> Sweep | None:
        """Return what was under way."""
        busy, self._busy = self._busy, None
        return busy
