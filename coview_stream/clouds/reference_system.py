"""Coordinate reference systems of cloud files and maps.

A map must be in metres, east, north and up, with lengths as on the ground: on a map of a wrong scale a robot is never
found.
"""

from __future__ import annotations

import importlib.util
import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from coview_stream.errors import PIP_INSTALL, InputError, printable, require_library
from coview_stream.geometry.arrays import Floats

_PROJECTED, _GEOGRAPHIC, _VERTICAL = 3072, 2048, 4096  # GeoTIFF keys of reference systems
LINEAR_UNIT, VERTICAL_UNIT = 3076, 4099  # GeoTIFF keys of units
_CODES = range(1024, 32767)  # EPSG; 32767 is a system that other keys describe
_METRE = 9001
FOOT = 0.3048  # metres
UNKNOWN = "unknown"  # name without a system
_NORTH_STEP = 10.0  # metres along the map's north axis that measure true north
_UNITS = {9002: "feet", 9003: "US survey feet", 9005: "Clarke's feet", 9014: "fathoms", 9093: "miles"}

_MAX_SCALE_ERROR = 0.01  # of a projection: half a metre in 50 m


def stated_system(wkt: str, keys: Mapping[int, int]) -> str | None:
    """Return the stated system: WKT, ``EPSG:code`` or ``EPSG:code+vertical code``; None if there is none."""
    if wkt:
        return wkt
    horizontal = next((keys[key] for key in (_PROJECTED, _GEOGRAPHIC) if keys.get(key, 0) in _CODES), None)
    if horizontal is None:
        return None
    name, vertical = f"EPSG:{horizontal}", keys.get(_VERTICAL, 0)
    return f"{name}+{vertical}" if vertical in _CODES and parse_system(f"EPSG:{vertical}") else name


def flaw_of_system(text: str | None, keys: Mapping[int, int], low: Floats, high: Floats) -> str | None:
    """Return why coordinates in this system allow no map, and the remedy; None if they do.

    Args:
        text: the system, from :func:`stated_system`.
        keys: GeoTIFF keys; some state units separately.
        low: (3,) lower corner of the coordinates.
        high: (3,) upper corner.
    """
    flaw, system, text = None, parse_system(text), text or ""
    geographic = re.search(r"GEOG(CS|CRS)\[", text) and not re.search(r"(PROJ(CS|CRS)|ENGCRS)\[", text)
    units = {key: _UNITS.get(keys.get(key, _METRE)) for key in (LINEAR_UNIT, VERTICAL_UNIT)}
    if units[LINEAR_UNIT]:
        flaw = f"coordinates are in {units[LINEAR_UNIT]}"
    elif units[VERTICAL_UNIT]:
        flaw = f"heights are in {units[VERTICAL_UNIT]}"
    elif re.search(r'UNIT\["[^"]*(foot|feet)', text, re.IGNORECASE):
        flaw = "coordinates are in feet"
    elif geographic and _like_degrees(low, high):
        flaw = "coordinates are in degrees"
    if flaw is None and system is not None:
        flaw = _flaw(system, 0.5 * (low + high))
    if flaw is None:
        return None
    remedy = f"reproject it to {_metric_system(system, low, high)}"
    if "feet" in flaw and text and importlib.util.find_spec("pyproj") is None:
        remedy = f"{PIP_INSTALL} 'pyproj>=3.6', by which they are converted"
    return f"{flaw} according to its reference system; {remedy}"


def unchecked_system(text: str | None) -> bool:
    """Return whether a system is only a code that cannot be looked up without pyproj."""
    return text is not None and text.startswith("EPSG:") and importlib.util.find_spec("pyproj") is None


def flaw_of_name(text: str) -> str | None:
    """Return why a system that a user named does not fit metric coordinates; None if it does, or without pyproj."""
    if importlib.util.find_spec("pyproj") is None:
        return None
    system = parse_system(text)
    if system is None:
        return "is not a reference system; give EPSG:code, WKT, feet or us-feet"
    if system.is_geographic:
        return "is in degrees; give the system of metres that the coordinates are in"
    return None


