"""Counters of a robot's messages, errors, latencies and rates, and an estimate of the frames lost on the way."""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass

import numpy as np

from coview_stream.errors import EncodingError, MessageError
from coview_stream.messages.validation import OversizedError

_MAX_ERRORS = 10  # distinct errors that a status shows
_MAX_LOGGED = 20  # input errors that are ever logged for one robot: its sender may keep inventing new ones
_MAX_DURATIONS = 600  # a minute of frames at 10 Hz
_RESTART_NS = 5_000_000_000  # a stamp farther back than this means a restarted clock
_MAX_SKIPPED = 1000  # sequence numbers missing between two frames: more means a sender that restarted its count
_MAX_GAPS = 15  # newest gaps between frames, whose median is the usual gap
_MIN_GAPS = 5  # needed for a usual gap
_MIN_GAP = 1.5  # usual gaps: a shorter gap is jitter
_MAX_GAP = 100.0  # usual gaps: a longer gap is a pause of the sender
_RATE_WINDOW = 30  # poses over which the rate is taken
_MAX_POSE_AGE = 2.0  # seconds since the newest pose, after which the rate is 0

log = logging.getLogger("coview_stream.node")


@dataclass
class Counters:
    """Counts of received messages, of what became of them, and of events; a message has one outcome.

    Each ``received`` cloud is counted in one of the next eleven fields, except for up to ten that are under way.
    """

    received: int = 0  # clouds
    processed: int = 0  # clouds that went through the localizer
    rejected: int = 0  # readable, but useless to the localizer or to lidar odometry
    dropped: int = 0  # replaced by a newer one
    late: int = 0  # older than the oldest odometry in the buffer
    out_of_order: int = 0  # stamped before the previous cloud
    duplicate: int = 0  # stamped as the previous cloud
    no_odometry: int = 0  # no odometry came for the stamp
    malformed: int = 0  # does not match its encoding
    oversized: int = 0  # beyond the limits on bytes or points
    unknown_encoding: int = 0  # no codec reads its encoding
    engine_errors: int = 0  # an engine failed at it
    missing: int = 0  # estimate of clouds that never arrived, by sequence numbers or gaps between stamps
    odometry_received: int = 0  # odometry samples, received or computed here; the next five as for clouds
    odometry_malformed: int = 0
    odometry_oversized: int = 0
    odometry_unknown_encoding: int = 0
    odometry_duplicate: int = 0
    odometry_out_of_order: int = 0
    odometry_gaps: int = 0  # pauses of odometry too long to interpolate across
    odometry_jumps: int = 0  # samples farther from the previous one than a robot can drive
    clock_restarts: int = 0  # times the sender's clock restarted
    searches: int = 0  # searches of the whole map
    searches_skipped: int = 0  # requests replaced by a newer one
    search_errors: int = 0  # searches that failed
    fixes: int = 0  # times the robot was found
    losses: int = 0  # times it was lost
    poses: int = 0  # poses published
    engine_restarts: int = 0  # times an engine was restarted

    def count(self, name: str) -> None:
        """Add one to a counter."""
        setattr(self, name, getattr(self, name) + 1)

    def to_json(self) -> dict[str, int]:
        """Return the counts as plain data for the status."""
        return dict(vars(self))


class ErrorLog:
    """The newest distinct errors of one robot's input; the first few are logged as well."""

    def __init__(self) -> None:
        self.texts: deque[str] = deque(maxlen=_MAX_ERRORS)
        self._logged: set[str] = set()

    def add(self, text: str, logged: bool = True, kind: str | None = None) -> None:
        """Add an error unless it is present; if ``logged``, log it once, or only the first of its ``kind``."""
        if text not in self.texts:
            self.texts.append(text)
            kind = kind or text
            if logged and len(self._logged) < _MAX_LOGGED and kind not in self._logged:
                self._logged.add(kind)
                log.warning("%s", text)

    def clear(self) -> None:
        """Forget all errors, as they are over; the next one of a kind is shown again, but not logged again."""
        self.texts.clear()

    def add_first(self, kind: str, text: str) -> None:
        """Add only the first error of a kind whose texts all differ."""
        start = f"{kind}; the first: "
        if not any(earlier.startswith(start) for earlier in self.texts):
            self.add(start + text, kind=kind)


