"""Table of the robots on the network: newest poses, statuses and rates. It has no clock: callers pass the time."""

from __future__ import annotations

import math
import textwrap
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from coview_stream.errors import printable
from coview_stream.geometry.protection import one_in
from coview_stream.geometry.transforms import yaw_of
from coview_stream.messages.types import PoseMessage

WINDOW = 5.0  # seconds over which the rate of poses is measured
STALE = 2.0  # seconds without a pose after which the last pose is no longer shown
SILENT = 5.0  # seconds without any message: a node sends one each second
MAX_ROBOTS = 1000  # beyond it the robots heard least recently are forgotten: strangers may choose names
_LEAST = 1e-6  # a smaller probability of a wrong place is shown as "less than" this: columns are narrow

_INDENT = " " * 4  # of a reason below its robot's line

_COLUMNS = (  # title and width, characters; negative: aligned to the left
    ("robot", -12),
    ("state", -12),
    ("x", 12),
    ("y", 13),
    ("z", 9),
    ("yaw deg", 8),
    ("within xy/z m", 13),
    ("age s", 6),
    ("Hz", 5),
    ("wrong", 15),
    ("ms p50/p99", 12),
    ("dropped", 8),
    ("reason", 0),
)


@dataclass
class RobotView:
    """Newest messages of one robot. Times are seconds of a monotonic clock."""

    robot: str
    heard: float  # time of the newest message
    pose: PoseMessage | None = None
    status: dict[str, Any] = field(default_factory=dict)
    status_heard: float = -math.inf
    node: str = ""  # the node that serves it, in words, if it was another node before
    arrivals: deque[float] = field(default_factory=lambda: deque(maxlen=1024))  # times of the newest poses

    def pose_rate(self, now: float) -> float:
        """Return poses per second over the last :data:`WINDOW` seconds."""
        while self.arrivals and self.arrivals[0] < now - WINDOW:
            self.arrivals.popleft()
        span = now - self.arrivals[0] if self.arrivals else 0.0
        return (len(self.arrivals) - 1) / span if span > 0 else 0.0

    def fresh_pose(self, now: float) -> PoseMessage | None:
        """Return the pose; None if it is stale, or a later status has another state than TRACKING."""
        if not self.arrivals or now - self.arrivals[-1] >= STALE:
            return None
        lost = self.status.get("state", "TRACKING") != "TRACKING" and self.status_heard > self.arrivals[-1]
        return None if lost else self.pose


class FleetTable:
    """Table of all robots that have sent a message."""

    def __init__(self) -> None:
        self.views: dict[str, RobotView] = {}  # in order of their newest messages, newest last

    def add_pose(self, message: PoseMessage, now: float) -> None:
        """Add a pose that arrived at ``now``."""
        view = self._view(message.robot, now)
        view.pose = message
        view.arrivals.append(now)

    def add_status(self, robot: str, status: dict[str, Any], now: float) -> None:
        """Add a status that arrived at ``now``; no field of it is required."""
        view = self._view(robot, now)
        before, after = _mapping(view.status, "node").get("id"), _mapping(status, "node")
        if before is not None and after.get("id") != before:
            view.node = f"served by node {after.get('id')} on {after.get('host')} now"
        view.status, view.status_heard = status, now

    def table(self, now: float, header: bool = True, width: int | None = None) -> list[str]:
        """Return lines of text, sorted by robot name: one for each robot, with a long reason below it.

        Args:
            now: seconds on the clock used for the messages.
            header: begin with the titles of the columns.
            width: width of the terminal, characters, which no line exceeds; None: one line per robot, however long.
        """
        lines = [_line([title for title, _ in _COLUMNS])[:width]] if header else []
        for name in sorted(self.views):
            row = _row(self.views[name], now)
            if width is None or len(_line(row)) <= width:
                lines.append(_line(row))
                continue
            lines.append(_line(row[:-1])[:width])
            lines += textwrap.wrap(row[-1], width, initial_indent=_INDENT, subsequent_indent=_INDENT) if row[-1] else []
        return lines

    def _view(self, robot: str, now: float) -> RobotView:
        view = self.views.pop(robot, None) or RobotView(robot, now)
        view.heard = now
        if len(self.views) >= MAX_ROBOTS:
            del self.views[next(iter(self.views))]
        self.views[robot] = view
        return view


def _row(view: RobotView, now: float) -> list[str]:
    silence, pose = now - view.heard, view.fresh_pose(now)
    state = view.status.get("state") or (pose.state if pose else "-")
    if silence > SILENT:
        state = f"silent {silence:.0f} s"
    latency, counters = _mapping(view.status, "latency_ms"), _mapping(view.status, "counters")
    cells, rate = ["-"] * 6, f"{view.pose_rate(now):.1f}"
    if pose is not None:
        cells = [f"{value:.2f}" for value in pose.T_map_body[:3, 3]]
        level = pose.protection
        within = "-" if level is None else f"{_number(level.horizontal, 2)}/{_number(level.vertical, 2)}"
        cells += [f"{math.degrees(yaw_of(pose.T_map_body)):.1f}", within, _number(pose.age, 2)]
    says = _mapping(view.status, "calibration").get("says")  # the node's remarks on sensor and odometry
    reasons = [
        f"on map {view.status['map']}" if isinstance(view.status.get("map"), str) else "",
        str(view.status.get("reason") or ""),
        view.node,
        *(map(str, says) if isinstance(says, list) else ()),
    ]
    return [
        printable(view.robot),
        printable(state),
        *cells,
        rate,
        "-" if pose is None else _odds(1.0 - pose.confidence),
        f"{_number(latency.get('p50'), 0)}/{_number(latency.get('p99'), 0)}",
        _number(counters.get("dropped"), 0),
        printable("; ".join(filter(None, reasons))),
    ]


def _line(row: list[str]) -> str:
    cells = (
        text.ljust(-width) if width < 0 else text.rjust(width) for text, (_, width) in zip(row, _COLUMNS, strict=False)
    )
    return "  ".join(cells).rstrip()


def _odds(wrong: float) -> str:
    """Return a probability in a few characters."""
    if not 0.0 <= wrong <= 1.0:  # the message has no probability
        return "-"
    if wrong < _LEAST:
        return f"<1 in {1.0 / _LEAST:,.0f}"
    return one_in(wrong) if wrong < 0.5 else "likely"


def _mapping(status: dict[str, Any], name: str) -> dict[str, Any]:
    value = status.get(name)
    return value if isinstance(value, dict) else {}


def _number(value: object, digits: int) -> str:
    try:
        known = isinstance(value, (int, float)) and math.isfinite(value)
        return f"{value:.{digits}f}" if known else "-"
    except OverflowError:  # JSON integers have no limit
        return "-"
