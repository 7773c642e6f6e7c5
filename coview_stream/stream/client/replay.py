"""Replay of a recorded run as a live robot: frames on absolute deadlines, odometry just before each frame."""

from __future__ import annotations

import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from coview_stream.errors import CloudError, ConfigError, counted
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, interpolate
from coview_stream.messages.json_messages import read_object
from coview_stream.messages.types import Encoded, Sample
from coview_stream.recordings.run import Run
from coview_stream.stream.client.sender import Sender, nanoseconds
from coview_stream.stream.transport.keys import ANY, node_keys
from coview_stream.stream.transport.transport import Transport

_USUAL_RATE = 20.0  # Hz, of odometry
_SINGLE_FRAME_PERIOD = 0.1  # seconds between repetitions of a run of one frame


@dataclass(frozen=True)
class ReplayConfig:
    """Settings of a replay.

    Attributes:
        rate: frames sent per second; None keeps the spacing of the run's stamps.
        speed: divides that spacing; 2 sends a run in half its time. Excludes ``rate``.
        odometry_rate: odometry samples sent per second, interpolated between frames; None: one per frame.
        clouds_only: send no odometry; the node makes its own.
        loop: repeat for ever; stamps keep increasing, and the robot is back at its start.
        read_ahead: number of frames read and encoded ahead of time.
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
    """An odometry sample of a replay, with or without a frame."""

    due: float  # seconds after the start of the replay
    stamp: float  # seconds of sensor time
    T_odom_body: Pose  # (4, 4), odometry <- body, metres
    frame: int | None  # index in the run; None between frames


def schedule(run: Run, config: ReplayConfig) -> Iterator[ScheduledSample]:
    """Yield every sample in order, for ever if ``config.loop`` is set."""
    dues = frame_times(run, config)
    # a lap is one period longer than its frames: from its last frame to the first of the next lap
    lap_due = float(dues[-1]) + _period(dues, 1.0 / config.rate if config.rate else _SINGLE_FRAME_PERIOD)
    lap_stamp = float(run.stamps[-1] - run.stamps[0]) + _period(run.stamps, _SINGLE_FRAME_PERIOD)
    lap = 0
    while True:
        for k in range(len(run)):
            samples: list[tuple[float, float, Pose, int | None]]
            samples = [(float(dues[k]), float(run.stamps[k]), run.poses[k], k)]
            # none after the last frame: the robot did not drive back to the start
            count = round((dues[k + 1] - dues[k]) * (config.odometry_rate or 0.0)) if k + 1 < len(run) else 0
            for share in np.arange(1, count) / max(count, 1):
                due, stamp = (float(a[k] + share * (a[k + 1] - a[k])) for a in (dues, run.stamps))
                samples.append((due, stamp, interpolate(run.poses[k], run.poses[k + 1], share), None))
            for due, stamp, pose, frame in samples:
                yield ScheduledSample(lap * lap_due + due, lap * lap_stamp + stamp, pose, frame)
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
    """Return the usual time between odometry samples, seconds: sensor time or real time, whichever is longer."""
    dues = frame_times(run, config)
    real = _period(dues, 0.0)
    parts = max(1, round(real * (config.odometry_rate or 0.0)))
    return max(real, _period(run.stamps, 0.0)) / parts


def enough_odometry(run: Run, config: ReplayConfig) -> float:
    """Return the odometry rate, Hz, that spaces samples by 0.05 s of sensor or real time, whichever is longer."""
    parts = max(1, round(_USUAL_RATE * odometry_spacing(run, replace(config, odometry_rate=None))))
    return parts / max(_period(frame_times(run, config), 1.0), 1e-3)


def _period(times: Floats, single: float) -> float:
    return float(np.median(np.diff(times))) if len(times) > 1 else single


_SILENT = 3.0  # seconds: a node reports its health once a second


def await_engines(
    transport: Transport, base: str, robot: str, seconds: float, wait: Callable[[float], object] = time.sleep
) -> bool:
    """Wait up to ``seconds`` until a node that serves the robot reports ready engines; False if those heard do not.

    True after three seconds without the health of such a node, because then another program has subscribed. ``wait`` as
    in :meth:`Transport.await_subscriber`; if it ends the wait, the result is True.
    """
    told = dict[str, bool]()  # whether ready, by key, for the nodes that serve the robot

    def hear(sample: Sample) -> None:
        document = read_object(sample.payload)
        if robot in document.get("robots", ()):
            told[sample.key] = document["ready"]["ok"] is True

    end = transport.subscribe(node_keys(base, ANY).health, hear, "all")
    try:
        begin = time.monotonic()
        while True not in tuple(told.values()):
            if time.monotonic() - begin >= (seconds if told else _SILENT):
                return not told
            if wait(0.1):
                break
    finally:
        end()
    return True


_MAX_MEASUREMENTS = 100_000  # of each kind: a looped replay may run for days
_LATE = 0.02  # seconds; more than a live lidar's own jitter


class Clock(Protocol):
    """Time of a replay."""

    def now(self) -> float:
        """Return seconds of a monotonic clock."""
        ...

    def wait(self, seconds: float) -> bool:
        """Wait for ``seconds`` (not at all if not positive); True once the replay is to end."""
        ...


@dataclass
class ReplayReport:
    """Result of a replay."""

    frames: int = 0  # clouds sent
    odometry: int = 0  # odometry samples sent
    points: int = 0  # in all clouds sent together
    damaged: int = 0  # frames not sent: unreadable, or without a finite point
    first_error: CloudError | None = None  # among the damaged frames
    seconds: float = 0.0  # from the first message to the last
    # milliseconds to publish each cloud, and after its deadline until each sample was sent
    put_ms: deque[float] = field(default_factory=lambda: deque(maxlen=_MAX_MEASUREMENTS))
    late_ms: deque[float] = field(default_factory=lambda: deque(maxlen=_MAX_MEASUREMENTS))
    finished: bool = False  # False if it ended before its last frame
    heard: bool = True  # False if there was no subscriber; set by the caller, who checks

    def text(self) -> str:
        """Summarize the replay in a few lines."""
        rate = f" ({(self.frames - 1) / self.seconds:.2f} Hz)" if self.frames > 1 and self.seconds else ""
        sent = f"{counted(self.frames, 'frame')}{rate} and {counted(self.odometry, 'odometry sample')} sent"
        lines = [
            f"{sent} in {self.seconds:.1f} s" + ("" if self.finished else ", ended early"),
            f"put {_percentiles(self.put_ms)}; behind schedule {_percentiles(self.late_ms)}",
        ]
        late = sum(ms > 1e3 * _LATE for ms in self.late_ms)
        if late:
            said = f"more than {1e3 * _LATE:.0f} ms late: {counted(late, 'sample')}"
            lines.append(f"{said}; is the machine busy, or the disk slow?")
        if self.damaged:
            lines.append(f"{self.damaged} damaged frames left out, the first: {self.first_error}")
        if not self.heard:
            lines.append("nothing subscribed: is a node running, connected, and for this --robot, --base and --preset?")
        return "\n".join(lines)


@dataclass(frozen=True)
class _EncodedSample:
    """A scheduled sample with its encoded messages; ``error`` says why a damaged cloud is missing."""

    due: float
    odometry: Encoded | None
    cloud: Encoded | None = None
    points: int = 0
    error: CloudError | None = None


def replay(
    run: Run, sender: Sender, config: ReplayConfig, clock: Clock, on_frame: Callable[[int], None] = lambda frames: None
) -> ReplayReport:
    """Send the run, until its end or until the clock ends the replay.

    A frame behind its deadline is sent at once; deadlines do not move. ``on_frame`` gets the number of frames sent.

    Raises:
        CloudError: no frame can be read.
        InputError: a stamp of the run is not in seconds, or a pose is not a rigid transform.
    """
    report = ReplayReport()
    with _ReadAhead(_encoded(run, sender, config), config.read_ahead) as samples:
        start: float | None = None
        for sample in samples:
            if start is None:
                start = clock.now()  # after the first read, which may be slow
            if clock.wait(start + sample.due - clock.now()):
                break
            report.late_ms.append(1e3 * (clock.now() - start - sample.due))
            if sample.odometry is not None:
                sender.put_odometry(sample.odometry)
                report.odometry += 1
            if sample.error is not None:
                report.damaged += 1
                report.first_error = report.first_error or sample.error
            if sample.cloud is not None:
                before = clock.now()
                sender.put_cloud(sample.cloud)
                report.put_ms.append(1e3 * (clock.now() - before))
                report.frames += 1
                report.points += sample.points
            report.seconds = clock.now() - start
            on_frame(report.frames)
        else:
            report.finished = True
    if report.first_error is not None and not report.frames:
        raise report.first_error
    return report


def _encoded(run: Run, sender: Sender, config: ReplayConfig) -> Iterator[_EncodedSample]:
    for sample in schedule(run, config):
        stamp = nanoseconds(sample.stamp)
        odometry = None if config.clouds_only else sender.odometry(sample.T_odom_body, stamp)
        encoded = _EncodedSample(sample.due, odometry)
        if sample.frame is not None:
            try:
                points = run.read(sample.frame).points
                encoded = replace(encoded, cloud=sender.cloud(points, stamp), points=len(points))
            except CloudError as error:
                encoded = replace(encoded, error=error)
        yield encoded


class _ReadAhead:
    """Iterator that runs on its own thread, ``size`` items ahead, so that a slow disk does not delay the replay."""

    def __init__(self, source: Iterator[_EncodedSample], size: int) -> None:
        self._source = source
        self._ready: queue.Queue[_EncodedSample | BaseException | None] = queue.Queue(size)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._fill, name="replay-reader", daemon=True)

    def __enter__(self) -> _ReadAhead:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join(timeout=5.0)

    def __iter__(self) -> Iterator[_EncodedSample]:
        while (item := self._ready.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item

    def _fill(self) -> None:
        try:
            for sample in self._source:
                if not self._offer(sample):
                    return
            self._offer(None)
        except Exception as error:  # of any kind: raised again on the reading thread
            self._offer(error)

    def _offer(self, item: _EncodedSample | BaseException | None) -> bool:
        while not self._ended.is_set():
            try:
                self._ready.put(item, timeout=0.1)
            except queue.Full:
                continue
            return True
        return False


def _percentiles(values: deque[float]) -> str:
    if not values:
        return "-"
    p50, p99 = np.percentile(values, [50, 99])
    return f"p50 {p50:.1f} ms, p99 {p99:.1f} ms, max {max(values):.1f} ms"
