"""A session's scene as plain data, and the interface of its viewers.

Poses and hypotheses are the messages themselves (:class:`~coview_stream.messages.types.PoseMessage`,
:class:`~coview_stream.messages.types.HypothesesMessage`), a status is the node's JSON, and the map is a
:class:`~coview_stream.basemap.summary.MapView`; scans and tracks are defined here.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from coview_stream.basemap.summary import MapView
from coview_stream.geometry.transforms import Points, Pose, interpolate
from coview_stream.messages.types import HypothesesMessage, PoseMessage

_KEPT = 64  # poses of a robot, six seconds at 10 Hz
_TOLERANCE_NS = 150_000_000  # beyond the first or last pose, which is then used
_MAX_GAP_NS = 2_000_000_000  # largest gap between two poses to interpolate


@dataclass(frozen=True, eq=False)
class Scan:
    """One lidar frame of a robot, thinned."""

    robot: str
    stamp_ns: int
    """Sensor time, nanoseconds."""
    points: Points
    """(N, 3) body frame, metres; no NaN."""
    T_map_body: Pose | None
    """(4, 4) map <- body at the stamp, metres; None where no pose is known."""


class Sink:
    """Receiver of a session's events; subclasses override the methods that they need.

    All methods but ``close`` are called on the feed's thread and must return soon: events queue meanwhile, and a full
    queue drops the oldest. Errors are logged.
    """

    def map(self, view: MapView) -> None:
        """Take the map: the first known one, and any served later."""

    def pose(self, pose: PoseMessage) -> None:
        """Take a pose; ``pose.robot`` is always set."""

    def status(self, robot: str, status: dict[str, Any]) -> None:
        """Take a robot's status from its node: JSON from the network, in which any field may be missing."""

    def hypotheses(self, hypotheses: HypothesesMessage) -> None:
        """Take the places that a search considers; outdated once a status or a pose says ``TRACKING``."""

    def scan(self, scan: Scan) -> None:
        """Take a lidar frame, a few a second at most."""

    def close(self) -> None:
        """Finish: nothing more comes."""


class PoseTrack:
    """Newest poses of one robot, for interpolation at a scan's stamp."""

    def __init__(self) -> None:
        self._poses: deque[tuple[int, Pose]] = deque(maxlen=_KEPT)

    def add(self, stamp_ns: int, T_map_body: Pose) -> None:
        """Add a pose; a stamp that goes back starts a new track."""
        if self._poses and stamp_ns < self._poses[-1][0]:
            self._poses.clear()
        if not self._poses or stamp_ns > self._poses[-1][0]:
            self._poses.append((stamp_ns, T_map_body))

    def reaches(self, stamp_ns: int) -> bool:
        """Whether a pose with this stamp or a later one has come."""
        return bool(self._poses) and self._poses[-1][0] >= stamp_ns

    def at(self, stamp_ns: int) -> Pose | None:
        """Return (4, 4) map <- body at a stamp, interpolated; None where no pose is near."""
        if not self._poses:
            return None
        stamps = np.array([stamp for stamp, _ in self._poses], dtype=np.int64)
        after = int(np.searchsorted(stamps, stamp_ns))
        if after == len(stamps) or after == 0:
            stamp, T = self._poses[-1 if after else 0]
            return T if abs(stamp - stamp_ns) <= _TOLERANCE_NS else None
        (begin, T_begin), (end, T_end) = self._poses[after - 1], self._poses[after]
        if end - begin > _MAX_GAP_NS:
            return None
        return interpolate(T_begin, T_end, (stamp_ns - begin) / (end - begin))
