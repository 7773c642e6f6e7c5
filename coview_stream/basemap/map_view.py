"""View of a base map: its points, thinned to a bounded number and told apart as ground and structure, to look at.

A node hands one out as JSON (:meth:`MapView.to_json`), so that a viewer needs no map file.
"""

from __future__ import annotations

import base64
import binascii
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from coview_stream.basemap.joined.map_parts import MapParts
from coview_stream.errors import MapError, MessageError
from coview_stream.geometry.arrays import Bools, Floats
from coview_stream.geometry.transforms import Points

if TYPE_CHECKING:
    from coview_stream.basemap.basemap import BaseMap

# set by hand
POINTS_OF_FILE = 300_000
"""Points of a view that is made of a file on this machine."""
POINTS_ON_WIRE = 100_000
"""Points of a view that a node hands out: 0.8 MB of JSON."""
MAX_WIRE_BYTES = 4 * 1024 * 1024
"""Bytes of a view's JSON that are read."""
_MAX_POINTS = 500_000  # that are read
_SAMPLED = 8  # times as many points as asked for are thinned, evenly spread over the map
_GROWTH = 1.2  # of the cells, until few enough are left
_GROUND_BAND = 0.4  # metres above the ground's height: still the ground
_GROUND_CELL = 4.0  # metres: of a survey without a map, in which the lowest point is the ground
_MAX_CRS = 8000  # letters
_FINEST = 0.005  # metres: a step on the wire
_MAX_COORDINATE = 1e8  # metres: no place on this planet