def same_system(one: str | None, other: str | None) -> bool:
    """Return whether two systems may be the same, as when one is unknown or states no heights."""
    if one is None or other is None or one == other:
        return True
    first, second = parse_system(one), parse_system(other)
    if first is None or second is None:
        return False
    for a, b in zip(parts_of_system(first), parts_of_system(second), strict=False):
        code = a.to_epsg()
        if not a.equals(b, ignore_axis_order=True) and (code is None or code != b.to_epsg()):
            return False
    return True


def short_name(text: str | None) -> str:
    """Return a system's name in a few words."""
    if text is None:
        return UNKNOWN
    system = parse_system(text)
    if system is not None:
        code = system.to_epsg()
        return f"EPSG:{code} {system.name}" if code else str(system.name)
    named = re.match(r'\s*\w+\["([^"]+)"', text)
    return printable(named.group(1) if named else " ".join(text.split()))[:60]


def epsg_of(text: str | None) -> int | None:
    """Return the EPSG number of a system's horizontal part; None if it has none, or without pyproj."""
    system = None if text is None else parse_system(text)
    code = None if system is None else parts_of_system(system)[0].to_epsg()
    return None if code is None else int(code)


def _like_degrees(low: Floats, high: Floats) -> bool:
    return bool(np.abs([low[:2], high[:2]]).max() <= 360.0)


def parse_system(text: str | None) -> Any:
    """Return a pyproj.CRS; None without pyproj, or for an unknown text, as the points may still be good."""
    if not text or importlib.util.find_spec("pyproj") is None:
        return None
    import pyproj

    try:
        return pyproj.CRS.from_user_input(text)
    except pyproj.exceptions.CRSError:
        return None


def parts_of_system(system: Any) -> list[Any]:
    """Return the horizontal part of a system and, if it has one, the vertical part."""
    whole = system.source_crs if system.is_bound and system.source_crs is not None else system
    return [part.source_crs if part.is_bound else part for part in (whole.sub_crs_list or [whole])]


def _flaw(system: Any, centre: Floats) -> str | None:
    parts = parts_of_system(system)
    if parts[0].is_geocentric:
        return "coordinates are geocentric (z does not point up)"
    if parts[0].is_geographic:
        return "coordinates are in degrees" if _like_degrees(centre, centre) else None
    axes = [("coordinates", axis) for axis in parts[0].axis_info[:2]]
    axes += [("heights", axis) for part in (parts[0].axis_info[2:], *(p.axis_info for p in parts[1:])) for axis in part]
    for subject, axis in axes:
        if abs(axis.unit_conversion_factor - 1.0) > 1e-9:
            unit = {"foot": "feet", "US survey foot": "US survey feet"}.get(axis.unit_name, axis.unit_name)
            return f"{subject} are in {unit} ({system.name})"
    place = _longitude_latitude(parts[0], centre)
    if place is None:  # outside the system's area
        return None
    import pyproj

    factors = pyproj.Proj(parts[0]).get_factors(*place)
    scale = float(np.sqrt(abs(factors.meridional_scale * factors.parallel_scale)))
    if np.isfinite(scale) and scale > 0 and abs(scale - 1.0) > _MAX_SCALE_ERROR:
        return f"lengths are {scale:.2f} times those on the ground ({system.name} is a map of the world, not of a site)"
    return None


def _longitude_latitude(projected: Any, centre: Floats) -> tuple[float, float] | None:
    import pyproj

    try:
        to_degrees = pyproj.Transformer.from_crs(projected, projected.geodetic_crs, always_xy=True)
        longitude, latitude = to_degrees.transform(float(centre[0]), float(centre[1]))
    except pyproj.exceptions.ProjError:
        return None
    inside = np.isfinite([longitude, latitude]).all() and abs(latitude) < 89.0
    return (float(longitude), float(latitude)) if inside else None


