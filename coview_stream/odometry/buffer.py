"""Buffer of a robot's odometry of the last seconds: continuity of the samples, and the pose at a frame's stamp."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from coview_stream.config.node import NodeConfig
from coview_stream.geometry.arrays import Ints
from coview_stream.geometry.transforms import Pose, Poses, interpolate, inverse, rotation_angle, yaw_of
from coview_stream.messages.types import OdometryMessage

_NS = 1_000_000_000

_MIN_RESTART_SAMPLES = 5  # successive samples before a clock counts as restarted
# limits of a plausible step, set by hand
_SLACK = 0.5  # metres: corrections by a lidar odometry, rough stamps
_SLACK_SPEED = 3.0  # metres per second, gain of speed that any robot may have
_SPEED_FACTOR = 3.0  # factor on the speed of the last seconds
_SPEED_WINDOW_NS = 2 * _NS  # of these last seconds
_MIN_SPEED_SPAN = 0.2  # seconds of samples that give a speed
_JUMP_ANGLE = np.radians(20.0)  # turn that is plausible in any time
_MAX_TURN_RATE = 20.0  # radians per second; a faster turn of more than _JUMP_ANGLE is a jump
_UNREACHABLE = 10.0  # seconds of outage that a lost connection explains


class SampleKind(StrEnum):
    """Relation of an odometry sample to the previous samples."""

    CONTINUES = "continues"
    GAP = "gap"
    """After a short pause: the pose has to be verified again."""
    OUTAGE = "outage"
    """After a long pause: the robot may have been carried anywhere."""
    JUMP = "jump"
    """Farther away than the robot can have driven: odometry has restarted."""
    RESTART = "restart"
    """The sender's clock has restarted."""
    DUPLICATE = "duplicate"
    OUT_OF_ORDER = "out_of_order"


class _Entry(NamedTuple):
    """A sample, with the buffer's metres driven and radians turned at it."""

    stamp_ns: int
    T_odom_body: Pose
    travelled: float
    turned: float


class Segment(NamedTuple):
    """Odometry around a frame."""

    stamps: Ints  # (K,) nanoseconds, increasing
    poses: Poses  # (K, 4, 4) odometry <- body, metres


