"""Facts about a map for people: extent and warnings, a plan drawn from above, and thinned points for viewers."""

from __future__ import annotations

import base64
import binascii
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from coview_kernels import Raster
from coview_stream.basemap.map_parts import MapParts
from coview_stream.basemap.tiles import unit_normals
from coview_stream.clouds.reference_system import FOOT, UNKNOWN, short_name
from coview_stream.config import MapConfig
from coview_stream.errors import MapError, MessageError, require_library
from coview_stream.geometry.arrays import Bools, Floats, Ints
from coview_stream.geometry.rasters import cells
from coview_stream.geometry.transforms import Points

_CELL = 1.0  # metres: edge of the squares that count a map's area
_SAMPLED = 100_000  # points
_STRAY = 0.1  # per cent of the points at either end of the heights that may be birds or pits

# Limits of the warnings, set by hand; they decide nothing. docs/results.md has the table of densities.
_THIN = 8.0  # points per m2 of a survey: with more, real runs were found as early as on the whole survey
_LOW = 1.0  # metres: least height of a standing object
_BARE = 0.02  # least share of the squares with a standing object
_FLAT_SHARE = 2.0  # an axis is taken for the vertical if this many times more surfaces face along it than along z
_FACING = np.cos(np.radians(20.0))  # least part of a unit normal along an axis that its surface faces
_HOLES = 0.15  # least surveyed share of a station's surroundings, for half of the stations

_DRAWN_POINTS = 2_000_000
_PIXELS = 800  # along the longer side
_DARK, _LIGHT = 0.15, 0.9  # grey of the highest and of the lowest points
_STRAY_HEIGHTS = 1.0  # per cent of the heights at either end that may be birds or pits
POINTS_OF_FILE = 300_000  # in a view of a map on this machine
POINTS_ON_WIRE = 100_000  # in a view from a node: 0.8 MB of JSON
MAX_WIRE_BYTES = 4 * 1024 * 1024  # of a view's JSON
_MAX_POINTS = 500_000  # accepted in a view
_OVERSAMPLED = 8  # thinning starts from this many times the requested points, evenly spread over the map
_GROWTH = 1.2  # factor by which cells grow until few enough points are left
_GROUND_BAND = 0.4  # metres above the ground height that are still ground
_GROUND_CELL = 4.0  # metres: in a survey without a map, the lowest point of such a cell is ground
_MAX_CRS = 8000  # letters
_FINEST = 0.005  # metres: least step of coordinates on the wire
_MAX_COORDINATE = 1e8  # metres: no place on this planet


@dataclass(frozen=True)
class MapSummary:
    """Size and content of a map.

    Attributes:
        width, depth: metres along x and y.
        area: m2 that hold points, in one-metre squares.
        lowest, highest: heights in the source's frame, metres, without a few stray points.
        density: points kept per m2 of that area, one per voxel, so that overlapping strips and files count once.
        crs: name of the reference system; "unknown" if none is stated.
        bytes: size of all arrays, or of the tiles.
        warnings: one sentence for each feature of the map on which robots will fail.
        form: form of the map with this size, one file or tiles.
    """

    width: float
    depth: float
    area: float
    lowest: float
    highest: float
    density: float
    crs: str
    bytes: int
    warnings: tuple[str, ...]
    form: str = "one file"

    def __str__(self) -> str:
        """Return one line, with the size also in feet if no reference system states the unit."""
        area = f"{self.area / 1e6:.2f} km2" if self.area >= 1e5 else f"{self.area:.0f} m2"
        width, depth = self.width * FOOT, self.depth * FOOT
        feet = f" ({width:.0f} x {depth:.0f} m if in feet: build --crs feet)" if self.crs == UNKNOWN else ""
        return (
            f"{self.width:.0f} x {self.depth:.0f} m{feet} with points on {area}, {self.density:.3g} points/m2 kept, "
            f"heights {self.lowest:.1f} to {self.highest:.1f} m but for strays, crs {self.crs}, "
            f"{self.bytes / 1e6:.0f} MB as {self.form} ({self.bytes / self.area / 1e3:.2g} GB per km2)"
        )


class SummarizedMap(Protocol):
    """Attributes of a :class:`~coview_stream.basemap.basemap.BaseMap` that a summary reads."""

    config: MapConfig
    crs: str | None
    sha256: str
    origin: Floats
    parameters: dict[str, Any]
    points: Points
    stations: Points
    survey: Raster
    nbytes: int
    arrays: dict[str, Any]

    def sampled_points(self, count: int) -> Points:
        """Return at most ``count`` of the points."""