def _metric_system(system: Any, low: Floats, high: Floats) -> str:
    """Name a metric system for the location, if possible."""
    how = "a metric system, for example with `pdal translate -f filters.reprojection`"
    centre = 0.5 * (low + high)
    if system is None or parts_of_system(system)[0].is_geocentric:
        return how
    horizontal = parts_of_system(system)[0]
    place = (
        (float(centre[0]), float(centre[1])) if horizontal.is_geographic else _longitude_latitude(horizontal, centre)
    )
    if place is None or not -80 <= place[1] <= 84:
        return how
    zone = int((place[0] + 180.0) // 6.0) % 60 + 1
    return f"EPSG:{(32600 if place[1] >= 0 else 32700) + zone} or another {how[2:]}"


class GeoReference:
    """Conversion of map coordinates to WGS 84.

    Heights are above the ellipsoid if the system states its vertical datum and pyproj has the grid for it; otherwise
    they are the map's heights.

    Args:
        crs: reference system of the map, WKT or ``EPSG:code``.

    Raises:
        InputError: the map has no reference system, or one without a place on Earth. DependencyError: no pyproj.
    """

    def __init__(self, crs: str | None) -> None:
        pyproj = require_library("pyproj", "pyproj>=3.6", "latitude and longitude")
        if crs is None:
            raise InputError(
                "the map states no reference system, so that its poses have no latitude and longitude; "
                "build it with --crs EPSG:N"
            )
        try:
            system = pyproj.CRS.from_user_input(crs)
            self.name = short_name(crs)
            self._has_heights = system.is_compound or len(system.axis_info) == 3
            target = "EPSG:4979" if self._has_heights else "EPSG:4326"
            self._to_degrees: Any = pyproj.Transformer.from_crs(system, target, always_xy=True)
        except pyproj.exceptions.ProjError as error:
            raise InputError(f"the map's reference system {short_name(crs)} has no place on Earth ({error})") from error

    def geodetic(self, positions: Floats) -> Floats:
        """Return latitude, longitude (degrees) and height (metres), (N, 3), of positions (N, 3) in the map frame.

        NaN for a position that is not on Earth.
        """
        x, y, z = np.asarray(positions, dtype=np.float64).reshape(-1, 3).T
        if self._has_heights:
            longitude, latitude, height = self._to_degrees.transform(x, y, z)
        else:
            (longitude, latitude), height = self._to_degrees.transform(x, y), z
        out = np.stack([latitude, longitude, height], axis=1)
        out[~np.isfinite(out).all(axis=1)] = np.nan
        return out

    def convergence(self, position: Floats) -> float:
        """Return the bearing of the map's north axis at a position (3,), radians clockwise from true north."""
        north = np.add(position, (0.0, _NORTH_STEP, 0.0))
        (lat, lon, _), (lat_n, lon_n, _) = np.radians(self.geodetic(np.stack([position, north])))
        east = math.sin(lon_n - lon) * math.cos(lat_n)
        along = math.cos(lat) * math.sin(lat_n) - math.sin(lat) * math.cos(lat_n) * math.cos(lon_n - lon)
        return math.atan2(east, along)

    def heading(self, position: Floats, yaw: float) -> float:
        """Return the compass heading of a yaw in the map, radians in [0, 2 pi), clockwise from true north."""
        return (math.pi / 2.0 - yaw + self.convergence(position)) % (2.0 * math.pi)

    def enu_covariance(self, position: Floats, covariance: Floats) -> Floats:
        """Rotate a covariance (3, 3), m2, from the map's x, y, z to east, north, up."""
        angle = self.convergence(position)  # clockwise, of the map's axes
        turn = np.array(
            [[math.cos(angle), math.sin(angle), 0.0], [-math.sin(angle), math.cos(angle), 0.0], [0, 0, 1.0]]
        )
        return np.asarray(turn @ np.asarray(covariance, dtype=np.float64)[:3, :3] @ turn.T)
