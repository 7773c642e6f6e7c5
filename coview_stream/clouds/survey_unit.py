"""Surveys in feet: their units in metres, and the same reference system in metres."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from coview_stream.clouds.cloud import CloudBuilder
from coview_stream.clouds.reference_system import FOOT, LINEAR_UNIT, VERTICAL_UNIT, parse_system, parts_of_system
from coview_stream.geometry.arrays import Floats, Reals

US_FOOT = 1200 / 3937  # metres
UNITS = {"feet": FOOT, "us-feet": US_FOOT}
"""Metres per unit, by the names for surveys of an unknown system."""

_KEYS = {9001: 1.0, 9002: FOOT, 9003: US_FOOT}  # metres per unit, by its GeoTIFF code
_NAMES = {"foot": "feet", "US survey foot": "US survey feet"}


@dataclass(frozen=True)
class SurveyUnit:
    """Unit of a survey that is not in metres.

    Attributes:
        name: name for people.
        metres: metres per unit of x, y and z.
        crs: the survey's system, in metres; None if it has none.
    """

    name: str
    metres: tuple[float, float, float]
    crs: str | None

    def to_metres(self, coordinates: Reals) -> Floats:
        """Convert coordinates (..., 3)."""
        return np.asarray(coordinates, dtype=np.float64) * self.metres


def unit_of_system(text: str | None, keys: Mapping[int, int] | None = None) -> SurveyUnit | None:
    """Return the unit that a system or GeoTIFF keys state; None if it is the metre, or not known.

    Heights without a unit of their own have the unit of x and y.
    """
    if text in UNITS:
        name = "US survey feet" if text == "us-feet" else "feet"
        return SurveyUnit(name, (UNITS[text],) * 3, f'LOCAL_CS["converted from {name}",UNIT["metre",1]]')
    keys, system = keys or {}, parse_system(text)
    linear, vertical = (_KEYS.get(keys.get(key, 0)) for key in (LINEAR_UNIT, VERTICAL_UNIT))
    if system is None:
        if text is not None or linear in (None, 1.0):
            return None
        return SurveyUnit("feet", (linear, linear, vertical or linear), None)
    parts = parts_of_system(system)
    if not parts[0].is_projected:
        return None
    axes = parts[0].axis_info
    plane = axes[0].unit_conversion_factor
    if linear not in (None, plane):
        return None  # contradictory
    heights = [*axes[2:], *(axis for part in parts[1:] for axis in part.axis_info)]
    up = heights[0].unit_conversion_factor if heights else vertical or plane
    if (plane, up) == (1.0, 1.0):
        return None
    unit = axes[0].unit_name if plane != 1.0 else heights[0].unit_name if heights else "foot"
    name = ("metres, and heights in " if plane == 1.0 else "") + _NAMES.get(unit, unit)
    return SurveyUnit(name, (plane, plane, up), _in_metres(system))


def _in_metres(system: Any) -> str:
    """Return the WKT of a system after conversion of its coordinates to metres."""
    import pyproj

    whole = system.source_crs if system.is_bound and system.source_crs is not None else system
    data = whole.to_json_dict()
    for part in data.get("components", [data]):
        for axis in part["coordinate_system"]["axis"]:
            axis["unit"] = "metre"
        part.pop("id", None)
    data.pop("id", None)
    data["name"] = f"{data['name']}, in metres"
    return str(pyproj.CRS.from_json_dict(data).to_wkt("WKT1_GDAL"))


class InMetres(CloudBuilder):
    """Builder that converts chunks to metres for another builder."""

    def __init__(self, builder: CloudBuilder, unit: SurveyUnit) -> None:
        super().__init__()
        self._builder, self._unit = builder, unit

    def add(self, raw: Reals, classification: Any = None, dropped: int = 0) -> None:
        """Convert (N, 3) raw coordinates and append them."""
        self._builder.add(self._unit.to_metres(raw), classification, dropped)