class Latency:
    """Percentiles of the newest 600 durations."""

    def __init__(self) -> None:
        self._seconds: deque[float] = deque(maxlen=_MAX_DURATIONS)

    def add(self, seconds: float) -> None:
        """Add one duration, seconds."""
        self._seconds.append(seconds)

    def to_json(self) -> dict[str, float | None]:
        """Return p50, p95 and p99 in milliseconds; null before the first duration."""
        if not self._seconds:
            return {"p50": None, "p95": None, "p99": None}
        p50, p95, p99 = np.percentile(list(self._seconds), [50, 95, 99]) * 1e3
        return {"p50": round(p50, 2), "p95": round(p95, 2), "p99": round(p99, 2)}


class MissingFrames:
    """Estimate of frames that never arrived, from sequence numbers or the usual gap between stamps."""

    def __init__(self) -> None:
        self._gaps: deque[int] = deque(maxlen=_MAX_GAPS)
        self._last: tuple[int, int | None] | None = None

    def add(self, stamp_ns: int, sequence: int | None) -> int:
        """Add a frame; return how many seem to be missing between the previous frame and this one."""
        last = self._last
        if last is not None and last[0] - _RESTART_NS < stamp_ns <= last[0]:
            return 0
        self._last = stamp_ns, sequence
        if last is None or stamp_ns < last[0]:
            return 0
        if sequence is not None and last[1] is not None:
            return max(0, sequence - last[1] - 1) if sequence - last[1] < _MAX_SKIPPED else 0
        gap = stamp_ns - last[0]
        self._gaps.append(gap)
        usual = float(np.median(self._gaps))
        if len(self._gaps) < _MIN_GAPS or not _MIN_GAP < gap / usual < _MAX_GAP:
            return 0
        return round(gap / usual) - 1


def counter_of(error: MessageError) -> str:
    """Return the counter for a message that cannot be decoded."""
    if isinstance(error, EncodingError):
        return "unknown_encoding"
    return "oversized" if isinstance(error, OversizedError) else "malformed"


def last_line(text: str) -> str:
    """Return the last line of a traceback."""
    return (text.strip() or "unknown failure").splitlines()[-1]


class PoseRate:
    """Rate of published poses."""

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=_RATE_WINDOW)

    def add(self, now: float) -> None:
        """Count a pose at local time ``now``."""
        self._times.append(now)

    def rate(self, now: float) -> float:
        """Return poses per second; 0 if the newest pose is too old."""
        span = self._times[-1] - self._times[0] if self._times else 0.0
        if span <= 0.0 or now - self._times[-1] > _MAX_POSE_AGE:
            return 0.0
        return round((len(self._times) - 1) / span, 2)


class Rate:
    """Absolute deadlines of a regular task: one late tick does not delay later ones.

    Args:
        rate: ticks per second.
        now: local time, seconds; the first tick is due at once.
        slack: seconds that it may lag behind and still catch up.
    """

    def __init__(self, rate: float, now: float, slack: float = 0.0) -> None:
        self.period = 1.0 / rate
        self.slack = slack
        self.due = now

    def remaining(self, now: float) -> float:
        """Return the seconds until the next tick, 0 if it is due."""
        return max(0.0, self.due - now)

    def take_tick(self, now: float) -> bool:
        """Take the tick if one is due; return whether it was. Ticks missed in a pause of the machine are skipped."""
        if now < self.due:
            return False
        self.due += self.period
        if now > self.due + self.slack:
            self.due = now + self.period
        return True
