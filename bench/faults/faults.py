"""Faults of sensors, drivers and clocks: functions of a run in memory, each with a seed of its own.

A fault begins at :data:`BEGINS` of the drive's time and goes on to its end; bad input is there from the first frame.
Truth is where the body is at a frame's stamp, as its pose says.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from bench.tracking.drives import rejoined
from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.transforms import Points, Poses, interpolate, pose_from, rot_z, yaw_of
from coview_stream.report.evaluation import driven

BEGINS = 0.4  # share of the drive's time
_MOUNT = 0.6  # metres, of a lever arm that was not measured
_SHIFTED = 4.0  # metres, of clouds
_KIDNAPPED = 0.3  # share of the drive that the robot is carried over


@dataclass(frozen=True)
class Feed:
    """Frames as the localizer gets them."""

    clouds: Sequence[Points]  # (K), (N, 3) float32 each, metres, body frame
    stamps: Floats  # (K,) seconds, as the driver says
    odometry: Poses  # (K, 4, 4) odom <- body at the stamps
    truth: Poses  # (K, 4, 4) map <- body at the stamps
    clock: Floats  # (K,) seconds, at which the frames come
    way: Floats  # (K,) metres that the robot has driven by then
    begins: int = 0  # frame of the fault

    def __len__(self) -> int:
        return len(self.clouds)

    @classmethod
    def of(cls, clouds: Sequence[Points], stamps: Floats, odometry: Poses, truth: Poses) -> Feed:
        """Return a run without a fault, and the frame at which one begins."""
        begins = int(np.searchsorted(stamps, stamps[0] + BEGINS * (stamps[-1] - stamps[0])))
        return cls(clouds, stamps, odometry, truth, stamps, driven(truth), begins)

    @property
    def later(self) -> Ints:
        """Frames from the fault on."""
        return np.arange(self.begins, len(self))

    def changed(self, change: Callable[[int, Points], Points | Floats]) -> Feed:
        """Return the run with other clouds from the fault on; ``change`` gets the frame's number and its cloud."""
        kept = list(self.clouds[: self.begins])
        return replace(self, clouds=kept + [_cloud(change(int(k), self.clouds[k])) for k in self.later])

    def picked(self, rows: Ints) -> Feed:
        """Return some of its frames, in that order, each with its stamp."""
        arrays = {name: getattr(self, name)[rows] for name in ("stamps", "odometry", "truth", "clock", "way")}
        begins = int(np.searchsorted(rows, self.begins))
        return replace(self, clouds=[self.clouds[k] for k in rows], begins=begins, **arrays)

    def at(self, poses: Poses, times: Floats) -> Poses:
        """Interpolate poses (K, 4, 4), which belong to :attr:`clock`, at some times (M,) of it."""
        after = np.clip(np.searchsorted(self.clock, times), 1, len(self) - 1)
        share = (times - self.clock[after - 1]) / (self.clock[after] - self.clock[after - 1])
        return interpolate(poses[after - 1], poses[after], np.clip(share, 0.0, 1.0))

    def stamped(self, late: Floats) -> Feed:
        """Return the run with clouds stamped ``late`` (K,) seconds later, without clouds after the end of odometry."""
        stamps = self.stamps + late
        rows = np.flatnonzero(stamps <= self.stamps[-1])
        picked = self.picked(rows)
        odometry, truth = (self.at(poses, stamps[rows]) for poses in (self.odometry, self.truth))
        clock = stamps[rows]  # no cloud comes before its stamp
        return replace(
            picked, stamps=stamps[rows], odometry=odometry, truth=truth, clock=clock,
            way=np.interp(clock, self.clock, self.way),
        )  # fmt: skip

    def moved(self, step: Callable[[int, Floats, float], tuple[Floats, float]]) -> Feed:
        """Return the run with other odometry from the fault on.

        ``step`` gets a frame's number, its step (3,) along the level axes of the frame before, metres, and its turn
        about the vertical, radians, and returns others. Roll and pitch stay odometry's.
        """
        odometry = self.odometry.copy()
        for k in self.later[self.later > 0]:
            before, now = self.odometry[k - 1], self.odometry[k]
            heading, turn = yaw_of(before), yaw_of(now) - yaw_of(before)
            metres = rot_z(-heading) @ (now[:3, 3] - before[:3, 3])
            metres, turn = step(int(k), metres, float(np.arctan2(np.sin(turn), np.cos(turn))))
            last = yaw_of(odometry[k - 1])
            tilt = rot_z(-yaw_of(now)) @ now[:3, :3]
            odometry[k] = pose_from(rot_z(last + turn) @ tilt, odometry[k - 1, :3, 3] + rot_z(last) @ metres)
        return replace(self, odometry=odometry)


