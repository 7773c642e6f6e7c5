"""Drives with events, made of the frames of a simulated one.

Frames and truth are the simulator's; odometry is drawn with a chosen drift and then jumps, starts again, is out of
scale or stands still while the robot is carried.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.accuracy.scores import Track
from bench.tracking.worlds import Recorded, World, in_gap
from coview_stream import BaseMap, Localizer
from coview_stream.clouds.cloud import Cloud
from coview_stream.config import LocalizerConfig
from coview_stream.errors import CloudError, RunError
from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.transforms import Pose, inverse, pose_from, rot_z, yaw_of
from coview_stream.localization.result import Fix
from coview_stream.odometry.deskew import SweepCorrection
from coview_stream.recordings.run import Run
from coview_stream.report.evaluation import driven
from coview_stream.sim.odometry import OdometryConfig, drifting_odometry
from coview_stream.sim.sensors import FRAME_PERIOD

SEGMENT = 100.0  # metres over which drift is measured
EVENT_AT = 90.0  # metres
CLEAR, CLOTH, DUST, FOG = range(4)  # cover: nothing; a cloth at 0.5 to 0.9 m; 20 returns are left; nothing beyond 12 m
_DUST_POINTS = 20
_SIGHT = 12.0  # metres, in fog
_MIN_GAP = 20.0  # metres in the gap that count as an event
_COVERED_S = 30.0
_FIRST_STAMP = 1000.0


@dataclass(frozen=True)
class Drive:
    """Frames as the robot gets them."""

    frames: Ints  # (K,) which of the recorded ones
    stamps: Floats  # (K,) seconds
    truth: Floats  # (K, 4, 4) map <- body
    odometry: Floats  # (K, 4, 4) odom <- body
    driven: Floats  # (K,) metres on its own wheels up to each frame
    cover: Ints  # (K,) cover of the sensor
    events: tuple[int, ...] = ()  # frames at which an event is over, and recovery begins

    def __len__(self) -> int:
        return len(self.frames)

    def at(self, metres: float) -> int:
        """First frame after so many metres; the last one if the drive is shorter."""
        return min(int(np.searchsorted(self.driven, metres)), len(self) - 1)

    def until(self, metres: float) -> Drive:
        """Return the drive's first ``metres``."""
        return self.picked(np.arange(self.at(metres) + 1))

    def picked(self, rows: Ints) -> Drive:
        """Return some of the frames, in the time that as many take."""
        arrays: dict[str, Any] = {name: each[rows] for name, each in vars(self).items() if name != "events"}
        return replace(self, **arrays | {"stamps": self.stamps[: len(rows)]})

    def after(self, end: int, **changes: Any) -> Drive:
        """Return the drive with an event that is over at the frame ``end``, and with the arrays that it changed."""
        return replace(self, **changes, events=(*self.events, end))


def start(truth: Floats, drift: float, seed: int) -> Drive:
    """Drive as recorded: (N, 4, 4) map <- body, with odometry that drifts by that share of the distance."""
    frames = np.arange(len(truth))
    stamps = _FIRST_STAMP + FRAME_PERIOD * frames.astype(np.float64)
    return Drive(frames, stamps, truth, drifting(truth, drift, seed), driven(truth), np.zeros_like(frames))


def drift_share(truth: Floats, odometry: Floats) -> float:
    """Mean over all stretches of 100 m (at most half of the drive) of odometry's error at their end, as a share."""
    way = driven(truth)
    over = min(SEGMENT, way[-1] / 2)
    errors = []
    for first in range(0, int(np.searchsorted(way, way[-1] - over)), 10):
        last = int(min(np.searchsorted(way, way[first] + over), len(way) - 1))
        true, measured = (inverse(T[first]) @ T[last] for T in (truth, odometry))
        errors.append(float(np.linalg.norm(true[:3, 3] - measured[:3, 3])) / over)
    return float(np.mean(errors))


def drifting(truth: Floats, share: float, seed: int) -> Floats:
    """Return odometry (N, 4, 4) with the simulator's errors, all scaled alike until it drifts by ``share``.

    Its scale is off by its sigma, not by a draw: with one near zero all of the drift would be a heading that trembles.
    """
    usual, factor = OdometryConfig(), share / 0.015
    for _ in range(5):
        walks = {"yaw_walk": usual.yaw_walk * factor, "position_walk": usual.position_walk * factor}
        walked = drifting_odometry(truth, replace(usual, scale_error=0.0, **walks), np.random.default_rng([seed, 41]))
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


