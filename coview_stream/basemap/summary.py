"""What a map covers, in numbers that a person can check, and what about it will make robots fail."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from coview_kernels import Raster
from coview_stream.clouds.reference_system import short_name
from coview_stream.config import MapConfig
from coview_stream.geometry.arrays import Bools, Floats, Ints
from coview_stream.geometry.rasters import cells
from coview_stream.geometry.transforms import Points

_CELL = 1.0  # metres: the area that a map covers is counted in such squares
_SAMPLED = 100_000  # points, where a sample will do; set by hand
_STRAY = 0.1  # per cent of the points at either end of the heights that may be birds or pits

# Limits of the warnings, set by hand; they decide nothing. docs/accuracy.md has the table of densities.
_THIN = 8.0  # points per m2: from 8 on real runs were found at once or as late as on the whole survey
_LOW = 1.0  # metres: nothing that stands is lower
_BARE = 0.02  # share of the squares on which something has to stand
_FLAT_SHARE = 2.0  # times as many surfaces as face up face another way, where another axis is the vertical one
_FACING = np.cos(np.radians(20.0))
_HOLES = 0.15  # share of a station's surroundings that has to be surveyed, for half of the stations


@dataclass(frozen=True)
class MapSummary:
    """Size and content of a map.

    Attributes:
        width: metres along x. depth: along y.
        area: m2 that hold points, in squares of a metre.
        lowest, highest: heights in the source's frame, metres, but for a few stray points.
        density: points of the source per m2 of that area; None if the file does not say how many there were.
        crs: name of the reference system; "unknown" if none is stated.
        bytes: of all arrays.
        warnings: what will make robots fail, each a sentence.
    """

    width: float
    depth: float
    area: float
    lowest: float
    highest: float
    density: float | None
    crs: str
    bytes: int
    warnings: tuple[str, ...]

    def __str__(self) -> str:
        """Return one line."""
        density = "" if self.density is None else f", {self.density:.3g} points/m2"
        return (
            f"{self.width:.0f} x {self.depth:.0f} m with points on {_area(self.area)}{density}, "
            f"heights {self.lowest:.1f} to {self.highest:.1f} m, crs {self.crs}, "
            f"{self.bytes / 1e6:.0f} MB as one file ({self.bytes / self.area / 1e3:.2g} GB per km2)"
        )


class SummarizedMap(Protocol):
    """What a summary needs of a :class:`~coview_stream.basemap.basemap.BaseMap`."""

    config: MapConfig
    crs: str | None
    origin: Floats
    parameters: dict[str, Any]

    @property
    def points(self) -> Points:
        """(N, 3) points, relative to ``origin``."""

    @property
    def stations(self) -> Points:
        """(M, 3) ground positions, likewise."""

    @property
    def survey(self) -> Raster:
        """Cells that hold points."""

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""

    def sampled_points(self, count: int) -> Points:
        """Return some of the points."""

    def sampled_normals(self, count: int) -> Points:
        """Return their normals."""


def summary(base_map: SummarizedMap) -> MapSummary:
    """Return what a map covers."""
    points = base_map.points
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    lowest, highest = np.percentile(points[:, 2], [_STRAY, 100.0 - _STRAY]) + base_map.origin[2]
    _, (rows, columns), index = cells(points, _CELL)
    covered = np.zeros(rows * columns, dtype=bool)
    covered[index] = True
    area = float(covered.sum()) * _CELL**2
    read = base_map.parameters.get("source_points")
    density = read / area if isinstance(read, int) and read > 0 else None
    return MapSummary(
        float(high[0] - low[0]),
        float(high[1] - low[1]),
        area,
        float(lowest),
        float(highest),
        density,
        short_name(base_map.crs),
        base_map.nbytes,
        tuple(filter(None, (
            _upright(base_map),
            _dense(density),
            _structured(points, index, covered),
            _covered(base_map),
        ))),
    )  # fmt: skip


def _area(metres: float) -> str:
    return f"{metres / 1e6:.2f} km2" if metres >= 1e5 else f"{metres:.0f} m2"


def _dense(density: float | None) -> str | None:
    if density is None or density >= _THIN:
        return None
    return (
        f"{density:.2g} points/m2 are few: on {_THIN:.0f} and less the first pose may come after 100 m of driving, or "
        "not at all; use a denser survey if there is one"
    )


def _upright(base_map: SummarizedMap) -> str | None:
    """Compare how many surfaces face each axis, and how far the points extend along it."""
    facing = (np.abs(base_map.sampled_normals(_SAMPLED)) > _FACING).mean(axis=0)
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
    """Look for what stands: squares of a metre whose points differ by a metre in height and more."""
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
    """Look how much of the surroundings of stations has been surveyed."""
    radius, block = base_map.config.descriptor.radius, base_map.config.block
    survey = base_map.survey
    surveyed = np.asarray(survey.values, dtype=np.float64)
    reach = max(1, int(radius / block))
    total = np.pad(surveyed.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    x, y = np.floor((base_map.stations[:, :2] - survey.corner) / block).astype(int).T
    xs = np.clip([x - reach, x + reach + 1], 0, surveyed.shape[0])
    ys = np.clip([y - reach, y + reach + 1], 0, surveyed.shape[1])
    seen = total[xs[1], ys[1]] - total[xs[0], ys[1]] - total[xs[1], ys[0]] + total[xs[0], ys[0]]
    share = float(np.median(seen)) / (2 * reach + 1) ** 2
    if share >= _HOLES:
        return None
    return (
        f"half of the stations have {100 * share:.0f} % or less of their surroundings of {radius:.0f} m on the map: "
        "robots see more there than it knows; survey more of it, or build with a smaller --radius"
    )
