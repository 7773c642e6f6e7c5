"""Lidar frames paired with the odometry at their stamps, which may come after them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from coview_stream.config.node import NodeConfig
from coview_stream.geometry.transforms import Pose
from coview_stream.messages.types import CloudMessage
from coview_stream.odometry.buffer import OdometryBuffer, Segment
from coview_stream.stream.node.counters import Counters

_NS = 1_000_000_000
_MAX_WAITING = 8  # frames; set by hand
_END_WAIT = 0.15  # seconds that a frame waits for odometry up to its last point; set by hand


@dataclass(frozen=True)
class _Frame:
    message: CloudMessage
    received: float


@dataclass(frozen=True)
class PairedFrame:
    """A lidar frame with its odometry.

    Attributes:
        message: the frame.
        received: local time at which it came, seconds.
        T_odom_body: (4, 4) odometry at its stamp.
        segment: odometry while it was measured; None if it is not to be deskewed.
    """

    message: CloudMessage
    received: float
    T_odom_body: Pose
    segment: Segment | None


class FrameSync:
    """Keeps frames in the order of their stamps until odometry covers them; counts those that end here."""

    def __init__(self, config: NodeConfig, odometry: OdometryBuffer, counters: Counters) -> None:
        self.config = config
        self.odometry = odometry
        self.counters = counters
        self._waiting: list[_Frame] = []
        self._passed_ns: int | None = None  # stamp of the newest frame that went on

    def __len__(self) -> int:
        """Return how many frames wait."""
        return len(self._waiting)

    def add(self, message: CloudMessage, now: float) -> None:
        """Take in a frame that came at local time ``now``."""
        if message.stamp_ns == self._passed_ns or any(f.message.stamp_ns == message.stamp_ns for f in self._waiting):
            self.counters.duplicate += 1
        elif self._passed_ns is not None and message.stamp_ns < self._passed_ns:
            self.counters.out_of_order += 1
        else:
            self._waiting.append(_Frame(message, now))
            self._waiting.sort(key=lambda f: f.message.stamp_ns)
            if len(self._waiting) > _MAX_WAITING:
                # the one that came first, not the oldest stamp: a stray stamp must not stay for ever
                self._waiting.remove(min(self._waiting, key=lambda f: f.received))
                self.counters.dropped += 1

    def take_paired(self, now: float) -> Iterator[PairedFrame]:
        """Hand out the frames that have their odometry, oldest first; count those for which none came in time."""
        for frame in list(self._waiting):
            where = self.odometry.covers(frame.message.stamp_ns)
            waited = now - frame.received
            if where > 0 and waited < self.config.pairing_wait:
                return
            unfinished = waited < _END_WAIT and self.odometry.covers(self._span(frame.message)[1]) > 0
            if where == 0 and unfinished:
                return
            self._waiting.remove(frame)
            pose = self.odometry.at(frame.message.stamp_ns) if where == 0 else None
            if pose is None:
                self.counters.count("late" if where < 0 else "no_odometry")
                continue
            self._passed_ns = frame.message.stamp_ns
            deskewed = self.config.deskew and frame.message.times is not None
            segment = self.odometry.around(*self._span(frame.message)) if deskewed else None
            yield PairedFrame(frame.message, frame.received, pose, segment)

    def _span(self, message: CloudMessage) -> tuple[int, int]:
        """First and last stamp (ns) at which the frame's points were measured."""
        if message.times is None or not self.config.deskew or not len(message.times):
            return message.stamp_ns, message.stamp_ns
        times = np.nan_to_num(message.times, nan=0.0)
        first, last = min(0.0, float(times.min())), max(0.0, float(times.max()))
        return message.stamp_ns + round(first * _NS), message.stamp_ns + round(last * _NS)