def kidnapped(drive: Drive, to: float = 250.0, until: float = 370.0) -> Drive:
    """Put the robot down where it is after ``to`` metres; by its odometry it stood still meanwhile."""
    drive = drive.until(until)
    at, there = drive.at(EVENT_AT), drive.at(to)
    rows = np.r_[0:at, there : len(drive)]
    way = np.r_[drive.driven[:at], drive.driven[there:] - drive.driven[there] + drive.driven[at - 1]]
    odometry = rejoined(drive.odometry[rows], at, drive.odometry[at - 1])
    return drive.picked(rows).after(at, odometry=odometry, driven=way)


def carried(drive: Drive) -> Drive:
    """Carry the robot 40 m with open eyes: odometry stands still, only its tilt goes on."""
    drive = drive.until(EVENT_AT + 160.0)
    at, to = drive.at(EVENT_AT), drive.at(EVENT_AT + 40.0)
    odometry = rejoined(drive.odometry, to, drive.odometry[at - 1])
    for k in range(at, to):
        level = rot_z(yaw_of(odometry[at - 1]) - yaw_of(drive.odometry[k]))
        odometry[k] = pose_from(level @ drive.odometry[k, :3, :3], odometry[at - 1, :3, 3])
    way = drive.driven.copy()
    way[at:to] = way[at - 1]
    way[to:] -= drive.driven[to] - way[at - 1]
    return drive.after(to, odometry=odometry, driven=way)


def covered(drive: Drive, cover: int) -> Drive:
    """Lay something over the sensor for half a minute; the robot drives on."""
    begin = drive.at(EVENT_AT)
    end = min(begin + round(_COVERED_S / FRAME_PERIOD), len(drive) - 1)
    over = drive.cover.copy()
    over[begin:end] = cover
    return drive.after(end, cover=over).until(float(drive.driven[end]) + 100.0)


def jumped(drive: Drive) -> Drive:
    """Let odometry jump between two frames: 3 m forward, 1 m to the left, and a turn of 15 degrees."""
    drive = drive.until(EVENT_AT + 120.0)
    at, step = drive.at(EVENT_AT), pose_from(rot_z(np.radians(15.0)), [3.0, 1.0, 0.0])
    return drive.after(at, odometry=rejoined(drive.odometry, at, drive.odometry[at] @ step))


def slipped(drive: Drive) -> Drive:
    """Let odometry slip every 30 m: sideways by 0.8 to 3.2 m, to either side, and round by 2 to 8 degrees."""
    drive = drive.until(300.0)
    for number, metres in enumerate(np.arange(30.0, 271.0, 30.0)):
        at, size, side = drive.at(float(metres)), 0.8 * (1 + number % 4), (-1.0) ** number
        step = pose_from(rot_z(np.radians(-2.5 * size * side)), [0.0, size * side, 0.0])
        drive = drive.after(at, odometry=rejoined(drive.odometry, at, drive.odometry[at] @ step))
    return drive


def restarted(drive: Drive) -> Drive:
    """Let odometry start again at its zero."""
    drive = drive.until(EVENT_AT + 120.0)
    at = drive.at(EVENT_AT)
    return drive.after(at, odometry=rejoined(drive.odometry, at, np.eye(4)))


def scaled(drive: Drive) -> Drive:
    """Let odometry drive 5 % too far."""
    drive = drive.until(300.0)
    return replace(drive, odometry=rescaled(drive.odometry, 1.05))


def over_the_gap(drive: Drive) -> Drive:
    """Mark where the drive leads through the gap of the map (see :func:`bench.tracking.worlds.in_gap`)."""
    inside = np.r_[False, in_gap(drive.truth, drive.truth[:, :3, 3]), False].astype(int)
    for begin, end in zip(np.flatnonzero(np.diff(inside) == 1), np.flatnonzero(np.diff(inside) == -1), strict=True):
        if end < len(drive) and drive.driven[end] - drive.driven[begin] >= _MIN_GAP:
            drive = drive.after(int(end))
    return drive.until(340.0)


SEEDS = 5000  # what reported seeds follow; this one itself, of ``--quick``, is in no table
_WHOLE = partial(Drive.until, metres=float("inf"))
_FIRST_300 = partial(Drive.until, metres=300.0)


class Scenario(NamedTuple):
    """A drive through a world, on one of its maps; ``drift`` of its odometry before anything else befalls it."""

    name: str
    world: World
    change: Callable[[Drive], Drive]
    drift: float
    variant: str = "plain"


