"""Sink and hub of the web page: events for every open page at its own pace, and the robots' trails.

A page keeps only the newest event of each kind per robot, so that a slow page delays no other.
"""

from __future__ import annotations

import base64
import json
import math
import struct
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Any

import numpy as np

from coview_stream.basemap.summary import MapView
from coview_stream.geometry.transforms import Points, transform, yaw_of
from coview_stream.messages.types import HypothesesMessage, PoseMessage
from coview_stream.viewers.scene import Scan, Sink

MAX_PAGES = 8
"""Pages served at a time."""
_MAX_KEPT = 4_000  # events that a page may hold: four kinds for a thousand robots

Slot = tuple[str, str]
"""Kind of an event, and its robot or map."""


class Page:
    """Events that one page has not read: one per slot, in order of arrival."""

    def __init__(self) -> None:
        self._events: OrderedDict[Slot, bytes] = OrderedDict()
        self._changed = threading.Condition()
        self.closed = False

    def put(self, slot: Slot, event: bytes) -> None:
        """Add an event; it replaces the previous one in its slot."""
        with self._changed:
            self._events.pop(slot, None)
            if len(self._events) < _MAX_KEPT and not self.closed:
                self._events[slot] = event
                self._changed.notify()

    def take(self, timeout: float) -> bytes:
        """Take all events; empty if none comes for ``timeout`` seconds, or the page is closed."""
        with self._changed:
            if not self._events and not self.closed:
                self._changed.wait(timeout)
            taken = b"".join(self._events.values())
            self._events.clear()
        return taken

    def close(self) -> None:
        """Wake the reader; nothing more comes."""
        with self._changed:
            self.closed = True
            self._events.clear()
            self._changed.notify_all()


