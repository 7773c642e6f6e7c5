"""Scores of a recorded stream of poses and statuses: pure functions of the arrivals.

Arrivals are seconds of a monotonic clock of the machine; stamps are nanoseconds of the robot's sensor clock.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from coview_stream.geometry.arrays import Floats

FALSE_METRES, FALSE_DEGREES = 2.0, 5.0  # a pose further from the truth than either is a false one
MAX_MISMATCH_NS = 2_000_000
"""A frame is recognised by its stamp; ages are decimal seconds, which rounds stamps made of them."""


class Posed(NamedTuple):
    """A pose on arrival: (4, 4) map <- body, and the seconds since the frame that corrected it, NaN if unknown."""

    arrival: float
    stamp_ns: int
    T_map_body: Floats
    age: float = math.nan


class Told(NamedTuple):
    """A status on arrival."""

    arrival: float
    fields: dict[str, Any]

    @property
    def state(self) -> str:
        """SEARCHING, AMBIGUOUS, TRACKING or LOST; empty if the status has none."""
        return str(self.fields.get("state", ""))


def errors(poses: Sequence[Posed], truth: Callable[[int], Floats]) -> tuple[Floats, Floats]:
    """Metres and degrees between each pose and the truth at its stamp."""
    if not poses:
        return np.zeros(0), np.zeros(0)
    true, told = np.stack([truth(pose.stamp_ns) for pose in poses]), np.stack([pose.T_map_body for pose in poses])
    apart = np.linalg.inv(true) @ told
    turned = Rotation.from_matrix(apart[:, :3, :3]).magnitude()
    return np.linalg.norm(apart[:, :3, 3], axis=1), np.degrees(turned)


def false_poses(metres: Floats, degrees: Floats) -> int:
    """Count the poses that are too far from the truth; NaN is."""
    return int(np.sum(~((metres <= FALSE_METRES) & (degrees <= FALSE_DEGREES))))


def tracking_intervals(arrivals: Sequence[float], told: Sequence[Told]) -> Floats:
    """Seconds between successive poses, without intervals in which a status tells that the robot is not tracked."""
    untracked = [status.arrival for status in told if status.state != "TRACKING"]
    pairs = itertools.pairwise(arrivals)
    return np.array([end - begin for begin, end in pairs if not any(begin < at < end for at in untracked)])


def rate_hz(intervals: Floats) -> float:
    """Poses per second over those intervals; NaN without any."""
    return float(len(intervals) / intervals.sum()) if len(intervals) else math.nan


def jitter_ms(intervals: Floats) -> float:
    """p99 of the distance of the intervals from 0.1 s, in milliseconds; NaN without any."""
    return percentile_ms(np.abs(intervals - 0.1), 99)


def percentile_ms(seconds: Floats, percent: float) -> float:
    """Percentile in milliseconds; NaN without any."""
    return float(np.percentile(seconds * 1e3, percent)) if len(seconds) else math.nan


def share_posed(arrivals: Sequence[float], begin: float, end: float, bin_s: float = 0.2) -> float:
    """Share of the ``bin_s`` long pieces of ``begin`` to ``end`` that hold a pose."""
    count = max(1, int((end - begin) / bin_s))
    return len({int((at - begin) / bin_s) for at in arrivals if begin <= at < begin + count * bin_s}) / count


def jain(shares: Sequence[float]) -> float:
    """Jain's fairness: 1 if all have the same, 1/n if one has all."""
    squares = sum(share**2 for share in shares)
    return sum(shares) ** 2 / (len(shares) * squares) if squares else 0.0


def reaction(puts: Floats, seen: Sequence[tuple[float, float]]) -> Floats:
    """Seconds from the put of a frame to the first message about it; ``seen`` are (arrival, stamp) in order."""
    newest, first = -math.inf, []
    for arrival, stamp_ns in seen:
        if stamp_ns > newest + MAX_MISMATCH_NS:
            newest = stamp_ns
            first.append((arrival, stamp_ns))
    return staleness(puts, first)


def staleness(puts: Floats, seen: Sequence[tuple[float, float]]) -> Floats:
    """Seconds from the put of a frame to each message about it; unknown frames do not count.

    ``puts`` (N, 2) are stamps and times. The maximum is the worst starvation.
    """
    if not len(puts) or not len(seen):
        return np.zeros(0)
    arrivals, stamps = np.array(seen, dtype=np.float64).T
    apart = np.abs(puts[:, 0] - stamps[:, None])
    known = apart.min(axis=1) <= MAX_MISMATCH_NS
    return np.asarray((arrivals - puts[apart.argmin(axis=1), 1])[known])


def corrected(poses: Sequence[Posed]) -> list[tuple[float, float]]:
    """(arrival, stamp of the frame that last corrected it) of each pose that tells its age."""
    return [(pose.arrival, pose.stamp_ns - pose.age * 1e9) for pose in poses if math.isfinite(pose.age)]


def processed(told: Sequence[Told]) -> list[tuple[float, float]]:
    """(arrival, stamp of the newest processed frame) of each status that tells it."""
    seen = ((status.arrival, status.fields.get("last_frame_ns")) for status in told)
    return [(arrival, float(stamp)) for arrival, stamp in seen if isinstance(stamp, int) and stamp > 0]


def counter(told: Sequence[Told], name: str) -> int | None:
    """Newest value of a counter; None if no status has it."""
    values = ((status.fields.get("counters") or {}).get(name) for status in reversed(told))
    return next((int(value) for value in values if isinstance(value, (int, float))), None)