class OdometryBuffer:
    """Buffer of the newest samples in order of their stamps (sensor time).

    Attributes:
        newest: the newest sample, None before the first.
        arrived: local time (seconds) of its arrival.
        travelled: metres driven since the first sample, or the last jump, restart or outage.
        turned: radians turned since then.
    """

    def __init__(self, config: NodeConfig) -> None:
        self.config = config
        self.clear()

    def clear(self) -> None:
        """Drop all samples."""
        self.newest: OdometryMessage | None = None
        self.arrived = float("-inf")
        self.travelled = self.turned = 0.0
        self._samples: deque[_Entry] = deque()
        self._discontinuous: deque[int] = deque(maxlen=_MIN_RESTART_SAMPLES)  # stamps
        self._discontinuous_since = float("inf")

    def continue_from(self, other: OdometryBuffer) -> None:
        """Copy another buffer's samples, to detect poses that do not continue them."""
        self.newest, self.arrived = other.newest, other.arrived
        self.travelled, self.turned = other.travelled, other.turned
        self._samples = other._samples.copy()
        self._discontinuous = other._discontinuous.copy()
        self._discontinuous_since = other._discontinuous_since

    def add(self, sample: OdometryMessage, now: float, unreachable: bool = False) -> SampleKind:
        """Add a sample and return its kind; duplicates and out-of-order samples are dropped.

        ``now`` is the local time of its arrival in seconds; ``unreachable`` if the connection was down since the last
        sample.
        """
        longest = _UNREACHABLE if unreachable else self.config.max_outage
        step = None if self.newest is None else inverse(self.newest.T_odom_body) @ sample.T_odom_body
        kind = self._classify(sample, step, now, longest)
        if kind in (SampleKind.DUPLICATE, SampleKind.OUT_OF_ORDER):
            return kind
        if kind in (SampleKind.JUMP, SampleKind.RESTART, SampleKind.OUTAGE):
            self.clear()
        elif step is not None:
            self.travelled += _distance(step)
            self.turned += abs(yaw_of(step))  # as in the engine
        self.newest, self.arrived = sample, now
        self._samples.append(_Entry(sample.stamp_ns, sample.T_odom_body, self.travelled, self.turned))
        self._discontinuous.clear()
        self._discontinuous_since = float("inf")
        oldest = sample.stamp_ns - round(self.config.odometry_history * _NS)
        while self._samples[0].stamp_ns < oldest:
            self._samples.popleft()
        return kind

    def _classify(self, sample: OdometryMessage, step: Pose | None, now: float, longest: float) -> SampleKind:
        last = self.newest
        if last is None or step is None:
            return SampleKind.CONTINUES
        if sample.stamp_ns == last.stamp_ns:
            return SampleKind.DUPLICATE
        seconds = (sample.stamp_ns - last.stamp_ns) / _NS
        # a single stray stamp must not exclude all later ones, so one far ahead needs confirmation, too
        ahead = seconds > self.config.odometry_history + 2.0 * (now - self.arrived)
        if seconds < 0 or ahead:
            if not self._is_new_sequence(sample.stamp_ns, now):
                return SampleKind.OUT_OF_ORDER
            return SampleKind.RESTART if seconds < 0 else SampleKind.OUTAGE
        if seconds > longest:
            return SampleKind.OUTAGE
        max_distance = _SLACK + min(self.config.max_speed, self._max_plausible_speed()) * seconds
        max_angle = max(_JUMP_ANGLE, _MAX_TURN_RATE * seconds)
        if _distance(step) > max_distance or rotation_angle(step) > max_angle:
            return SampleKind.JUMP
        return SampleKind.GAP if seconds > self.config.odometry_timeout else SampleKind.CONTINUES

    def _is_new_sequence(self, stamp_ns: int, now: float) -> bool:
        """Return whether the samples that do not continue the buffer have continued each other for long enough."""
        if self._discontinuous and stamp_ns <= self._discontinuous[-1]:
            self._discontinuous.clear()
        if not self._discontinuous:
            self._discontinuous_since = now
        self._discontinuous.append(stamp_ns)
        return (
            len(self._discontinuous) == _MIN_RESTART_SAMPLES
            and now - self._discontinuous_since >= self.config.restart_after
        )

    def _max_plausible_speed(self) -> float:
        """Return a limit on the robot's speed, metres per second, by its last seconds; infinite while unknown."""
        newest = self._samples[-1]
        first = self._samples[bisect_left(self._samples, newest.stamp_ns - _SPEED_WINDOW_NS, key=lambda s: s.stamp_ns)]
        seconds = (newest.stamp_ns - first.stamp_ns) / _NS
        if seconds < _MIN_SPEED_SPAN:
            return float("inf")
        return _SLACK_SPEED + _SPEED_FACTOR * (newest.travelled - first.travelled) / seconds

    def covers(self, stamp_ns: int) -> int:
        """Return -1 if the buffer starts after ``stamp_ns``, 1 if it ends before, 0 if the stamp lies within."""
        if self.newest is None or stamp_ns > self.newest.stamp_ns:
            return 1
        return -1 if stamp_ns < self._samples[0].stamp_ns else 0

    def at(self, stamp_ns: int) -> Pose | None:
        """Interpolate the pose (4, 4) odometry <- body at a stamp; None outside of the buffer or in a gap."""
        if self.covers(stamp_ns) != 0:
            return None
        k = bisect_left(self._samples, stamp_ns, key=lambda s: s.stamp_ns)
        after = self._samples[k]
        if after.stamp_ns == stamp_ns:
            return after.T_odom_body
        before = self._samples[k - 1]
        if after.stamp_ns - before.stamp_ns > self.config.max_gap * _NS:
            return None
        share = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
        return interpolate(before.T_odom_body, after.T_odom_body, share)

    def driven_since(self, stamp_ns: int) -> tuple[float, float]:
        """Return metres driven and radians turned since a stamp, or since the oldest sample in the buffer."""
        if not self._samples:
            return 0.0, 0.0
        k = max(0, bisect_left(self._samples, stamp_ns + 1, key=lambda s: s.stamp_ns) - 1)
        return self.travelled - self._samples[k].travelled, self.turned - self._samples[k].turned

    def around(self, begin_ns: int, end_ns: int) -> Segment:
        """Return the samples from the last one before ``begin_ns`` to the first one after ``end_ns``."""
        stamps = [s.stamp_ns for s in self._samples]
        first = max(0, bisect_left(stamps, begin_ns + 1) - 1)
        last = min(len(stamps), bisect_left(stamps, end_ns) + 1)
        poses = [self._samples[k].T_odom_body for k in range(first, last)]
        return Segment(np.array(stamps[first:last], dtype=np.int64), np.array(poses).reshape(-1, 4, 4))


def _distance(step: Pose) -> float:
    """Length of a step, metres; for one vector NumPy takes ten times as long, and yields to other threads."""
    return math.hypot(*step[:3, 3].tolist())