def _cloud(points: Points | Floats) -> Points:
    return np.ascontiguousarray(points, dtype=np.float32)


def _noisy(points: Points, metres: float, rng: np.random.Generator) -> Points:
    return _cloud(points + rng.normal(0.0, metres, points.shape))


# ---- the driver


def _frozen(feed: Feed, rng: np.random.Generator, noise: float = 0.0) -> Feed:
    stuck = feed.clouds[feed.begins]
    return feed.changed(lambda k, points: _noisy(stuck, noise, rng) if noise else stuck)


def _old_stamps(feed: Feed, rng: np.random.Generator) -> Feed:
    stamps = feed.stamps.copy()
    stamps[feed.begins :] = stamps[feed.begins]
    return replace(_frozen(feed, rng), stamps=stamps)


def _mixed(feed: Feed, rng: np.random.Generator, alternating: bool = False) -> Feed:
    """Let a second driver, half of the drive away, publish on the same key: in each cloud, or in turns."""

    def both(k: int, points: Points) -> Points:
        other = feed.clouds[(k + len(feed) // 2) % len(feed)]
        if alternating:
            return other if k % 2 else points
        return np.concatenate([cloud[rng.random(len(cloud)) < 0.5] for cloud in (points, other)])

    return feed.changed(both)


def _covered(feed: Feed, rng: np.random.Generator) -> Feed:
    def cloth(k: int, points: Points) -> Points:
        near = rng.uniform(0.5, 0.9, len(points)) / np.maximum(np.linalg.norm(points, axis=1), 1e-3)
        return _cloud(points * near[:, None])

    return feed.changed(cloth)


def _stutter(feed: Feed, rng: np.random.Generator) -> Feed:
    """Leave out a second of every two."""
    since = feed.clock - feed.clock[feed.begins]
    return feed.picked(np.flatnonzero((since < 0) | (since % 2.0 < 1.0)))


# ---- clocks


def _late(feed: Feed, rng: np.random.Generator, seconds: float = 0.0, growth: float = 0.0) -> Feed:
    """Stamp clouds late by ``seconds`` and by ``growth`` more each second."""
    since = feed.clock - feed.clock[feed.begins]
    return feed.stamped(np.where(since < 0, 0.0, seconds + growth * since))


def _odometry_late(feed: Feed, rng: np.random.Generator, seconds: float) -> Feed:
    """Delay odometry, which stands still until the first late pose."""
    begin = feed.clock[feed.begins]
    then = np.where(feed.clock < begin, feed.clock, np.maximum(begin, feed.clock - seconds))
    return replace(feed, odometry=feed.at(feed.odometry, then))


# ---- odometry


def _mirrored(feed: Feed, rng: np.random.Generator) -> Feed:
    return feed.moved(lambda k, step, turn: (step * (1.0, -1.0, 1.0), -turn))


def _stopped(feed: Feed, rng: np.random.Generator) -> Feed:
    return feed.moved(lambda k, step, turn: (np.zeros(3), 0.0))


def _long(feed: Feed, rng: np.random.Generator) -> Feed:
    return feed.moved(lambda k, step, turn: (1.5 * step, turn))


def _slipping(feed: Feed, rng: np.random.Generator) -> Feed:
    """Let the wheels spin for one second in six, when odometry counts half as far again."""
    since = feed.clock - feed.clock[feed.begins]
    return feed.moved(lambda k, step, turn: (step * (1.5 if since[k] % 6.0 < 1.0 else 1.0), turn))


def _jumped(feed: Feed, rng: np.random.Generator) -> Feed:
    """Let odometry jump by 3 m forward, 1 m to a side and 15 degrees."""
    side, at = rng.choice([-1.0, 1.0]), feed.begins
    step = pose_from(rot_z(side * np.radians(15.0)), [3.0, side, 0.0])
    return replace(feed, odometry=rejoined(feed.odometry, at, feed.odometry[at] @ step))


# ---- the sensor on the body, and the robot


def _turned(feed: Feed, rng: np.random.Generator, degrees: float, axis: str = "z") -> Feed:
    angle = np.radians(degrees) * rng.choice([-1.0, 1.0])
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) if axis == "y" else rot_z(angle)
    return feed.changed(lambda k, points: points @ R.T)


def _shifted(feed: Feed, rng: np.random.Generator, metres: float, start: bool = False) -> Feed:
    angle = rng.uniform(0.0, 2.0 * np.pi)
    shift = metres * np.array([np.cos(angle), np.sin(angle), 0.0])
    feed = replace(feed, begins=0) if start else feed
    return feed.changed(lambda k, points: points + shift)


def _kidnapped(feed: Feed, rng: np.random.Generator) -> Feed:
    """Carry the robot along a part of its path, unseen, while it stands still by odometry."""
    at, there = feed.begins, min(feed.begins + round(_KIDNAPPED * len(feed)), len(feed) - 2)
    rows = np.r_[0:at, there : len(feed)]
    picked = feed.picked(rows)
    odometry = rejoined(picked.odometry, at, feed.odometry[at - 1])
    metres, seconds = (values[there] - values[at] for values in (feed.way, feed.clock))
    later = rows >= there
    stamps = picked.stamps - later * seconds
    return replace(picked, odometry=odometry, stamps=stamps, clock=stamps, way=picked.way - later * metres, begins=at)


def _standing(feed: Feed, rng: np.random.Generator) -> Feed:
    """Let the robot stand still to the end, with a noisy lidar."""
    at = feed.begins
    odometry, truth, way = feed.odometry.copy(), feed.truth.copy(), feed.way.copy()
    odometry[at:], truth[at:], way[at:] = odometry[at], truth[at], way[at]
    return replace(_frozen(feed, rng, 0.01), odometry=odometry, truth=truth, way=way)


# ---- bad input, from the first frame on


def _axes(feed: Feed, rng: np.random.Generator, matrix: Sequence[Sequence[float]] | Floats) -> Feed:
    M = np.array(matrix)
    return replace(feed, begins=0).changed(lambda k, points: points @ M.T)


def _stamps(feed: Feed, rng: np.random.Generator, kind: str) -> Feed:
    zero, constant = np.zeros(len(feed)), np.full(len(feed), feed.stamps[0])
    repeated = feed.stamps[np.arange(len(feed)) // 2 * 2]
    return replace(feed, stamps={"zero": zero, "constant": constant, "repeated": repeated}[kind], begins=0)


def _identical(feed: Feed, rng: np.random.Generator) -> Feed:
    return _frozen(replace(feed, begins=0), rng)


class Fault(NamedTuple):
    """A fault: its name, its function, and the words (a regular expression) of a reason that names its cause."""

    name: str
    make: Callable[[Feed, np.random.Generator], Feed]
    named: str = ""  # empty: there is nothing to name
    bad_input: bool = False  # whether it is bad input, from the first frame on

    def of(self, feed: Feed, world: str) -> Feed:
        """Return a run with the fault, drawn by a seed of its name and the world's."""
        return self.make(feed, np.random.default_rng(zlib.crc32(f"{self.name} {world}".encode())))


def _undisturbed(feed: Feed, rng: np.random.Generator) -> Feed:
    return feed


UNDISTURBED = Fault("undisturbed", _undisturbed)

_REPEATS = r"repeat"
_CLOCK = r"older|newer|\d s (late|early)|stamp|clock"
_ODOMETRY = r"odometry"
_MOUNT_SAYS = r"mount|turned|lever"
_OTHER = r"more than one place|two drivers|another driver"

FAULTS = (
    Fault("scan repeated", _frozen, _REPEATS),
    Fault("scan repeated, mm noise", partial(_frozen, noise=0.002), _REPEATS),
    Fault("scan repeated, old stamps", _old_stamps, r"repeat|stamp"),
    Fault("clouds' lag grows 0.1 s/s", partial(_late, growth=0.1), _CLOCK),
    Fault("clouds 0.12 s late", partial(_late, seconds=0.12), _CLOCK),
    Fault("clouds 0.3 s late", partial(_late, seconds=0.3), _CLOCK),
    Fault("clouds 1 s late", partial(_late, seconds=1.0), _CLOCK),
    Fault("odometry 0.3 s late", partial(_odometry_late, seconds=0.3), _CLOCK),
    Fault("odometry 1 s late", partial(_odometry_late, seconds=1.0), _CLOCK),
    Fault("odometry mirrored", _mirrored, r"mirror|left-handed|odometry"),
    Fault("odometry stands still", _stopped, r"odometry stands still"),
    Fault("odometry 1.5 times too long", _long, _ODOMETRY),
    Fault("odometry jumps", _jumped, _ODOMETRY),
    Fault("sensor turns 3 deg (yaw)", partial(_turned, degrees=3.0), _MOUNT_SAYS),
    Fault("sensor turns 10 deg (yaw)", partial(_turned, degrees=10.0), _MOUNT_SAYS),
    Fault("sensor turns 3 deg (pitch)", partial(_turned, degrees=3.0, axis="y"), r"mount|turned|leans"),
    Fault("sensor turns 10 deg (pitch)", partial(_turned, degrees=10.0, axis="y"), r"mount|turned|leans"),
    Fault("lever arm 0.6 m, from the start", partial(_shifted, metres=_MOUNT, start=True), _MOUNT_SAYS),
    Fault("clouds shifted by 4 m", partial(_shifted, metres=_SHIFTED), r"mount|no body moves"),
    Fault("half of the points from elsewhere", _mixed, _OTHER),
    Fault("sources alternate", partial(_mixed, alternating=True), _OTHER),
    Fault("kidnap", _kidnapped, r"elsewhere|carried"),
    Fault("lidar covered", _covered, r"covered|points|sees"),
    Fault("stutter", _stutter),
    Fault("wheel slip", _slipping),
    Fault("standstill", _standing),
    Fault("feet", partial(_axes, matrix=np.eye(3) / 0.3048), r"feet|unit", True),
    Fault("millimetres", partial(_axes, matrix=np.eye(3) * 1e3), r"milli|unit|kilometres", True),
    Fault("z down", partial(_axes, matrix=[[1, 0, 0], [0, -1, 0], [0, 0, -1]]), r"z points down|upside down", True),
    Fault("y forward", partial(_axes, matrix=[[0, -1, 0], [1, 0, 0], [0, 0, 1]]), r"y points forward|y forward", True),
    Fault("left-handed", partial(_axes, matrix=[[1, 0, 0], [0, -1, 0], [0, 0, 1]]), r"left-handed|mirror", True),
    Fault("stamps constant", partial(_stamps, kind="constant"), r"stamp", True),
    Fault("stamps zero", partial(_stamps, kind="zero"), r"stamp", True),
    Fault("stamps repeated", partial(_stamps, kind="repeated"), r"stamp", True),
    Fault("identical bytes", _identical, _REPEATS, True),
)
