"""When a replay sends what: pure, from a run's stamps to deadlines."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from coview_stream.errors import ConfigError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, interpolate
from coview_stream.recordings.run import Run

_LONE_PERIOD = 0.1  # seconds between repetitions of a run of one frame, which has no rate of its own


@dataclass(frozen=True)
class ReplayConfig:
    """How a run is fed.

    Attributes:
        rate: frames sent per second; None keeps the spacing of the run's stamps.
        speed: factor on that spacing; 2 sends a run in half its time. Not together with ``rate``.
        odometry_rate: odometry samples sent per second, interpolated between frames; None sends one per frame.
        clouds_only: send no odometry: the node makes its own.
        loop: start over for ever; stamps go on increasing, and the robot is back where it started.
        read_ahead: frames read and encoded before their time.
    """

    rate: float | None = None
    speed: float = 1.0
    odometry_rate: float | None = None
    clouds_only: bool = False
    loop: bool = False
    read_ahead: int = 8

    def __post_init__(self) -> None:
        for name in ("rate", "speed", "odometry_rate"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and 0 < value <= 10_000):
                option = name.replace("_", "-")
                raise ConfigError(f"--{option} {value!r} is out of range: give a number above 0, up to 10000")
        if self.rate is not None and self.speed != 1.0:
            raise ConfigError("--rate and --speed both say how fast: give one of them")
        if self.clouds_only and self.odometry_rate is not None:
            raise ConfigError("--odometry none and --odometry-rate: give one of them")
        if self.read_ahead < 1:
            raise ConfigError(f"read_ahead is {self.read_ahead}: give at least 1")


@dataclass(frozen=True)
class Beat:
    """One moment of a replay: an odometry sample, and with it a frame or none.

    Attributes:
        due: seconds after the start of the replay.
        stamp: seconds of sensor time.
        T_odom_body: (4, 4), odometry <- body, metres.
        frame: index in the run; None between frames.
    """

    due: float
    stamp: float
    T_odom_body: Pose
    frame: int | None


def beats(run: Run, config: ReplayConfig) -> Iterator[Beat]:
    """Yield every moment in order, for ever if the configuration says so."""
    dues = frame_times(run, config)
    # one more period closes the lap: from the last frame to the first one of the next
    lap_due = float(dues[-1]) + _period(dues, 1.0 / config.rate if config.rate else _LONE_PERIOD)
    lap_stamp = float(run.stamps[-1] - run.stamps[0]) + _period(run.stamps, _LONE_PERIOD)
    lap = 0
    while True:
        for beat in _lap(run, dues, config.odometry_rate):
            yield Beat(lap * lap_due + beat.due, lap * lap_stamp + beat.stamp, beat.T_odom_body, beat.frame)
        if not config.loop:
            return
        lap += 1


def frame_times(run: Run, config: ReplayConfig) -> Floats:
    """(N,) seconds after the start at which each frame is due."""
    if config.rate is not None:
        return np.arange(len(run)) / config.rate
    times: Floats = (run.stamps - run.stamps[0]) / config.speed
    return times


def odometry_spacing(run: Run, config: ReplayConfig) -> float:
    """Seconds from one odometry sample to the next, as a rule: of sensor time or of real time, whichever is longer."""
    dues = frame_times(run, config)
    real = _period(dues, 0.0)
    parts = max(1, round(real * (config.odometry_rate or 0.0)))
    return max(real, _period(run.stamps, 0.0)) / parts


def _period(times: Floats, lone: float) -> float:
    return float(np.median(np.diff(times))) if len(times) > 1 else lone


def _lap(run: Run, dues: Floats, odometry_rate: float | None) -> Iterator[Beat]:
    for k in range(len(run)):
        yield Beat(float(dues[k]), float(run.stamps[k]), run.poses[k], k)
        # nothing after the last frame: the way back to the start was never driven
        if odometry_rate is not None and k + 1 < len(run):
            yield from _between(run, dues, k, odometry_rate)


def _between(run: Run, dues: Floats, k: int, rate: float) -> Iterator[Beat]:
    count = round((dues[k + 1] - dues[k]) * rate)
    if count < 2:
        return
    for share in np.arange(1, count) / count:
        due, stamp = (a[k] + share * (a[k + 1] - a[k]) for a in (dues, run.stamps))
        yield Beat(float(due), float(stamp), interpolate(run.poses[k], run.poses[k + 1], share), None)
