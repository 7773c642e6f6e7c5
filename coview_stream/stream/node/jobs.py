"""What goes to the engine and what comes back: plain data that crosses a process boundary."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose
from coview_stream.localization.result import Fix
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.search.request import SearchRequest
from coview_stream.odometry.buffer import Segment


@dataclass(frozen=True)
class FrameJob:
    """One frame for the tracking engine.

    Attributes:
        robot: name.
        epoch: of the robot's odometry frame; a new one makes the engine forget what it knew.
        stamp_ns: sensor time, nanoseconds.
        points: (N, 3) float32 body frame, metres.
        T_odom_body: (4, 4) odometry at the stamp.
        times: (N,) seconds after the stamp at which each point was measured, None if not to be deskewed.
        segment: odometry during the sweep; goes with ``times``.
        suspect: give no pose before this frame has verified the place.
        verdict: of an earlier search, to be taken note of first.
        hurry: the engine is behind with its work: leave what can wait.
        suggested: (4, 4) ``T_map_body`` where the robot may be at this frame, to be verified like anything else.
    """

    robot: str
    epoch: int
    stamp_ns: int
    points: Points
    T_odom_body: Pose
    times: Floats | None = None
    segment: Segment | None = None
    suspect: bool = False
    verdict: SearchResult | None = None
    hurry: bool = False
    suggested: Pose | None = None


@dataclass(frozen=True)
class FrameResult:
    """The fix after a frame, what has to be searched for (if anything), and the seconds it took."""

    fix: Fix
    query: SearchRequest | None
    seconds: float


@dataclass(frozen=True)
class SearchJob:
    """One keyframe to search the map for; ``epoch`` as in :class:`FrameJob`."""

    robot: str
    epoch: int
    query: SearchRequest


@dataclass(frozen=True)
class OdometryJob:
    """One frame to make odometry of, for robots that send none.

    Attributes:
        robot: name.
        generation: of its odometry; with a new one it begins anew.
        stamp_ns: sensor time, nanoseconds.
        points: (N, 3) float32 body frame, metres.
        times: (N,) seconds after the stamp at which each point was measured, None if not to be deskewed.
        config: of its lidar odometry.
    """

    robot: str
    generation: int
    stamp_ns: int
    points: Points
    times: Floats | None
    config: LidarOdometryConfig


@dataclass(frozen=True)
class OdometryResult:
    """Where a frame was taken.

    Attributes:
        T_odom_body: (4, 4) odometry at its stamp.
        points: (N, 3) deskewed; None if nothing was to be deskewed.
        begun: the pose has nothing to do with those before it.
        seconds: that it took.
    """

    T_odom_body: Pose
    points: Points | None
    begun: bool
    seconds: float


Job: TypeAlias = FrameJob | SearchJob | OdometryJob
Result: TypeAlias = FrameResult | SearchResult | OdometryResult