def summary(base_map: SummarizedMap) -> MapSummary:
    """Return extent, area, density, heights and warnings of a map."""
    points = base_map.points
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    lowest, highest = np.percentile(points[:, 2], [_STRAY, 100.0 - _STRAY]) + base_map.origin[2]
    _, (rows, columns), index = cells(points, _CELL)
    covered = np.zeros(rows * columns, dtype=bool)
    covered[index] = True
    area = float(covered.sum()) * _CELL**2
    density = len(points) / area
    thin = too_thin(density, base_map.config.voxel)
    warnings = _upright(base_map), thin, _structured(points, index, covered), _covered(base_map)
    return MapSummary(
        float(high[0] - low[0]),
        float(high[1] - low[1]),
        area=area,
        lowest=float(lowest),
        highest=float(highest),
        density=density,
        crs=short_name(base_map.crs),
        bytes=base_map.nbytes,
        warnings=tuple(filter(None, warnings)),
    )


def too_thin(density: float, voxel: float) -> str | None:
    """Return a warning if fewer points per m2 were kept than voxels (edge ``voxel``, metres) keep of 8 random ones."""
    area = voxel**2
    if density >= (1.0 - math.exp(-_THIN * area)) / area:  # share of the squares that are hit
        return None
    return (
        f"{density:.2g} points/m2 are few: on surveys of {_THIN:.0f} and less the first pose may come after 100 m of "
        "driving, or not at all; use a denser survey if there is one"
    )


