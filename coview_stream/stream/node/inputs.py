"""Inputs of one robot: clouds and odometry, decoded and paired by their stamps.

If a robot sends no odometry, it is computed from the clouds (:class:`LidarInputs`). Pure logic, like the session, which
holds the lock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from coview_stream.config.mount import Mount
from coview_stream.config.node import NodeConfig
from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.errors import EncodingError, MessageError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose
from coview_stream.messages import decode_cloud, decode_odometry
from coview_stream.messages.types import CloudMessage, OdometryMessage, Sample
from coview_stream.messages.validation import RefusedError
from coview_stream.odometry.buffer import OdometryBuffer, SampleKind, Segment
from coview_stream.stream.node.counters import Counters, ErrorLog, MissingFrames, counter_of, last_line
from coview_stream.stream.transport.keys import RobotKeys

_NS = 1_000_000_000
_NEVER = float("-inf")
_RESTARTED_NS = 5 * _NS  # a stamp farther back than this means a restarted clock
_COMES = {"clouds": "come", "odometry": "comes"}
_MAX_WAITING = 8  # frames that wait for odometry
_MAX_LIDAR_WAITING = 2  # frames that wait for the odometry engine: it needs every frame, but no old ones
_END_WAIT = 0.15  # seconds that a frame waits for odometry up to its last point

_COUNTED_AS = {
    SampleKind.GAP: "odometry_gaps",
    SampleKind.OUTAGE: "odometry_gaps",
    SampleKind.JUMP: "odometry_jumps",
    SampleKind.RESTART: "clock_restarts",
    SampleKind.DUPLICATE: "odometry_duplicate",
    SampleKind.OUT_OF_ORDER: "odometry_out_of_order",
}
_BREAKS = {
    SampleKind.GAP: "odometry paused",
    SampleKind.OUTAGE: "odometry was away for too long",
    SampleKind.JUMP: "odometry jumped",
    SampleKind.RESTART: "the sender's clock started anew",
}


class Break(NamedTuple):
    """Interruption of odometry: frames from before and after must not be searched for as one place."""

    reason: str  # one clause for people
    # first stamp after a short pause, from which a known place need only be verified; None: the place is searched for
    verify_from_ns: int | None = None


@dataclass(frozen=True)
class OdometryJob:
    """One lidar frame for the odometry engine."""

    robot: str  # name
    epoch: int  # id of its lidar odometry; a new one makes the engine restart it
    stamp_ns: int  # sensor time, nanoseconds
    points: Points  # (N, 3) float32 body frame, metres
    times: Floats | None  # (N,) seconds after the stamp at which each point was measured; None: no deskewing
    config: LidarOdometryConfig  # of its lidar odometry


@dataclass(frozen=True)
class OdometryResult:
    """Lidar odometry at a frame."""

    T_odom_body: Pose  # (4, 4) odometry at its stamp
    points: Points | None  # (N, 3) deskewed; None if the job had no times
    restarted: bool  # the pose is not connected to earlier ones
    seconds: float  # of the engine's work


class ReceivedFrame(NamedTuple):
    """A lidar frame and its local arrival time, seconds."""

    message: CloudMessage
    received: float


@dataclass(frozen=True)
class PairedFrame:
    """A lidar frame with its odometry."""

    message: CloudMessage  # the frame
    received: float  # local arrival time, seconds
    T_odom_body: Pose  # (4, 4) odometry at its stamp
    segment: Segment | None  # odometry while the frame was measured; None: no deskewing
    travelled: float  # metres driven by odometry at its stamp
    turned: float  # radians turned by odometry at its stamp


class FrameSync:
    """Holds frames in order of their stamps until odometry covers them; counts the frames that it drops."""

    def __init__(self, config: NodeConfig, odometry: OdometryBuffer, counters: Counters) -> None:
        self.config = config
        self.odometry = odometry
        self.counters = counters
        self._waiting: list[ReceivedFrame] = []
        self._passed_ns: int | None = None  # stamp of the newest frame handed out

    def __len__(self) -> int:
        """Return the number of waiting frames."""
        return len(self._waiting)

    def add(self, message: CloudMessage, now: float) -> None:
        """Add a frame that arrived at local time ``now``."""
        stamp_ns = message.stamp_ns
        if stamp_ns == self._passed_ns or any(f.message.stamp_ns == stamp_ns for f in self._waiting):
            self.counters.duplicate += 1
        elif self._passed_ns is not None and stamp_ns < self._passed_ns:
            self.counters.out_of_order += 1
        else:
            self._waiting.append(ReceivedFrame(message, now))
            self._waiting.sort(key=lambda f: f.message.stamp_ns)
            if len(self._waiting) > _MAX_WAITING:
                # by arrival, not by stamp: a stray stamp must not stay for ever
                self._waiting.remove(min(self._waiting, key=lambda f: f.received))
                self.counters.dropped += 1

    def take_paired(self, now: float) -> Iterator[PairedFrame]:
        """Hand out the frames with odometry, oldest first; count those for which none came in time."""
        for frame in list(self._waiting):
            message, waited = frame.message, now - frame.received
            where = self.odometry.covers(message.stamp_ns)
            if where > 0 and waited < self.config.pairing_wait:
                return
            if where == 0 and waited < _END_WAIT and self.odometry.covers(self._span(message)[1]) > 0:
                return
            self._waiting.remove(frame)
            pose = self.odometry.at(message.stamp_ns) if where == 0 else None
            if pose is None:
                self.counters.count("late" if where < 0 else "no_odometry")
                continue
            self._passed_ns = message.stamp_ns
            deskewed = self.config.deskew and message.times is not None
            segment = self.odometry.around(*self._span(message)) if deskewed else None
            driven, turned = self.odometry.driven_since(message.stamp_ns)  # the frame may have waited
            travelled = self.odometry.travelled - driven
            yield PairedFrame(message, frame.received, pose, segment, travelled, self.odometry.turned - turned)

    def _span(self, message: CloudMessage) -> tuple[int, int]:
        """First and last stamp, nanoseconds, at which the frame's points were measured."""
        if message.times is None or not self.config.deskew:
            return message.stamp_ns, message.stamp_ns
        times = np.nan_to_num(message.times, nan=0.0)
        first, last = float(times.min(initial=0.0)), float(times.max(initial=0.0))
        return message.stamp_ns + round(first * _NS), message.stamp_ns + round(last * _NS)


