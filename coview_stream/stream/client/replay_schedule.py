"""Schedule of a replay: from a run's stamps to deadlines, without a clock."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from coview_stream.errors import ConfigError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, interpolate
from coview_stream.recordings.run import Run

_SINGLE_FRAME_PERIOD = 0.1  # seconds, set by hand: between repetitions of a run of one frame


@dataclass(frozen=True)
class ReplayConfig:
    """Settings of a replay.

    Attributes:
        rate: frames sent per second; None keeps the spacing of the run's stamps.
        speed: factor on that spacing; 2 sends a run in half its time. Not together with ``rate``.
        odometry_rate: odometry samples sent per second, interpolated between frames; None sends one per frame.
        clouds_only: send no odometry: the node makes its own.
        loop: repeat without end; stamps go on increasing, and the robot is back where it started.
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
class ScheduledSample:
    """An odometry sample of a replay, with a frame or without.

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


def schedule(run: Run, config: ReplayConfig) -> Iterator[ScheduledSample]:
    """Yield every sample in order; without end if ``config.loop`` is set."""
    dues = frame_times(run, config)
    # a lap lasts one period longer than its frames: from the last one to the first of the next lap
    lap_due = float(dues[-1]) + _period(dues, 1.0 / config.rate if config.rate else _SINGLE_FRAME_PERIOD)
    lap_stamp = float(run.stamps[-1] - run.stamps[0]) + _period(run.stamps, _SINGLE_FRAME_PERIOD)
    lap = 0
    while True:
        for sample in _lap(run, dues, config.odometry_rate):
            yield replace(sample, due=lap * lap_due + sample.due, stamp=lap * lap_stamp + sample.stamp)
        if not config.loop:
            return
        lap += 1


def frame_times(run: Run, config: ReplayConfig) -> Floats:
    """Return (N,) seconds after the start at which each frame is due."""
    if config.rate is not None:
        return np.arange(len(run)) / config.rate
    times: Floats = (run.stamps - run.stamps[0]) / config.speed
    return times


def odometry_spacing(run: Run, config: ReplayConfig) -> float:
    """Return the usual seconds between odometry samples, of sensor time or of real time, the longer of both."""
    dues = frame_times(run, config)
    real = _period(dues, 0.0)
    parts = max(1, round(real * (config.odometry_rate or 0.0)))
    return max(real, _period(run.stamps, 0.0)) / parts


def _period(times: Floats, single: float) -> float:
    return float(np.median(np.diff(times))) if len(times) > 1 else single


def _lap(run: Run, dues: Floats, odometry_rate: float | None) -> Iterator[ScheduledSample]:
    for k in range(len(run)):
        yield ScheduledSample(float(dues[k]), float(run.stamps[k]), run.poses[k], k)
        # no sample after the last frame: the robot did not drive back to the start
        if odometry_rate is not None and k + 1 < len(run):
            yield from _between(run, dues, k, odometry_rate)


def _between(run: Run, dues: Floats, k: int, rate: float) -> Iterator[ScheduledSample]:
    count = round((dues[k + 1] - dues[k]) * rate)
    if count < 2:
        return
    for share in np.arange(1, count) / count:
        due, stamp = (a[k] + share * (a[k + 1] - a[k]) for a in (dues, run.stamps))
        yield ScheduledSample(float(due), float(stamp), interpolate(run.poses[k], run.poses[k + 1], share), None)
