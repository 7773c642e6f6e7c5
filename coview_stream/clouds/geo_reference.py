"""Places on Earth of map coordinates: latitude, longitude, height and true north, by the map's reference system."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from coview_stream.clouds.reference_system import short_name
from coview_stream.errors import InputError, require_library
from coview_stream.geometry.arrays import Floats

_STEP = 10.0  # metres to the north by which true north is measured


class GeoReference:
    """Map coordinates as WGS 84.

    Heights are above the ellipsoid where the reference system says what its own refer to and pyproj has the grid for
    it; else those of the map, as they are.

    Args:
        crs: of the map, WKT or ``EPSG:code``.

    Raises:
        InputError: the map states no reference system, or one that has no place on Earth. DependencyError: no pyproj.
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
            self._flat: Any = pyproj.Transformer.from_crs(system, "EPSG:4326", always_xy=True)
            self._high: Any = None
            if system.is_compound or len(system.axis_info) == 3:
                self._high = pyproj.Transformer.from_crs(system, "EPSG:4979", always_xy=True)
        except pyproj.exceptions.ProjError as error:
            raise InputError(f"the map's reference system {short_name(crs)} has no place on Earth ({error})") from error

    def geodetic(self, positions: Floats) -> Floats:
        """Return latitude, longitude (degrees) and height (metres), (N, 3), of positions (N, 3) in the map's frame.

        NaN where a position has no place on Earth.
        """
        x, y, z = np.asarray(positions, dtype=np.float64).reshape(-1, 3).T
        if self._high is None:
            longitude, latitude = self._flat.transform(x, y)
            height = z
        else:
            longitude, latitude, height = self._high.transform(x, y, z)
        out = np.stack([latitude, longitude, height], axis=1)
        out[~np.isfinite(out).all(axis=1)] = np.nan
        return out

    def convergence(self, position: Floats) -> float:
        """Return the bearing of the map's north at a position (3,), radians, clockwise from true north."""
        north = np.add(position, (0.0, _STEP, 0.0))
        (lat, lon, _), (lat_n, lon_n, _) = np.radians(self.geodetic(np.stack([position, north])))
        east = math.sin(lon_n - lon) * math.cos(lat_n)
        along = math.cos(lat) * math.sin(lat_n) - math.sin(lat) * math.cos(lat_n) * math.cos(lon_n - lon)
        return math.atan2(east, along)

    def heading(self, position: Floats, yaw: float) -> float:
        """Return the compass heading of a yaw in the map, radians in [0, 2 pi), clockwise from true north."""
        return (math.pi / 2.0 - yaw + self.convergence(position)) % (2.0 * math.pi)

    def enu_covariance(self, position: Floats, covariance: Floats) -> Floats:
        """Return a covariance (3, 3) of x, y, z in map axes as one of east, north, up, m2."""
        angle = self.convergence(position)  # the map's axes are turned clockwise by it
        turn = np.array(
            [[math.cos(angle), math.sin(angle), 0.0], [-math.sin(angle), math.cos(angle), 0.0], [0, 0, 1.0]]
        )
        return np.asarray(turn @ np.asarray(covariance, dtype=np.float64)[:3, :3] @ turn.T)
