"""What a robot would send, and when: a recorded run played forth and back as one endless drive.

Three clocks: *due* is seconds since the start of the stream, *content* is the moment of the drive that a message shows
(seconds since its start), and its *stamp* is what the robot's sensor clock claims. All agree unless a phase spoils it.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
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

RESTARTED = 1000.0  # seconds by which a robot's clock jumps back in phase ``restart``
FAR_FUTURE = 86400.0
_APART = 31  # frames between the starts of neighbouring robots

Phase = Literal["no_cloud", "no_odometry", "late", "twice", "reversed", "future", "restart"]
Kind = Literal["odometry", "cloud"]


@dataclass(frozen=True)
class RobotPlan:
    """What one robot streams from ``begin`` to ``seconds``: clouds and odometry, one each period (0: none).

    ``phases`` are begin and end of something odd. ``late``: each message is followed by one from 0.5 s before;
    ``twice``: each comes twice; ``reversed``: time runs backwards; ``future``: begins with one message of each kind
    that claims to be of tomorrow; ``restart``: the stamps are RESTARTED seconds older.
    """

    robot: str
    seconds: float
    begin: float = 0.0
    cloud: str = "xyz"  # codec
    odometry: str = "json"
    cloud_period: float = 0.1
    odometry_period: float = 0.02
    frame_seconds: float = 0.1  # how long one frame of the run lasts (recorded: 0.1)
    points: int | None = None  # to which every cloud is resampled
    phases: Mapping[Phase, tuple[float, float]] = field(default_factory=dict)


def schedule(plan: RobotPlan) -> Iterator[tuple[float, Kind, float, float]]:
    """Everything the robot sends as (due, kind, content, claimed stamp), in order; at equal times odometry first."""
    periods: dict[Kind, float] = {"odometry": plan.odometry_period, "cloud": plan.cloud_period}
    dues = [
        (round(plan.begin + k * period, 6), kind)
        for kind, period in periods.items()
        if period > 0
        for k in range(round((plan.seconds - plan.begin) / period))
    ]
    sent_ahead = set()
    for due, kind in sorted(dues, key=lambda item: item[0]):
        active = {phase for phase, (begin, end) in plan.phases.items() if begin <= due < end}
        if f"no_{kind}" in active:
            continue
        content = 2 * plan.phases["reversed"][0] - due if "reversed" in active else due
        if "future" in active and kind not in sent_ahead:
            sent_ahead.add(kind)
            yield due, kind, content, content + FAR_FUTURE
        shift = -RESTARTED if "restart" in active else 0.0
        for back in (0.0, *([0.5] if "late" in active else []), *([0.0] if "twice" in active else [])):
            yield due, kind, content - back, content - back + shift


def stamp_of(claimed: float) -> int:
    """Sensor stamp, rounded to the microsecond."""
    return EPOCH_NS + round(claimed * 1e6) * 1000


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
    """Moment of the drive that a published stamp means, a restarted clock included."""
    seconds = (stamp_ns - EPOCH_NS) / 1e9
    return seconds + RESTARTED if seconds < -RESTARTED / 2 else seconds


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
