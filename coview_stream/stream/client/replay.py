"""Replay of a recorded run as a live robot: frames on absolute deadlines, odometry just before its frame."""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from coview_stream.errors import CloudError
from coview_stream.messages.types import Encoded
from coview_stream.recordings.run import Run
from coview_stream.stream.client.replay_schedule import ReplayConfig, schedule
from coview_stream.stream.client.sender import Sender, nanoseconds

# set by hand
_MAX_MEASUREMENTS = 100_000  # of each kind: a replay in a loop may run for days
_LATE = 0.02  # seconds; a live lidar's own jitter stays below


class Clock(Protocol):
    """Time of a replay."""

    def now(self) -> float:
        """Return seconds of a monotonic clock."""
        ...

    def wait(self, seconds: float) -> bool:
        """Wait for ``seconds`` (not at all if not positive); True as soon as the replay is to end."""
        ...


@dataclass
class ReplayReport:
    """Result of a replay.

    Attributes:
        frames: clouds sent.
        odometry: odometry samples sent.
        points: in all clouds sent.
        damaged: frames not sent: they cannot be read, or have no finite point.
        first_error: of the damaged frames, None without any.
        seconds: from the first message to the last.
        put_ms: duration of publishing each cloud, milliseconds.
        late_ms: delay of each sample after its deadline, milliseconds.
        finished: False if it was ended before its last frame.
        heard: False if there was no subscriber; set by the caller, who has looked.
    """

    frames: int = 0
    odometry: int = 0
    points: int = 0
    damaged: int = 0
    first_error: CloudError | None = None
    seconds: float = 0.0
    put_ms: deque[float] = field(default_factory=lambda: deque(maxlen=_MAX_MEASUREMENTS))
    late_ms: deque[float] = field(default_factory=lambda: deque(maxlen=_MAX_MEASUREMENTS))
    finished: bool = False
    heard: bool = True

    def text(self) -> str:
        """Summarize in a few lines."""
        rate = f" ({(self.frames - 1) / self.seconds:.2f} Hz)" if self.frames > 1 and self.seconds else ""
        lines = [
            f"{self.frames} frames{rate} and {self.odometry} odometry samples sent in {self.seconds:.1f} s"
            + ("" if self.finished else ", ended early"),
            f"put {_percentiles(self.put_ms)}; behind schedule {_percentiles(self.late_ms)}",
        ]
        late = sum(ms > 1e3 * _LATE for ms in self.late_ms)
        if late:
            lines.append(
                f"{late} frames were sent more than {1e3 * _LATE:.0f} ms late: is the machine busy, or the disk slow?"
            )
        if self.damaged:
            lines.append(f"{self.damaged} damaged frames left out, the first: {self.first_error}")
        if not self.heard:
            lines.append("nothing subscribed: is a node running, connected, and for this --robot, --base and --preset?")
        return "\n".join(lines)


@dataclass(frozen=True)
class _EncodedSample:
    """A scheduled sample with its messages encoded; ``error`` in place of a damaged cloud."""

    due: float
    odometry: Encoded | None
    cloud: Encoded | None = None
    points: int = 0
    error: CloudError | None = None


def replay(
    run: Run, sender: Sender, config: ReplayConfig, clock: Clock, on_frame: Callable[[int], None] = lambda frames: None
) -> ReplayReport:
    """Send the whole run, or until the clock says to end.

    A frame behind its deadline is sent at once; deadlines do not move. ``on_frame`` gets the number of frames sent so
    far.

    Raises:
        CloudError: no frame can be read.
        InputError: a stamp of the run is not in seconds, or a pose no rigid transform.
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
            _send(sample, sender, clock, report)
            report.seconds = clock.now() - start
            on_frame(report.frames)
        else:
            report.finished = True
    if report.first_error is not None and not report.frames:
        raise report.first_error
    return report


def _send(sample: _EncodedSample, sender: Sender, clock: Clock, report: ReplayReport) -> None:
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
    """Iterator run on a thread of its own, ``size`` items ahead, so that a slow disk does not delay the replay."""

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
        except Exception as error:  # of any kind: it is raised on the thread that reads
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
