"""Grid of a site's tiles, and the settings that all of its tiles are built with."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from coview_stream.config import MapConfig
from coview_stream.errors import ConfigError
from coview_stream.geometry.arrays import Floats, Ints, Reals

TILE = 320.0
"""Edge of a tile, metres: a multiple of what else the map is cut into (20, 16 and 32 m, stations' blocks of 2 m)."""

HALO = 64.0
"""Metres around a tile whose points take part in what is found on it: radius of a virtual scan, and some more."""

FEATURE_HALO = 112.0
"""Metres around a tile that its learned features see: 64 for the network and 48 for the ground below those."""

Key = tuple[int, int]
"""Column and row of a tile."""


@dataclass(frozen=True)
class SiteGrid:
    """Where a site's tiles lie, and how they are built.

    Attributes:
        origin: (3,) metres, in the frame of the sources; a tile's corner lies there.
        tile: metres, a multiple of 320.
        config: of the map.
    """

    origin: tuple[float, float, float]
    tile: float
    config: MapConfig

    def __post_init__(self) -> None:
        if not 0 < self.tile <= 4 * TILE or self.tile % TILE:
            raise ConfigError(f"tile={self.tile}: tiles are of 320, 640, 960 or 1280 m")
        if TILE % self.config.tile:
            raise ConfigError(f"tile={self.config.tile} of the cloud: a site needs one that divides {TILE:g} m")

    def cells(self, xy: Reals) -> Ints:
        """Return column and row (N, 2) of the tiles that positions (N, 2 or 3) in the sources' frame lie in."""
        return np.asarray(np.floor((xy[:, :2] - np.asarray(self.origin[:2])) / self.tile), dtype=np.int64)

    def corner(self, key: Key) -> Floats:
        """Return the lower corner (3,) of a tile, metres from the origin."""
        return np.array([key[0] * self.tile, key[1] * self.tile, 0.0])

    @staticmethod
    def around(key: Key) -> list[Key]:
        """Return a tile and those that touch it, by row and column."""
        column, row = key
        return [(column + i, row + j) for j in (-1, 0, 1) for i in (-1, 0, 1)]


def origin_of(low: npt.ArrayLike, high: npt.ArrayLike) -> tuple[float, float, float]:
    """Choose the origin of a site by the corners (3,) of its extent: in its middle, a multiple of 320 m, of 10 in z."""
    middle = 0.5 * (np.asarray(low, dtype=np.float64) + np.asarray(high, dtype=np.float64))
    x, y = (math.floor(float(each) / TILE) * TILE for each in middle[:2])
    return x, y, round(float(np.asarray(low, dtype=np.float64)[2]) / 10.0) * 10.0
