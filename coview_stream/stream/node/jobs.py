"""Jobs for the engines and their results: plain data that crosses a process boundary."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.result import Fix
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.search.place_guess import PlaceGuess
from coview_stream.localization.search.request import SearchRequest
from coview_stream.localization.state import Event
from coview_stream.odometry.buffer import Segment


@dataclass(frozen=True)
class FrameJob:
    """One lidar frame for the tracking engine.

    Attributes:
        robot: name.
        epoch: number of the robot's odometry frame; a new one makes the engine forget the robot's place.
        stamp_ns: sensor time, nanoseconds.
        points: (N, 3) float32 body frame, metres.
        T_odom_body: (4, 4) odometry at the stamp.
        times: (N,) seconds after the stamp at which each point was measured, None if not to be deskewed.
        segment: odometry while the frame was measured; goes with ``times``.
        require_verification: give no pose before this frame has verified the place.
        search_result: of an earlier search, to be applied first.
        defer: frames wait for the engine: put off what need not be done at this one.
        hint: (4, 4) ``T_map_body`` where the robot may be at this frame, to be verified like any hypothesis.
        guess: of the place by somebody; tried, never trusted.
        calibration: what was known of its sensor and odometry there; goes with ``hint``, a prior.
        first_epoch: the first one after a client asked to forget the robot; another one makes the engine forget what it
            knows of the sensor and the odometry, too.
    """

    robot: str
    epoch: int
    stamp_ns: int
    points: Points
    T_odom_body: Pose
    times: Floats | None = None
    segment: Segment | None = None
    require_verification: bool = False
    search_result: SearchResult | None = None
    defer: bool = False
    hint: Pose | None = None
    guess: PlaceGuess | None = None
    calibration: Calibration | None = None
    first_epoch: int = 0


@dataclass(frozen=True)
class FrameResult:
    """The tracking engine's answer to a frame.

    Attributes:
        fix: after the frame.
        request: what has to be searched for, None for nothing.
        seconds: that the engine took.
        events: that have changed the engine's state since its last answer for this robot and epoch, in order.
    """

    fix: Fix
    request: SearchRequest | None
    seconds: float
    events: tuple[Event, ...]


@dataclass(frozen=True)
class SearchJob:
    """One keyframe for the search engine.

    Attributes:
        robot: name.
        request: what to search for; it has the epoch of the frame's job.
    """

    robot: str
    request: SearchRequest

    @property
    def epoch(self) -> int:
        """As in :class:`FrameJob`."""
        return self.request.epoch[0]


@dataclass(frozen=True)
class OdometryJob:
    """One lidar frame for the odometry engine, of a robot that sends no odometry.

    Attributes:
        robot: name.
        epoch: number of its lidar odometry; a new one makes the engine begin it again.
        stamp_ns: sensor time, nanoseconds.
        points: (N, 3) float32 body frame, metres.
        times: (N,) seconds after the stamp at which each point was measured, None if not to be deskewed.
        config: of its lidar odometry.
    """

    robot: str
    epoch: int
    stamp_ns: int
    points: Points
    times: Floats | None
    config: LidarOdometryConfig


@dataclass(frozen=True)
class OdometryResult:
    """Lidar odometry at a frame.

    Attributes:
        T_odom_body: (4, 4) odometry at its stamp.
        points: (N, 3) deskewed; None if nothing was to be deskewed.
        restarted: the pose is not connected to those before it.
        seconds: that the engine took.
    """

    T_odom_body: Pose
    points: Points | None
    restarted: bool
    seconds: float


Job: TypeAlias = FrameJob | SearchJob | OdometryJob
Result: TypeAlias = FrameResult | SearchResult | OdometryResult
