"""A robot's messages and their times: a recorded run played forth and back as one endless drive.

Times are seconds since the start of the drive; stamps are nanoseconds of the robot's sensor clock.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from coview_stream.clouds import read_tum
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, interpolate
from coview_stream.recordings.open_run import open_run
from coview_stream.recordings.run import Run
from coview_stream.report.evaluation import driven

EPOCH_NS = 1_700_000_000 * 10**9
"""Where the robots' sensor clocks begin: no clock of the machine, as a robot's is none of the node's."""

_APART = 31  # frames between the starts of neighbouring robots

Kind = Literal["odometry", "cloud"]


@dataclass(frozen=True)
class RobotPlan:
    """Stream of one robot until ``seconds``: clouds and odometry, one each period (0: none)."""

    robot: str
    seconds: float
    cloud: str = "xyz"  # codec
    odometry: str = "json"
    cloud_period: float = 0.1
    odometry_period: float = 0.02
    frame_seconds: float = 0.1  # how long one frame of the run lasts (recorded: 0.1)
    points: int | None = None  # to which every cloud is resampled


def schedule(plan: RobotPlan) -> list[tuple[float, Kind]]:
    """Everything the robot sends as (time, kind), in order; at equal times odometry first."""
    periods: dict[Kind, float] = {"odometry": plan.odometry_period, "cloud": plan.cloud_period}
    times = [
        (round(k * period, 6), kind)
        for kind, period in periods.items()
        if period > 0
        for k in range(round(plan.seconds / period))
    ]
    return sorted(times, key=lambda item: item[0])


def stamp_of(content: float) -> int:
    """Sensor stamp, rounded to the microsecond."""
    return EPOCH_NS + round(content * 1e6) * 1000


class Drive:
    """A plan's robot on the recorded run of a world; ``r1`` starts at its first frame, each other one further on."""

    def __init__(self, world: Path, plan: RobotPlan) -> None:
        self._world, self._plan = world, plan
        self._start = _APART * (int(plan.robot.lstrip("r")) - 1)
        self._truth = read_tum(world / "truth.tum")[1]

    def _at(self, content: float) -> float:
        """Index into the run, between frames."""
        last = len(self._truth) - 1
        along = (self._start + content / self._plan.frame_seconds) % (2 * last)
        return min(along, 2 * last - along)

    def cloud(self, content: float) -> Points:
        """(N, 3) frame nearest to that moment, body frame, metres."""
        return _cloud(self._world, round(self._at(content)), self._plan.points)

    def T_odom_body(self, content: float) -> Pose:
        """Return the odometry, between frames as well."""
        return _odometry(self._world, round(self._at(content), 6))

    def truth(self, stamp_ns: int) -> Pose:
        """Return the true T_map_body at a published stamp."""
        return _between(self._truth, self._at(_content(stamp_ns)))

    def metres(self, stamp_ns: int) -> float:
        """Distance driven until a published stamp; only for drives that do not turn back before."""
        way = driven(self._truth)
        at = self._start + _content(stamp_ns) / self._plan.frame_seconds
        return float(np.interp(at, np.arange(len(way)), way) - way[self._start])


def _content(stamp_ns: int) -> float:
    return (stamp_ns - EPOCH_NS) / 1e9


def _between(poses: Floats, at: float) -> Pose:
    low = min(int(at), len(poses) - 2)
    return interpolate(poses[low], poses[low + 1], at - low)


@functools.cache
def _run(world: Path) -> Run:
    return open_run(world / "run")


@functools.lru_cache(20_000)  # shared by the robots of a process, likewise
def _odometry(world: Path, at: float) -> Pose:
    return _between(_run(world).poses, at)


@functools.cache  # shared by the robots of a process
def _cloud(world: Path, index: int, points: int | None) -> Points:
    cloud = _run(world).read(index).points
    if points is None:
        return cloud
    rng = np.random.default_rng(index)
    cloud = cloud[rng.choice(len(cloud), points, replace=points > len(cloud))]
    return (cloud + rng.normal(0, 0.01, cloud.shape)).astype(np.float32)
