"""Feeds a recorded run as a live robot: frames on absolute deadlines, odometry just before its frame."""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from coview_stream.errors import CloudError
from coview_stream.messages.types import Encoded
from coview_stream.recordings.run import Run
from coview_stream.stream.client.replay_schedule import Beat, ReplayConfig, beats
from coview_stream.stream.client.sender import Sender, nanoseconds

_KEPT = 100_000  # of each kind of measurement: a replay in a loop may run for days
_LATE = 0.02  # seconds; a live lidar's own jitter stays below


class Clock(Protocol):
    """Time as the replay sees it; the tests have one of their own."""

    def now(self) -> float:
        """Seconds, steady."""
        ...

    def wait(self, seconds: float) -> bool:
        """Let ``seconds`` pass (none if not positive); True as soon as the replay is to end."""
        ...


@dataclass
class ReplayReport:
    """What a replay did.

    Attributes:
        frames: clouds sent.
        odometry: odometry samples sent.
        points: in all clouds sent.
        damaged: frames that could not be read, or have no finite point, and so were not sent.
        first_error: of these, or None.
        seconds: from the first message to the last.
        put_ms: how long publishing each cloud took, milliseconds.
        late_ms: how long after its deadline each frame was sent, milliseconds.
        finished: False if it was told to end before its end.
        heard: False if nobody is known to have listened; whoever has looked says so.
    """

    frames: int = 0
    odometry: int = 0
    points: int = 0
    damaged: int = 0
    first_error: CloudError | None = None
    seconds: float = 0.0
    put_ms: deque[float] = field(default_factory=lambda: deque(maxlen=_KEPT))
    late_ms: deque[float] = field(default_factory=lambda: deque(maxlen=_KEPT))
    finished: bool = False
    heard: bool = True

    def text(self) -> str:
        """Summary in a few lines."""
        rate = f" ({(self.frames - 1) / self.seconds:.2f} Hz)" if self.frames > 1 and self.seconds else ""
        lines = [
            f"{self.frames} frames{rate} and {self.odometry} odometry samples sent in {self.seconds:.1f} s"
            + ("" if self.finished else ", ended early"),
            f"put {_spread(self.put_ms)}; behind schedule {_spread(self.late_ms)}",
        ]
        late = sum(ms > 1e3 * _LATE for ms in self.late_ms)
        if late:
            lines.append(
                f"{late} frames were sent more than {1e3 * _LATE:.0f} ms late: is the machine busy, or the disk slow?"
            )
        if self.damaged:
            lines.append(f"{self.damaged} damaged frames left out, the first: {self.first_error}")
        if not self.heard:
            lines.append(
                "nobody listened: is a node running, connected, and for this --robot, --base and --preset?"
            )
        return "\n".join(lines)


@dataclass(frozen=True)
class _Parcel:
    """A beat with its messages encoded."""

    due: float
    odometry: Encoded | None
    cloud: Encoded | None = None
    points: int = 0
    error: CloudError | None = None


def replay(
    run: Run,
    sender: Sender,
    config: ReplayConfig,
    clock: Clock,
    on_frame: Callable[[int], None] = lambda frames: None,
) -> ReplayReport:
    """Send the whole run, or until the clock says to end.

    A frame that is behind its deadline is sent at once; deadlines do not move. ``on_frame`` gets the number of frames
    sent so far.

    Raises:
        CloudError: not one frame could be read.
        InputError: a stamp of the run is not in seconds, or a pose no rigid transform.
    """
    report = ReplayReport()
    with _ReadAhead(_parcels(run, sender, config), config.read_ahead) as parcels:
        start: float | None = None
        for parcel in parcels:
            if start is None:
                start = clock.now()  # after the first read, which may be slow
            if clock.wait(start + parcel.due - clock.now()):
                break
            report.late_ms.append(1e3 * (clock.now() - start - parcel.due))
            _send(parcel, sender, clock, report)
            report.seconds = clock.now() - start
            on_frame(report.frames)
        else:
            report.finished = True
    if report.first_error is not None and not report.frames:
        raise report.first_error
    return report


def _send(parcel: _Parcel, sender: Sender, clock: Clock, report: ReplayReport) -> None:
    if parcel.odometry is not None:
        sender.put_odometry(parcel.odometry)
        report.odometry += 1
    if parcel.error is not None:
        report.damaged += 1
        report.first_error = report.first_error or parcel.error
    if parcel.cloud is not None:
        before = clock.now()
        sender.put_cloud(parcel.cloud)
        report.put_ms.append(1e3 * (clock.now() - before))
        report.frames += 1
        report.points += parcel.points


def _parcels(run: Run, sender: Sender, config: ReplayConfig) -> Iterator[_Parcel]:
    for beat in beats(run, config):
        stamp = nanoseconds(beat.stamp)
        odometry = None if config.clouds_only else sender.odometry(beat.T_odom_body, stamp)
        yield _parcel(run, beat, sender, odometry)


def _parcel(run: Run, beat: Beat, sender: Sender, odometry: Encoded | None) -> _Parcel:
    if beat.frame is None:
        return _Parcel(beat.due, odometry)
    try:
        points = run.read(beat.frame).points
        cloud = sender.cloud(points, nanoseconds(beat.stamp))
    except CloudError as error:
        return _Parcel(beat.due, odometry, error=error)
    return _Parcel(beat.due, odometry, cloud, len(points))


class _ReadAhead:
    """Runs an iterator on a thread of its own, ``size`` items ahead, so that a slow disk does not disturb the clock."""

    def __init__(self, source: Iterator[_Parcel], size: int) -> None:
        self._source = source
        self._ready: queue.Queue[_Parcel | BaseException | None] = queue.Queue(size)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._fill, name="replay-reader", daemon=True)

    def __enter__(self) -> _ReadAhead:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join(timeout=5.0)

    def __iter__(self) -> Iterator[_Parcel]:
        while (item := self._ready.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item

    def _fill(self) -> None:
        try:
            for parcel in self._source:
                if not self._offer(parcel):
                    return
            self._offer(None)
        except Exception as error:  # whatever it is, it belongs to the thread that reads
            self._offer(error)

    def _offer(self, item: _Parcel | BaseException | None) -> bool:
        while not self._ended.is_set():
            try:
                self._ready.put(item, timeout=0.1)
            except queue.Full:
                continue
            return True
        return False


def _spread(values: deque[float]) -> str:
    if not values:
        return "-"
    p50, p99 = np.percentile(values, [50, 99])
    return f"p50 {p50:.1f} ms, p99 {p99:.1f} ms, max {max(values):.1f} ms"