_EVENTS: dict[str, tuple[Callable[[Drive], Drive], tuple[str, ...], float, str]] = {
    "kidnap": (kidnapped, ("town", "campus", "forest"), 0.01, "plain"),
    "carried": (carried, ("town",), 0.01, "plain"),
    "gap": (over_the_gap, ("town", "campus"), 0.01, "gap"),
    "covered": (partial(covered, cover=CLOTH), ("campus", "forest"), 0.01, "plain"),
    "dust": (partial(covered, cover=DUST), ("town",), 0.01, "plain"),
    "changed": (_FIRST_300, ("town", "campus", "forest"), 0.01, "changed"),
    "jump": (jumped, ("town", "forest"), 0.01, "plain"),
    "slip": (slipped, ("town", "campus", "forest"), 0.01, "plain"),
    "slip, changed": (slipped, ("town", "campus", "forest"), 0.01, "changed"),
    "reset": (restarted, ("campus",), 0.01, "plain"),
    "scale": (scaled, ("town", "forest"), 0.005, "plain"),
}
"""Event, places, drift of odometry, map."""


def worlds(seeds: int = SEEDS) -> tuple[World, ...]:
    """Ten worlds of the seeds that follow ``seeds``: kind, lidar, seed, metres wide, metres driven, m/s, drift."""
    return (
        World("town", "vlp16", seeds + 1, 240.0, 400.0, 2.0, 0.005),
        World("town", "os64", seeds + 2, 300.0, 600.0, 3.0, 0.02),
        World("town", "mid360", seeds + 3, 240.0, 300.0, 2.0, 0.03),
        World("town", "os64", seeds + 4, 240.0, 300.0, 1.5, 0.05),
        World("campus", "vlp16", seeds + 5, 300.0, 400.0, 2.0, 0.01),
        World("campus", "os64", seeds + 6, 300.0, 500.0, 2.5, 0.03),
        World("campus", "mid360", seeds + 7, 240.0, 300.0, 2.0, 0.05),
        World("sparse-forest", "os64", seeds + 8, 240.0, 400.0, 2.0, 0.01),
        World("sparse-forest", "vlp16", seeds + 9, 240.0, 300.0, 2.0, 0.02),
        World("sparse-forest", "os64", seeds + 10, 300.0, 300.0, 2.0, 0.05),
    )


def scenarios(seeds: int = SEEDS, quick: bool = False) -> tuple[Scenario, ...]:
    """Plain drives through all worlds of the seeds that follow ``seeds``, and all events; ``quick``: a small town."""
    if quick:
        small = World("town", "vlp16", SEEDS, 160.0, 120.0, 2.0, 0.02)
        kidnap = partial(kidnapped, to=115.0, until=120.0)
        return Scenario("plain/quick", small, _WHOLE, small.drift), Scenario("kidnap/quick", small, kidnap, 0.01)
    all_worlds = worlds(seeds)
    where = {"town": all_worlds[0], "campus": all_worlds[5], "forest": all_worlds[7]}
    return (
        *(Scenario(f"plain/{w.kind}-{w.sensor}-{w.seed}", w, _WHOLE, w.drift) for w in all_worlds),
        *(
            Scenario(f"{event}/{place}", where[place], change, drift, variant)
            for event, (change, places, drift, variant) in _EVENTS.items()
            for place in places
        ),
    )


@dataclass(frozen=True)
class DriveClouds:
    """Clouds of a drive, as the source of a run."""

    recorded: Recorded
    drive: Drive

    def read(self, index: int, correction: SweepCorrection | None = None) -> Cloud:
        """Frame as the robot gets it: under a cover, perhaps."""
        frame, cover = int(self.drive.frames[index]), self.drive.cover[index]
        cloud, rng = self.recorded.read(frame), np.random.default_rng([frame, 51])
        if cover == DUST:
            cloud = cloud[np.sort(rng.choice(len(cloud), min(_DUST_POINTS, len(cloud)), replace=False))]
        if cover == CLOTH:
            near = rng.uniform(0.5, 0.9, len(cloud)) / np.linalg.norm(cloud, axis=1)
            cloud = (cloud * near[:, None]).astype(np.float32)
        if cover == FOG:
            cloud = cloud[np.linalg.norm(cloud, axis=1) < _SIGHT]
        return Cloud(cloud, np.zeros(3))


def run_of(recorded: Recorded, drive: Drive) -> Run:
    """Return a drive as a run."""
    clouds = DriveClouds(recorded, drive)
    return Run(Path("drive"), (Path("drive"),) * len(drive), drive.stamps, drive.odometry, clouds)


def follow(site: Path, recorded: Recorded, drive: Drive, config: LocalizerConfig | None = None) -> Track:
    """Feed frames and odometry of a drive to a new localizer, and nothing else; collect its answers."""
    localizer, fixes = Localizer(BaseMap.load(site), config), list[Fix | None]()
    for frame in run_of(recorded, drive):
        try:
            fixes.append(localizer.step(frame.points, frame.T_odom_body, frame.stamp))
        except (CloudError, RunError):
            fixes.append(None)
    return Track.of(fixes, drive.stamps)