class NewestStamp:
    """The newest stamp of an input; ``came_at`` is the local time of the newest message, whatever its stamp."""

    def __init__(self) -> None:
        self.came_at = self._later_at = _NEVER  # _later_at: of the newest message with a later stamp
        self._stamp_ns: int | None = None

    def add(self, stamp_ns: int, now: float) -> None:
        """Add a message that arrived at local time ``now``."""
        self.came_at = now
        if self._stamp_ns is None or stamp_ns > self._stamp_ns or stamp_ns < self._stamp_ns - _RESTARTED_NS:
            self._stamp_ns, self._later_at = stamp_ns, now

    def stands(self, now: float, longest: float) -> str:
        """Return a text if messages arrive, but none with a later stamp for ``longest`` seconds; else an empty one."""
        if self._stamp_ns is None or now - self._later_at <= longest or now - self.came_at > longest:
            return ""
        return f"with no stamp after {self._stamp_ns * 1e-9:.3f} s for {now - self._later_at:.0f} s"


class Inputs:
    """Clouds and odometry of a robot that sends both, between two resets; ``codecs`` override the messages' own."""

    odometry_source = "robot"  # or the library that computes odometry here

    def __init__(
        self,
        keys: RobotKeys,
        config: NodeConfig,
        codecs: tuple[str | None, str | None],
        counters: Counters,
        errors: ErrorLog,
    ) -> None:
        self.keys = keys
        self.config = config
        self.codecs = codecs
        self.counters = counters
        self.errors = errors
        self.odometry = OdometryBuffer(config)
        # local time at which nothing was connected to the node: a pause of odometry then says nothing about the robot
        self.disconnected_at = _NEVER
        self._frames = FrameSync(config, self.odometry, counters)
        self._missing = MissingFrames()
        self._newest = {"clouds": NewestStamp(), "odometry": NewestStamp()}
        self._mount: tuple[Mount | None] | None = None  # that the transport reported with the newest cloud

    def decode_cloud(self, sample: Sample) -> CloudMessage:
        """Return a cloud in the body frame, with at most ``max_points``; MessageError if it is unreadable."""
        message = decode_cloud(sample, self.codecs[0], self.keys.hint, self.config.max_payload)
        message = message.limited(self.config.max_points)
        return replace(message, points=(sample.mount or self.config.mount).to_body(message.points))

    def note_mount(self, mount: Mount | None) -> Break | None:
        """Take the mount that the transport reported with a cloud; return the break if it has changed."""
        before, self._mount = self._mount, (mount,)
        return None if before in (None, (mount,)) else Break("the lidar's pose on the body is another than before")

    def decode_odometry(self, sample: Sample) -> OdometryMessage:
        """Return an odometry sample; MessageError if it is unreadable."""
        return decode_odometry(sample, self.codecs[1], self.keys.hint, self.config.max_payload)

    def count_undecodable(self, error: MessageError, key: str, prefix: str = "") -> None:
        """Count an undecodable message; of a kind whose reasons all differ, log only the first."""
        name = counter_of(error)
        self.counters.count(f"{prefix}received")
        self.counters.count(prefix + name)
        if isinstance(error, EncodingError | RefusedError):
            self.errors.add(str(error))
        else:
            self.errors.add_first(f"{key}: {name} messages", str(error).removeprefix(f"{key}: "))

    def add_cloud(self, message: CloudMessage, now: float) -> Break | None:
        """Count and queue a cloud; return the break if it does not continue the earlier ones."""
        self._newest["clouds"].add(message.stamp_ns, now)
        self.counters.received += 1
        self.counters.missing += self._missing.add(message.stamp_ns, message.sequence)
        duplicates = self.counters.duplicate
        interruption = self._queue(message, now)
        if self.counters.duplicate > duplicates:
            text = f"{message.stamp_ns * 1e-9:.3f} s; give each its own, or is a second sender on the key?"
            self.errors.add_first(f"{self.keys.robot}: clouds with the stamp of another cloud", text)
        return interruption

    def _queue(self, message: CloudMessage, now: float) -> Break | None:
        self._frames.add(message, now)
        return None

    def add_odometry(self, message: OdometryMessage, now: float) -> Break | None:
        """Add an odometry sample; return the break if it does not continue the earlier ones."""
        self._newest["odometry"].add(message.stamp_ns, now)
        self.counters.odometry_received += 1
        unreachable = self.odometry_source == "robot" and self.disconnected_at > self.odometry.arrived
        kind = self.odometry.add(message, now, unreachable)
        if kind in _COUNTED_AS:
            self.counters.count(_COUNTED_AS[kind])
        if kind not in _BREAKS:
            return None
        return Break(_BREAKS[kind], message.stamp_ns if kind is SampleKind.GAP else None)

    def take_paired(self, now: float) -> Iterator[PairedFrame]:
        """Hand out the frames with odometry, oldest first."""
        return self._frames.take_paired(now)

    def drop_frames(self) -> None:
        """Drop the waiting frames: their odometry frame has ended."""
        self.counters.dropped += len(self._frames)
        self._frames = FrameSync(self.config, self.odometry, self.counters)

    def continue_from(self, other: Inputs) -> None:
        """Continue with the odometry of the robot's session on another map."""
        self.odometry.continue_from(other.odometry)
        self._newest, self._mount = other._newest, other._mount

    def waiting_for(self) -> str:
        """Return the input that is missing, for a robot without a processed frame."""
        keys, counters = self.keys, self.counters
        has_odometry = self.odometry_source != "robot" or self.odometry.newest is not None
        if not counters.received:
            return f"waiting for clouds on {keys.cloud}"
        if not has_odometry and not counters.odometry_received:
            return f"waiting for odometry on {keys.odometry}"
        if counters.received == counters.malformed + counters.oversized + counters.unknown_encoding:
            return "not one cloud could be read; see errors"
        if not has_odometry:
            return "not one odometry sample could be read; see errors"
        if counters.engine_errors:
            return f"frames at which the engine failed: {counters.engine_errors}; see errors"
        if counters.rejected:
            return f"frames of no use: {counters.rejected}; see errors"
        if counters.late or counters.no_odometry:
            return "odometry and clouds have no common stamps: are both of one clock?"
        return "no frame has been processed yet"

    def silent(self, now: float) -> str:
        """Return which inputs repeat their stamps or have not come for ``max_outage``, and how long; empty if none."""
        arrived = {"clouds": self._newest["clouds"].came_at}
        if self.odometry_source == "robot":
            arrived["odometry"] = self.odometry.arrived
        longest = self.config.max_outage
        silent = {name: now - at for name, at in arrived.items() if at > _NEVER and now - at > longest}
        return self.repeating(now) or " and ".join(f"no {name} for {seconds:.0f} s" for name, seconds in silent.items())

    def repeating(self, now: float) -> str:
        """Return the inputs whose stamps have not advanced for ``max_outage`` while messages come; empty if none."""
        stands = {name: newest.stands(now, self.config.max_outage) for name, newest in self._newest.items()}
        return " and ".join(f"{name} {_COMES[name]} {text}" for name, text in stands.items() if text)

    def silence_reason(self, now: float) -> str:
        """Return why no odometry has come for ``odometry_timeout``."""
        return self.repeating(now) or f"no odometry for {self.config.odometry_timeout:g} s"


