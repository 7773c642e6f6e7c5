"""What happens to a robot while it is tracked: drives made of the frames of a simulated one.

Frames and truth are the simulator's; odometry is drawn anew with a chosen drift and then jumps, starts again, is out of
scale or stands still while the robot is carried.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from bench.tracking.worlds import in_gap
from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.transforms import Points, Pose, inverse, pose_from, rot_z, yaw_of
from coview_stream.report.evaluation import driven
from coview_stream.sim.odometry import OdometryConfig, drifting_odometry

PERIOD = 0.1
SEGMENT = 100.0  # metres over which drift is measured
CLEAR, CLOTH, DUST = 0, 1, 2
"""What lies over the sensor: nothing; a cloth at 0.5 to 0.9 m; so much that only 20 returns of a frame are left."""

_DUST_POINTS = 20
_LEAST_GAP = 20.0  # metres in the gap that count as an event
_FIRST_STAMP = 1000.0


@dataclass(frozen=True)
class Event:
    """What happened, from the frame ``begin`` on; at the frame ``end`` it is over, and recovery begins."""

    what: str
    begin: int
    end: int


@dataclass(frozen=True)
class Drive:
    """Frames as the robot gets them.

    Attributes:
        frames: (K,) which of the recorded ones.
        stamps: (K,) seconds.
        truth: (K, 4, 4) map <- body.
        odometry: (K, 4, 4) odom <- body.
        driven: (K,) metres on its own wheels up to each frame.
        cover: (K,) what lies over the sensor.
        events: what to recover from.
    """

    frames: Ints
    stamps: Floats
    truth: Floats
    odometry: Floats
    driven: Floats
    cover: Ints
    events: tuple[Event, ...] = field(default=())

    def __len__(self) -> int:
        return len(self.frames)

    def at(self, metres: float) -> int:
        """First frame after so many metres; the last one if the drive is shorter."""
        return min(int(np.searchsorted(self.driven, metres)), len(self) - 1)

    def until(self, metres: float) -> Drive:
        """Return the drive's first ``metres``."""
        k = self.at(metres) + 1
        parts = (self.stamps[:k], self.truth[:k], self.odometry[:k], self.driven[:k], self.cover[:k])
        return Drive(self.frames[:k], *parts, events=self.events)


def start(truth: Floats, drift: float, seed: int) -> Drive:
    """Drive as recorded: (N, 4, 4) map <- body, with odometry that drifts by that share of the distance."""
    count = len(truth)
    stamps = _FIRST_STAMP + PERIOD * np.arange(count, dtype=np.float64)
    odometry = drifting(truth, drift, seed)
    return Drive(np.arange(count), stamps, truth, odometry, driven(truth), np.zeros(count, dtype=np.int64))


def drift_share(truth: Floats, odometry: Floats, over: float = SEGMENT) -> float:
    """Mean over all stretches of ``over`` metres of how far odometry is off at their end, as a share of them.

    Shorter drives: over their second half's length.
    """
    way = driven(truth)
    over = min(over, way[-1] / 2)
    errors = []
    for first in range(0, int(np.searchsorted(way, way[-1] - over)), 10):
        last = int(min(np.searchsorted(way, way[first] + over), len(way) - 1))
        true, told = (inverse(T[first]) @ T[last] for T in (truth, odometry))
        errors.append(float(np.linalg.norm(true[:3, 3] - told[:3, 3])) / over)
    return float(np.mean(errors))


def drifting(truth: Floats, share: float, seed: int) -> Floats:
    """Odometry (N, 4, 4) with the simulator's errors, all made larger or smaller alike so that it drifts by ``share``.

    Its scale is off by its sigma, not by a draw: with one near zero all of the drift would be a heading that trembles.
    Seeds that are even drive too far, the others too short.
    """
    usual, factor = OdometryConfig(), share / 0.015
    for _ in range(5):
        config = replace(
            usual, yaw_walk=usual.yaw_walk * factor, scale_error=0.0, position_walk=usual.position_walk * factor
        )
        walked = drifting_odometry(truth, config, np.random.default_rng([seed, 41]))
        odometry = rescaled(walked, 1.0 + (-1) ** seed * usual.scale_error * factor)
        factor *= share / drift_share(truth, odometry)
    return odometry


def rescaled(odometry: Floats, factor: float) -> Floats:
    """Return odometry whose every step is ``factor`` times as long."""
    out: Floats = odometry.copy()
    origin = odometry[0, :3, 3]
    out[:, :3, 3] = origin + factor * (odometry[:, :3, 3] - origin)
    return out