class WebHub:
    """All open pages, and the events that a new page gets first."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pages: list[Page] = []
        self._kept: OrderedDict[Slot, bytes] = OrderedDict()
        self.first: Callable[[], list[bytes]] = list  # events that a new page gets before all others
        self._closed = False

    @property
    def pages(self) -> int:
        """Number of open pages."""
        return len(self._pages)

    def publish(self, kind: str, about: str, data: dict[str, Any], keep: bool = True) -> None:
        """Send an event to all pages and, if it is kept, to those opened later."""
        slot, event = (kind, about), encode_event(kind, data)
        with self._lock:
            if keep and (slot in self._kept or len(self._kept) < _MAX_KEPT):
                self._kept[slot] = event
            pages = list(self._pages)
        for page in pages:
            page.put(slot, event)

    def open_page(self) -> Page | None:
        """Return a new page with the first and the kept events; None if too many are open."""
        page = Page()
        for number, event in enumerate(self.first()):
            page.put(("first", str(number)), event)
        with self._lock:
            if self._closed or len(self._pages) >= MAX_PAGES:
                return None
            for slot, event in self._kept.items():
                page.put(slot, event)
            self._pages.append(page)
        return page

    def close_page(self, page: Page) -> None:
        """Forget a page."""
        page.close()
        with self._lock:
            if page in self._pages:
                self._pages.remove(page)

    def close(self) -> None:
        """Close all pages; none can be opened afterwards."""
        with self._lock:
            self._closed = True
            pages = list(self._pages)
        for page in pages:
            page.close()


def encode_event(kind: str, data: dict[str, Any]) -> bytes:
    """Return a server-sent event; ValueError for NaN, which JSON lacks."""
    return f"event: {kind}\ndata: {json.dumps(data, allow_nan=False, separators=(',', ':'))}\n\n".encode()


_TRAIL = 4_000  # points of a robot's trail
_TRAIL_STEP = 0.25  # metres between its points
_TRAIL_GAP = 2.0  # seconds without a pose that interrupt the trail
_MAX_TEXT = 500  # characters of a text from the network
_MAX_TEXTS = 8  # of a list from the network
_SCAN_POINTS = 3_000  # of a scan
_SCAN_STEP = 0.01  # metres, unit of a scan's coordinates
_MAPS = 4  # maps kept

_STATUS = ("state", "reason", "version", "map_sha256", "odometry", "uptime_s", "stamp_ns")
_PARTS = {
    "pose": ("rate_hz", "age_s", "confidence"),
    "latency_ms": ("p50", "p95", "p99"),
    "engine_ms": ("p50", "p95", "p99"),
    "counters": ("received", "processed", "dropped", "missing", "fixes", "losses", "searches"),
}


class WebSink(Sink):
    """Events of a session for the pages of a hub, which read ``maps``, packed by hash; calls ``close`` at the end."""

    def __init__(self, hub: WebHub, close: Callable[[], None]) -> None:
        self.maps: dict[str, bytes] = {}
        self._close = close
        self._hub = hub
        self._trails: dict[str, deque[list[float] | None]] = {}
        self._last: dict[str, float] = {}  # local time of each robot's newest pose
        hub.first = self._trail_events

    def map(self, view: MapView) -> None:
        """Keep the map for pages to fetch, and announce it."""
        if view.sha256 in self.maps:
            return
        while len(self.maps) >= _MAPS:
            self.maps.pop(next(iter(self.maps)))
        self.maps[view.sha256] = packed_map(view)
        self._hub.publish("map", view.sha256, {"sha256": view.sha256, "count": len(view.points)})

    def pose(self, pose: PoseMessage) -> None:
        """Publish a pose, and continue the trail."""
        x, y, z = (float(c) for c in pose.T_map_body[:3, 3])
        covariance = pose.covariance
        known = bool(np.isfinite(covariance).all())
        self._extend_trail(pose.robot, x, y)
        self._hub.publish(
            "pose",
            pose.robot,
            {
                "robot": pose.robot,
                "stamp_ms": pose.stamp_ns / 1e6,
                "state": pose.state[:_MAX_TEXT],
                "x": round(x, 3),
                "y": round(y, 3),
                "z": round(z, 3),
                "yaw": round(yaw_of(pose.T_map_body), 5),
                "cov": [float(covariance[r, c]) for r, c in ((0, 0), (0, 1), (1, 1))] if known else None,
                "sigma": np.sqrt(np.abs(np.diag(covariance))).round(5).tolist() if known else None,
                "confidence": _finite(pose.confidence),
                "age_s": _finite(pose.age),
                "protection": None if pose.protection is None else pose.protection.to_json(),
                "map_sha256": pose.map_sha256[:_MAX_TEXT],
            },
        )

    def status(self, robot: str, status: dict[str, Any]) -> None:
        """Publish the fields of a status that the page shows; they come from the network, and any may be missing."""
        data: dict[str, Any] = {"robot": robot} | {name: _plain(status.get(name)) for name in _STATUS}
        for part, names in _PARTS.items():
            fields = status.get(part)
            data[part] = {name: _plain(fields.get(name)) for name in names} if isinstance(fields, dict) else {}
        calibration = status.get("calibration")
        data["says"] = _texts(calibration.get("says") if isinstance(calibration, dict) else None)
        data["errors"] = _texts(status.get("errors"))
        self._hub.publish("status", robot, data)

    def hypotheses(self, hypotheses: HypothesesMessage) -> None:
        """Publish the places that a search considers."""
        names = ("x", "y", "z", "yaw", "probability")
        places = [dict(zip(names, np.round(row[:5], 5).tolist(), strict=True)) for row in hypotheses.places]
        self._hub.publish(
            "hypotheses",
            hypotheses.robot,
            {
                "robot": hypotheses.robot,
                "stamp_ms": hypotheses.stamp_ns / 1e6,
                "none": _finite(hypotheses.none),
                "places": places,
            },
        )

    def scan(self, scan: Scan) -> None:
        """Publish a scan, in the map frame if its pose is known; nothing while no page is open."""
        if not self._hub.pages:
            return
        points = scan.points[:: max(1, -(-len(scan.points) // _SCAN_POINTS))]
        centre = np.zeros(3)
        if scan.T_map_body is not None:
            centre = scan.T_map_body[:3, 3]
            turned = np.eye(4)
            turned[:3, :3] = scan.T_map_body[:3, :3]
            points = transform(turned, points)
        self._hub.publish(
            "scan",
            scan.robot,
            {
                "robot": scan.robot,
                "stamp_ms": scan.stamp_ns / 1e6,
                "in_map": scan.T_map_body is not None,
                "centre": np.round(centre, 3).tolist(),
                "step": _SCAN_STEP,
                "points": base64.b64encode(_steps(points)).decode("ascii"),
            },
            keep=False,
        )

    def close(self) -> None:
        """Close all pages."""
        self._close()

    def _extend_trail(self, robot: str, x: float, y: float) -> None:
        trail = self._trails.setdefault(robot, deque(maxlen=_TRAIL))
        now = time.monotonic()
        gap = now - self._last.get(robot, now) > _TRAIL_GAP
        self._last[robot] = now
        last = trail[-1] if trail else None
        if gap and last is not None:
            trail.append(None)
            last = None
        if last is None or math.hypot(x - last[0], y - last[1]) >= _TRAIL_STEP:
            trail.append([round(x, 2), round(y, 2)])

    def _trail_events(self) -> list[bytes]:
        return [
            encode_event("trail", {"robot": robot, "points": list(trail.copy())})
            for robot, trail in list(self._trails.items())
        ]


def packed_map(view: MapView) -> bytes:
    """Return a map in the form that the page reads.

    The length of the header in four bytes, the header (JSON, padded to a multiple of four bytes), and the points x, y,
    z as little-endian int16, in units of ``step_m`` metres from ``origin``, first the ``ground`` points of the ground.
    """
    data = view.to_json()
    header = {name: data[name] for name in ("map_sha256", "crs", "origin", "step_m", "count", "ground")}
    text = json.dumps(header, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<I", len(text)) + text + base64.b64decode(data["points"])


def _steps(points: Points) -> bytes:
    return np.clip(np.rint(points.astype(np.float64) / _SCAN_STEP), -32_767, 32_767).astype("<i2").tobytes()


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _plain(value: object) -> str | float | bool | None:
    """Return a text, truncated, or a finite number; None for anything else."""
    if isinstance(value, str):
        return value[:_MAX_TEXT]
    if isinstance(value, bool):
        return value
    try:
        return _finite(float(value)) if isinstance(value, int | float) else None
    except OverflowError:  # JSON integers have no limit
        return None


def _texts(values: object) -> list[str]:
    texts = values[:_MAX_TEXTS] if isinstance(values, list) else []
    return [text[:_MAX_TEXT] for text in texts if isinstance(text, str)]