class LidarInputs(Inputs):
    """Inputs of a robot that sends only clouds: lidar odometry finds a pose for each cloud, which is paired with it.

    Frames go to the odometry engine in order of their stamps; one is under way, and at most two wait. An
    :class:`OdometryBuffer` of their stamps finds repeated and stray ones, and restarted clocks. Whenever lidar odometry
    restarts, so does the search, as the motion in between is unknown. ``epoch`` is the id of the first
    lidar odometry, which no earlier job of this robot has had.
    """

    odometry_source = "kiss-icp"

    def __init__(
        self,
        keys: RobotKeys,
        config: NodeConfig,
        codecs: tuple[str | None, str | None],
        counters: Counters,
        errors: ErrorLog,
        lidar: LidarOdometryConfig,
        epoch: int,
    ) -> None:
        super().__init__(keys, config, codecs, counters, errors)
        self.lidar = lidar
        self._first_epoch = self._epoch = epoch
        self._stamps = OdometryBuffer(config)
        self._waiting: deque[ReceivedFrame] = deque()
        self._under_way: ReceivedFrame | None = None

    def _queue(self, message: CloudMessage, now: float) -> Break | None:
        kind = self._stamps.add(OdometryMessage(message.stamp_ns, np.eye(4)), now)
        if kind in (SampleKind.DUPLICATE, SampleKind.OUT_OF_ORDER):
            self.counters.count("duplicate" if kind is SampleKind.DUPLICATE else "out_of_order")
            return None
        while self._waiting and (kind is SampleKind.RESTART or len(self._waiting) == _MAX_LIDAR_WAITING):
            self._waiting.popleft()
            self.counters.dropped += 1
        self._waiting.append(ReceivedFrame(message, now))
        if kind is not SampleKind.RESTART:
            return None
        self.counters.clock_restarts += 1
        return self.restart_odometry(_BREAKS[kind])

    @property
    def has_job(self) -> bool:
        """Whether a frame waits for the odometry engine; read without the lock."""
        return self._under_way is None and len(self._waiting) > 0

    def take_job(self) -> OdometryJob | None:
        """Hand the oldest frame to the odometry engine; None without one, or while one is under way."""
        if not self.has_job:
            return None
        self._under_way = self._waiting.popleft()
        message = self._under_way.message
        times = message.times if self.config.deskew else None
        return OdometryJob(self.keys.robot, self._epoch, message.stamp_ns, message.points, times, self.lidar)

    def job_done(self, job: OdometryJob, result: OdometryResult, now: float) -> Iterator[Break]:
        """Add a frame's odometry and the frame, unless from before a reset; apply each break before continuing."""
        if job.epoch < self._first_epoch:
            return
        frame, self._under_way = self._under_way, None
        if frame is None or job.epoch != self._epoch:
            self.counters.dropped += 1
            return
        if result.restarted and self.odometry.newest is not None:
            self.odometry.clear()
            yield Break("lidar odometry began anew")
        if (interruption := self.add_odometry(OdometryMessage(job.stamp_ns, result.T_odom_body), now)) is not None:
            yield interruption
        points = frame.message.points if result.points is None else result.points
        self._frames.add(replace(frame.message, points=points, times=None, rings=None), frame.received)

    def job_failed(self, job: OdometryJob, reason: str, rejected: bool) -> Break | None:
        """Count a frame without odometry; return the break if the engine has forgotten the robot."""
        if job.epoch < self._first_epoch:
            return None
        self._under_way = None
        self.counters.count("rejected" if rejected else "engine_errors")
        how = "cannot place" if rejected else "failed at"
        self.errors.add_first(f"{self.keys.robot}: frames that lidar odometry {how}", last_line(reason))
        if rejected or job.epoch != self._epoch:
            return None
        return self.restart_odometry("lidar odometry failed on a frame")

    def restart_odometry(self, reason: str) -> Break:
        """Restart the lidar odometry."""
        self._epoch += 1
        self.odometry.clear()
        return Break(reason)

    def silence_reason(self, now: float) -> str:
        """As in :class:`Inputs`."""
        timeout = self.config.odometry_timeout
        if now - self._newest["clouds"].came_at > timeout:
            return f"no clouds for {timeout:g} s"
        return f"lidar odometry has placed no frame for {timeout:g} s; see errors and counters"