def rejoined(odometry: Floats, at: int, T_odom_body: Pose) -> Floats:
    """Return odometry that goes on at ``T_odom_body`` (place and heading) from the frame ``at`` on; it stays level."""
    turn = rot_z(yaw_of(T_odom_body) - yaw_of(odometry[at]))
    joint = pose_from(turn, T_odom_body[:3, 3] - turn @ odometry[at, :3, 3])
    return np.concatenate([odometry[:at], joint @ odometry[at:]])


def kidnapped(drive: Drive, at: int, to: int) -> Drive:
    """From the frame ``at`` on the robot is where it was at ``to``; by its odometry it stood still meanwhile."""
    pick = np.r_[0:at, to : len(drive)]
    odometry = rejoined(drive.odometry[pick], at, drive.odometry[at - 1])
    way = np.concatenate([drive.driven[:at], drive.driven[to:] - drive.driven[to] + drive.driven[at - 1]])
    count = len(pick)
    return Drive(
        drive.frames[pick], drive.stamps[:count], drive.truth[pick], odometry, way, drive.cover[pick],
        (*drive.events, Event("kidnapped", at, at)),
    )  # fmt: skip


def carried(drive: Drive, at: int, to: int) -> Drive:
    """From ``at`` to ``to`` the robot is carried with open eyes: odometry stands still, only its tilt goes on."""
    odometry = rejoined(drive.odometry, to, drive.odometry[at - 1])
    for k in range(at, to):
        level = rot_z(yaw_of(odometry[at - 1]) - yaw_of(drive.odometry[k]))
        odometry[k] = pose_from(level @ drive.odometry[k, :3, :3], odometry[at - 1, :3, 3])
    way = drive.driven.copy()
    way[at:to] = way[at - 1]
    way[to:] -= drive.driven[to] - way[at - 1]
    return replace(drive, odometry=odometry, driven=way, events=(*drive.events, Event("carried", at, to)))


def covered(drive: Drive, begin: int, end: int, cover: int) -> Drive:
    """Something lies over the sensor from ``begin`` to ``end``; the robot drives on."""
    over = drive.cover.copy()
    over[begin:end] = cover
    return replace(drive, cover=over, events=(*drive.events, Event("covered", begin, end)))


def jumped(drive: Drive, at: int, metres: tuple[float, float], degrees: float) -> Drive:
    """Odometry jumps between two frames: ``metres`` forward and to the left, and a turn."""
    step = pose_from(rot_z(np.radians(degrees)), [*metres, 0.0])
    odometry = rejoined(drive.odometry, at, drive.odometry[at] @ step)
    return replace(drive, odometry=odometry, events=(*drive.events, Event("odometry jump", at, at)))


def restarted(drive: Drive, at: int) -> Drive:
    """Odometry starts again at its zero."""
    odometry = rejoined(drive.odometry, at, np.eye(4))
    return replace(drive, odometry=odometry, events=(*drive.events, Event("odometry reset", at, at)))


def scaled(drive: Drive, factor: float) -> Drive:
    """Odometry drives ``factor`` times as far as the robot."""
    return replace(drive, odometry=rescaled(drive.odometry, factor))


def over_the_gap(drive: Drive) -> Drive:
    """Mark where the drive leads through the gap of the map (see :func:`bench.tracking.worlds.in_gap`)."""
    inside = np.r_[False, in_gap(drive.truth, drive.truth[:, :3, 3]), False].astype(int)
    begins, ends = np.flatnonzero(np.diff(inside) == 1), np.flatnonzero(np.diff(inside) == -1)
    events = [
        Event("map gap", int(begin), int(end))
        for begin, end in zip(begins, ends, strict=True)
        if end < len(drive) and drive.driven[end] - drive.driven[begin] >= _LEAST_GAP
    ]
    return replace(drive, events=(*drive.events, *events))


def seen(points: Points, cover: int, frame: int) -> Points:
    """Return what is left of a frame under a cover: (K, 3), seeded by the frame's number."""
    rng = np.random.default_rng([frame, 51])
    if cover == DUST:
        return points[np.sort(rng.choice(len(points), min(_DUST_POINTS, len(points)), replace=False))]
    if cover == CLOTH:
        near = rng.uniform(0.5, 0.9, len(points)) / np.linalg.norm(points, axis=1)
        return np.asarray((points * near[:, None]).astype(np.float32))
    return points