@dataclass(frozen=True)
class MapView:
    """Thinned points of a base map.

    Attributes:
        origin: (3,) float64 in the frame of the map's sources, metres.
        points: (N, 3) float32 relative to ``origin``, metres.
        is_ground: (N,) whether a point is the ground, not what stands on it.
        crs: coordinate reference system of the sources as text, None if it is not known.
        sha256: hash of the map.
        parts: the maps of which it is joined, in whose frames poses are; None of one map.
    """

    origin: Floats
    points: Points
    is_ground: Bools
    crs: str | None
    sha256: str
    parts: MapParts | None = None

    @classmethod
    def of(cls, base_map: BaseMap, count: int = POINTS_OF_FILE) -> MapView:
        """Thin a map's cloud to at most ``count`` points, one for each cell of a grid in space."""
        points = base_map.sampled_points(_SAMPLED * count)
        chosen = points[_thinned(points, count)]
        parts = MapParts.of(base_map.parameters)
        return cls(base_map.origin.copy(), chosen, _is_ground(base_map, chosen), base_map.crs, base_map.sha256, parts)

    @classmethod
    def of_cloud(cls, points: Points, origin: Floats, count: int = POINTS_OF_FILE) -> MapView:
        """Thin a survey of which no map has been built: (N, 3) float32 about ``origin``, metres.

        The ground is taken for what lies near the lowest point of its cell.
        """
        chosen = points[_thinned(points[:: max(1, len(points) // (_SAMPLED * count))], count)]
        cells = np.floor(chosen[:, :2] / _GROUND_CELL).astype(np.int64)
        _, cell = np.unique(cells, axis=0, return_inverse=True)
        lowest = np.full(int(cell.max(initial=-1)) + 1, np.inf, dtype=np.float32)
        np.minimum.at(lowest, cell.ravel(), chosen[:, 2])
        is_ground = chosen[:, 2] - lowest[cell.ravel()] < _GROUND_BAND
        return cls(origin.copy(), chosen, is_ground, None, "")

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """Lowest and highest (3,) coordinates relative to ``origin``; zeros without points."""
        if not len(self.points):
            return np.zeros(3), np.zeros(3)
        return self.points.min(axis=0).astype(np.float64), self.points.max(axis=0).astype(np.float64)

    def to_json(self) -> dict[str, Any]:
        """Plain data: points as base64 of little-endian int16 in ``step_m``, the ground's ``ground`` points first."""
        order = np.argsort(~self.is_ground, kind="stable")
        low, high = self.bounds
        middle = np.round(0.5 * (low + high))
        step = max(_FINEST, float(np.abs(high - low).max()) / 2.0 / 32_000.0 + 1e-9)
        rows = np.rint((self.points[order].astype(np.float64) - middle) / step)
        packed = np.clip(rows, -32_767, 32_767).astype("<i2")
        return {
            "map_sha256": self.sha256,
            "crs": None if self.crs is None else self.crs[:_MAX_CRS],
            "origin": (self.origin + middle).tolist(),
            "step_m": step,
            "count": len(packed),
            "ground": int(self.is_ground.sum()),
            "points": base64.b64encode(packed.tobytes()).decode("ascii"),
        } | ({} if self.parts is None else {"parts": self.parts.to_json()})

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> MapView:
        """Read what :meth:`to_json` wrote, from anyone.

        Raises:
            MessageError: it is something else; the field is named.
        """
        count, ground = (_whole(data, name) for name in ("count", "ground"))
        step: Any = data.get("step_m")
        crs, sha256 = data.get("crs"), data.get("map_sha256")
        origin = data.get("origin")
        if ground > count:
            raise MessageError(f"map view: ground is {ground} of {count} points")
        if not _finite(step, 10.0) or step <= 0:
            raise MessageError("map view: step_m is no length of at most 10 m")
        if not isinstance(origin, list) or len(origin) != 3 or not all(_finite(c, _MAX_COORDINATE) for c in origin):
            raise MessageError("map view: origin is no list of three coordinates")
        if not isinstance(sha256, str) or not (crs is None or isinstance(crs, str)):
            raise MessageError("map view: map_sha256 and crs have to be text")
        try:
            packed = base64.b64decode(data.get("points", ""), validate=True)
        except (binascii.Error, TypeError, ValueError) as error:
            raise MessageError("map view: points are no base64") from error
        if len(packed) != 6 * count:
            raise MessageError(f"map view: {len(packed)} bytes for {count} points")
        points = np.frombuffer(packed, dtype="<i2").reshape(-1, 3).astype(np.float32) * np.float32(step)
        is_ground = np.arange(count) < ground
        try:
            parts = MapParts.of(data)
        except MapError as error:
            raise MessageError(f"map view: {error}") from error
        return cls(np.array(origin, dtype=np.float64), points, is_ground, crs, sha256, parts)


def _thinned(points: Points, count: int) -> np.ndarray:
    """Return numbers of at most ``count`` points: the first of each cell of a grid."""
    if len(points) <= count:
        return np.arange(len(points))
    low = points.min(axis=0)
    side = np.maximum(points.max(axis=0) - low, 1.0).astype(np.float64)
    cell = 0.5 * math.sqrt(side[0] * side[1] / count)
    while True:
        cells = ((points - low) / np.float32(cell)).astype(np.int64)
        across, up = (int(cells[:, axis].max()) + 1 for axis in (1, 2))
        _, first = np.unique((cells[:, 0] * across + cells[:, 1]) * up + cells[:, 2], return_index=True)
        if len(first) <= count:
            return np.sort(first)
        cell *= max(_GROWTH, math.sqrt(len(first) / count))


def _is_ground(base_map: BaseMap, points: Points) -> Bools:
    """Tell which points (N, 3) lie on the ground: near the height of a station beside them."""
    stations, block = base_map.stations, base_map.config.block
    if not len(stations) or not len(points):
        return np.zeros(len(points), dtype=bool)
    cells = np.floor(stations[:, :2] / block).astype(np.int64)
    low = cells.min(axis=0) - 2  # a border without stations all around
    heights = np.full(cells.max(axis=0) + 3 - low, np.nan, dtype=np.float32)
    heights[tuple((cells - low).T)] = stations[:, 2]
    column, row = np.clip(np.floor(points[:, :2] / block).astype(np.int64) - low, 1, np.array(heights.shape) - 2).T
    off = np.full(len(points), np.inf, dtype=np.float32)
    for across in (-1, 0, 1):
        for along in (-1, 0, 1):
            off = np.fmin(off, np.abs(points[:, 2] - heights[column + across, row + along]))
    return np.asarray(off <= _GROUND_BAND)


def _whole(data: dict[str, Any], name: str) -> int:
    value = data.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= _MAX_POINTS:
        raise MessageError(f"map view: {name} is no number of points up to {_MAX_POINTS}")
    return value


def _finite(value: object, limit: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= limit
