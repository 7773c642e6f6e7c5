"""What a robot would send, and when: a recorded run played forth and back as one endless drive.

Three clocks: *due* is seconds since the start of the stream, *content* is the moment of the drive that a message shows
(seconds since its start), and its *stamp* is what the robot's sensor clock claims. All agree unless a phase spoils it.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from bench.stream.wire import EPOCH_NS, Points
from coview_stream.clouds import read_tum
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import interpolate
from coview_stream.recordings.open_run import open_run

RESTARTED = 1000.0  # seconds by which a robot's clock jumps back in phase ``restart``
FAR_FUTURE = 86400.0
_APART = 31  # frames between the starts of neighbouring robots

What = Literal["no_clouds", "no_odometry", "late", "twice", "reversed", "future", "restart"]
Kind = Literal["odometry", "cloud"]


@dataclass(frozen=True)
class Phase:
    """Something odd between ``begin`` and ``end`` seconds of the stream.

    ``late``: each message is followed by one from 0.5 s before; ``twice``: each comes twice; ``reversed``: time runs
    backwards; ``future``: begins with one message of each kind that claims to be of tomorrow; ``restart``: the
    stamps are RESTARTED seconds older from here on.
    """

    begin: float
    end: float
    what: What


@dataclass(frozen=True)
class RobotPlan:
    """What one robot streams for ``seconds``: a cloud each ``cloud_period`` (0: none), odometry between them.

    ``frame_seconds`` is how long one frame of the run lasts (recorded: 0.1); ``points`` resamples every cloud.
    """

    robot: str
    seconds: float
    begin: float = 0.0
    cloud: str = "xyz"
    odometry: str = "json"
    cloud_period: float = 0.1
    odometry_period: float = 0.02
    frame_seconds: float = 0.1
    points: int | None = None
    phases: tuple[Phase, ...] = ()


_CLOUDS: dict[tuple[Path, int, int | None], Points] = {}  # shared by the robots of a process

Due = tuple[float, Kind, float, float]  # due, kind, content, claimed (the stamp as seconds since the epoch)


def start_frame(robot: str) -> int:
    """Frame of the run at which robot ``r<number>`` starts: each robot another one, ``r1`` the first."""
    return _APART * (int(robot.lstrip("r")) - 1)


def schedule(plan: RobotPlan) -> Iterator[Due]:
    """Everything the robot sends, in order of time; at equal times the odometry first."""
    streams = [_times(plan, plan.odometry_period, 0), _times(plan, plan.cloud_period, 1)]
    future: set[tuple[Phase, Kind]] = set()
    for due, rank in heapq.merge(*streams):
        kind: Kind = "cloud" if rank else "odometry"
        now = [phase for phase in plan.phases if phase.begin <= due < phase.end]
        active = {phase.what for phase in now}
        if ("no_clouds" if rank else "no_odometry") in active:
            continue
        content = due
        for phase in now:
            if phase.what == "reversed":
                content = 2 * phase.begin - due
            if phase.what == "future" and (phase, kind) not in future:
                future.add((phase, kind))
                yield due, kind, content, content + FAR_FUTURE
        shift = -RESTARTED if "restart" in active else 0.0
        yield due, kind, content, content + shift
        if "late" in active:
            yield due, kind, content - 0.5, content - 0.5 + shift
        if "twice" in active:
            yield due, kind, content, content + shift


def _times(plan: RobotPlan, period: float, rank: int) -> Iterator[tuple[float, int]]:
    count = round((plan.seconds - plan.begin) / period) if period > 0 else 0
    return ((round(plan.begin + k * period, 6), rank) for k in range(count))


def stamp_of(claimed: float) -> int:
    """Sensor stamp, rounded to the microsecond."""
    return EPOCH_NS + round(claimed * 1e6) * 1000


def content_of(stamp_ns: int) -> float:
    """Return the moment of the drive that a published stamp means, a restarted clock included."""
    seconds = (stamp_ns - EPOCH_NS) / 1e9
    return seconds + RESTARTED if seconds < -RESTARTED / 2 else seconds


class Drive:
    """A robot's recorded run, driven forth and back from its :func:`start_frame` on."""

    def __init__(self, world: Path, robot: str, frame_seconds: float = 0.1) -> None:
        self._run = open_run(world / "run")
        _, self._truth = read_tum(world / "truth.tum")
        self._start, self._frame_seconds = start_frame(robot), frame_seconds
        steps = np.linalg.norm(np.diff(self._truth[:, :3, 3], axis=0), axis=1)
        self._travelled = np.concatenate([[0.0], np.cumsum(steps)])

    def __len__(self) -> int:
        return len(self._run)

    def _at(self, content: float) -> float:
        """Index into the run, between frames."""
        last = len(self._run) - 1
        along = (self._start + content / self._frame_seconds) % (2 * last)
        return min(along, 2 * last - along)

    def cloud(self, content: float, points: int | None = None) -> Points:
        """(N, 3) frame nearest to that moment, body frame, metres; resampled to ``points`` if given."""
        index = round(self._at(content))
        known = (self._run.path, index, points)
        if known not in _CLOUDS:
            cloud = self._run.read(index).points
            if points is not None:
                rng = np.random.default_rng(index)
                cloud = cloud[rng.choice(len(cloud), points, replace=points > len(cloud))]
                cloud = (cloud + rng.normal(0, 0.01, cloud.shape)).astype(np.float32)
            _CLOUDS[known] = cloud
        return _CLOUDS[known]

    def T_odom_body(self, content: float) -> Floats:
        """Return the odometry, between frames as well."""
        return _between(self._run.poses, self._at(content))

    def T_map_body(self, content: float) -> Floats:
        """Return the truth."""
        return _between(self._truth, self._at(content))

    def truth(self, stamp_ns: int) -> Floats:
        """Return the truth at a published stamp."""
        return self.T_map_body(content_of(stamp_ns))

    def metres(self, content: float) -> float:
        """Distance driven until then; only for drives that do not turn back before."""
        frames = np.arange(len(self._travelled))
        at = self._start + content / self._frame_seconds
        return float(np.interp(at, frames, self._travelled) - np.interp(self._start, frames, self._travelled))


def _between(poses: Floats, at: float) -> Floats:
    low = min(int(at), len(poses) - 2)
    return interpolate(poses[low], poses[low + 1], at - low)