def _upright(base_map: SummarizedMap) -> str | None:
    """Return a warning if z is not up, judged by how many surfaces face each axis, and by the extent along it."""
    packed = base_map.arrays["normals"]
    normals = unit_normals(np.array(packed[:: max(1, -(-len(packed) // _SAMPLED))]))
    facing = (np.abs(normals) > _FACING).mean(axis=0)
    wide = np.ptp(np.percentile(base_map.sampled_points(_SAMPLED), [1.0, 99.0], axis=0), axis=0)
    axis = int(np.argmax(facing[:2]))
    if facing[axis] > _FLAT_SHARE * facing[2] and wide[axis] < 0.5 * np.delete(wide, axis).min():
        name = "xy"[axis]
        return (
            f"most surfaces face {name}, and the points extend least along it: {name} seems to point up; "
            "a map needs z up: swap the axes (x, y, z) -> " + ("(y, z, x)" if axis == 0 else "(x, -z, y)")
        )
    return None


def _structured(points: Points, index: Ints, covered: Bools) -> str | None:
    """Return a warning if too few one-metre squares have points that differ by more than a metre in height."""
    size = len(covered)
    low, high = np.full(size, np.inf, np.float32), np.full(size, -np.inf, np.float32)
    np.minimum.at(low, index, points[:, 2])
    np.maximum.at(high, index, points[:, 2])
    share = float((high[covered] - low[covered] > _LOW).mean())
    if share >= _BARE:
        return None
    return (
        f"almost nothing stands above the ground (on {100 * share:.1f} % of the area): robots are found by walls, "
        "trunks and poles; give the whole survey, not its ground class alone"
    )


def _covered(base_map: SummarizedMap) -> str | None:
    """Return a warning if too little of the stations' surroundings was surveyed."""
    radius, block = base_map.config.descriptor.radius, base_map.config.block
    survey = base_map.survey
    surveyed = np.asarray(survey.values, dtype=np.float64)
    reach = max(1, int(radius / block))
    total = np.pad(surveyed.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    x, y = np.floor((base_map.stations[:, :2] - survey.corner) / block).astype(int).T
    xs = np.clip([x - reach, x + reach + 1], 0, surveyed.shape[0])
    ys = np.clip([y - reach, y + reach + 1], 0, surveyed.shape[1])
    count = total[xs[1], ys[1]] - total[xs[0], ys[1]] - total[xs[1], ys[0]] + total[xs[0], ys[0]]
    share = float(np.median(count)) / (2 * reach + 1) ** 2
    if share >= _HOLES:
        return None
    return (
        f"half of the stations have {100 * share:.0f} % or less of their surroundings of {radius:.0f} m on the map: "
        "robots see more there than it knows; survey more of it, or build with a smaller --radius"
    )


def draw_plan(sampled: Callable[[int], Points], origin: Floats, voxel: float, axes: Any = None) -> Any:
    """Draw a map from above in the frame of its sources, metres, darker where it is higher; return the axes.

    Args:
        sampled: returns at most the given number of the map's points (N, 3).
        origin: (3,) origin of these points, in the frame of the sources.
        voxel: metres between points.
        axes: matplotlib axes to draw into; None makes a figure. DependencyError if matplotlib is missing.
    """
    if axes is None:
        axes = require_library("matplotlib.pyplot", "matplotlib>=3.8", "pictures of maps").figure().add_subplot()
    points = sampled(_DRAWN_POINTS)
    side = float(np.ptp(points[:, :2], axis=0).max())
    # no finer than the pixels or the spacing of the points
    cell = max(side / _PIXELS, 1.5 * voxel)
    corner, (rows, columns), index = cells(points, cell)
    highest = np.full(rows * columns, -np.inf)
    np.maximum.at(highest, index, points[:, 2])
    low, high = np.percentile(points[:, 2], [_STRAY_HEIGHTS, 100.0 - _STRAY_HEIGHTS])
    share = np.clip((highest - low) / max(high - low, 1.0), 0.0, 1.0)
    grey = np.where(np.isfinite(highest), _LIGHT - (_LIGHT - _DARK) * share, np.nan)
    left, bottom = (corner + origin[:2]).tolist()
    extent = (left, left + columns * cell, bottom, bottom + rows * cell)
    picture = grey.reshape(rows, columns)
    axes.imshow(picture, cmap="gray", vmin=0.0, vmax=1.0, origin="lower", extent=extent, interpolation="nearest")
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.locator_params(axis="x", nbins=5)  # UTM numbers are long
    axes.ticklabel_format(useOffset=False, style="plain")
    return axes


@dataclass(frozen=True)
class MapView:
    """Thinned points of a base map.

    Attributes:
        origin: (3,) float64 in the frame of the map's sources, metres.
        points: (N, 3) float32 relative to ``origin``, metres.
        is_ground: (N,) whether a point is on the ground.
        crs: coordinate reference system of the sources as text, None if unknown.
        sha256: hash of the map.
        parts: parts of a joined map, whose frames poses are in; None for a single map.
    """

    origin: Floats
    points: Points
    is_ground: Bools
    crs: str | None
    sha256: str
    parts: MapParts | None = None

    @classmethod
    def of(cls, base_map: SummarizedMap, count: int = POINTS_OF_FILE) -> MapView:
        """Thin a map's cloud to at most ``count`` points, one per cell of a 3-D grid."""
        points = base_map.sampled_points(_OVERSAMPLED * count)
        chosen = points[_thinned(points, count)]
        parts = MapParts.of(base_map.parameters)
        return cls(base_map.origin.copy(), chosen, _is_ground(base_map, chosen), base_map.crs, base_map.sha256, parts)

    @classmethod
    def of_cloud(cls, points: Points, origin: Floats, count: int = POINTS_OF_FILE) -> MapView:
        """Thin a survey without a map: (N, 3) float32 relative to ``origin``, metres.

        Points near the lowest point of their cell count as ground.
        """
        chosen = points[_thinned(points[:: max(1, len(points) // (_OVERSAMPLED * count))], count)]
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
        """Return plain data: ``points`` is base64 of (N, 3) little-endian int16, ``step_m`` each, from ``origin``.

        The first ``ground`` points are on the ground.
        """
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
        """Read untrusted data of :meth:`to_json`; MessageError names a missing or invalid field."""
        count: Any = data.get("count")
        ground: Any = data.get("ground")
        for name, value in (("count", count), ("ground", ground)):
            if type(value) is not int or not 0 <= value <= _MAX_POINTS:
                raise MessageError(f"map view: {name} is not a number of points up to {_MAX_POINTS}")
        step: Any = data.get("step_m")
        crs, sha256 = data.get("crs"), data.get("map_sha256")
        origin = data.get("origin")
        if ground > count:
            raise MessageError(f"map view: ground is {ground} of {count} points")
        if not _finite(step, 10.0) or step <= 0:
            raise MessageError("map view: step_m is not a length of at most 10 m")
        if not isinstance(origin, list) or len(origin) != 3 or not all(_finite(c, _MAX_COORDINATE) for c in origin):
            raise MessageError("map view: origin is not a list of three coordinates")
        if not isinstance(sha256, str) or not (crs is None or isinstance(crs, str)):
            raise MessageError("map view: map_sha256 and crs have to be text")
        try:
            packed = base64.b64decode(data.get("points", ""), validate=True)
        except (binascii.Error, TypeError, ValueError) as error:
            raise MessageError("map view: points are not base64") from error
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
    """Return the numbers of at most ``count`` points: the first in each cell of a 3-D grid."""
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


def _is_ground(base_map: SummarizedMap, points: Points) -> Bools:
    """Mask the points (N, 3) on the ground, near the height of a station next to them."""
    stations, block = base_map.stations, base_map.config.block
    if not len(stations) or not len(points):
        return np.zeros(len(points), dtype=bool)
    cells = np.floor(stations[:, :2] / block).astype(np.int64)
    low = cells.min(axis=0) - 2  # an empty border all around
    heights = np.full(cells.max(axis=0) + 3 - low, np.nan, dtype=np.float32)
    heights[tuple((cells - low).T)] = stations[:, 2]
    column, row = np.clip(np.floor(points[:, :2] / block).astype(np.int64) - low, 1, np.array(heights.shape) - 2).T
    off = np.full(len(points), np.inf, dtype=np.float32)
    for across in (-1, 0, 1):
        for along in (-1, 0, 1):
            off = np.fmin(off, np.abs(points[:, 2] - heights[column + across, row + along]))
    return np.asarray(off <= _GROUND_BAND)


def _finite(value: object, limit: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= limit
