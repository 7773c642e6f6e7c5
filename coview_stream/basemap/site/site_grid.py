"""Grid of a site's tiles; circles that select a part of a site, and files that list its tiles."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from coview_stream.basemap.site.store import read_record, write_record
from coview_stream.basemap.tiles import Key
from coview_stream.config import MapConfig
from coview_stream.errors import ConfigError, MapError
from coview_stream.geometry.arrays import Floats, Ints, Reals

TILE = 320.0  # metres, a multiple of a map's other grids (20, 16 and 32 m, and station blocks of 2 m)
HALO = 64.0  # metres around a tile within which points affect its layers: the radius of a virtual scan, and a margin
FEATURE_HALO = 112.0  # the same for its learned features: 64 for the network, 48 for the ground below these points
PART_SUFFIX = ".tiles"
_FORMAT = "coview-part"


@dataclass(frozen=True)
class SiteGrid:
    """Grid of a site's tiles, and settings of their build.

    Attributes:
        origin: (3,) metres, in the frame of the sources; a corner of a tile.
        tile: edge, metres, a multiple of 320.
        config: settings of the map.
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
        """Return column and row (N, 2) of the tiles at positions (N, 2 or 3) in the sources' frame."""
        return np.asarray(np.floor((xy[:, :2] - np.asarray(self.origin[:2])) / self.tile), dtype=np.int64)

    def corner(self, key: Key) -> Floats:
        """Return the lower corner (3,) of a tile, metres from the origin."""
        return np.array([key[0] * self.tile, key[1] * self.tile, 0.0])

    @staticmethod
    def around(key: Key) -> list[Key]:
        """Return a tile and its neighbours, by row and column."""
        column, row = key
        return [(column + i, row + j) for j in (-1, 0, 1) for i in (-1, 0, 1)]


def origin_of(low: npt.ArrayLike, high: npt.ArrayLike) -> tuple[float, float, float]:
    """Return the origin of a site with corners (3,): its middle rounded down to 320 m, its lowest z rounded to 10 m."""
    middle = 0.5 * (np.asarray(low, dtype=np.float64) + np.asarray(high, dtype=np.float64))
    x, y = (math.floor(float(value) / TILE) * TILE for value in middle[:2])
    return x, y, round(float(np.asarray(low, dtype=np.float64)[2]) / 10.0) * 10.0


@dataclass(frozen=True)
class Around:
    """Circle on a site.

    Attributes:
        x, y: centre, in the frame of the site's sources, metres.
        radius: metres.
    """

    x: float
    y: float
    radius: float

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.x, self.y, self.radius))) or self.radius < 0:
            raise ConfigError(f"around {self}: give X,Y,RADIUS in the map's coordinates, metres")

    @classmethod
    def parse(cls, text: str) -> Around:
        """Parse ``X,Y,RADIUS``; ConfigError if the text has another form."""
        try:
            x, y, radius = map(float, text.split(","))
        except ValueError:
            raise ConfigError(f"around {text!r}: give X,Y,RADIUS in the map's coordinates, metres") from None
        return cls(x, y, radius)

    def __str__(self) -> str:
        """Return ``X,Y,RADIUS``."""
        return ",".join(f"{value:.15g}" for value in (self.x, self.y, self.radius))


def part_file(directory: Path, keys: Collection[Key], name: str) -> Path:
    """Write directory and tiles of a part of a site into a small file that opens like a map, and return its path.

    There is one file per site and ``name``. MapError if the cache cannot be written.
    """
    place = str(directory.resolve())
    record = hashlib.sha256(f"{place}\n{name}".encode()).hexdigest()[:16] + PART_SUFFIX
    return write_record(record, {"format": _FORMAT, "directory": place, "tiles": sorted(keys)})


def read_part(path: Path) -> tuple[Path, set[Key]]:
    """Return the site's directory and the tiles in a file of :func:`part_file`; MapError if it is no such file."""
    try:
        data = read_record(path)
        if data["format"] != _FORMAT:
            raise ValueError("another format")
        return Path(str(data["directory"])), {(int(column), int(row)) for column, row in data["tiles"]}
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise MapError(f"{path}: names no part of a site ({error}); use --around again") from error


def site_directory(path: Path) -> Path | None:
    """Return the site's directory for the path of a site or of a part; None for a map file."""
    if path.suffix == PART_SUFFIX and path.is_file():
        return read_part(path)[0]
    return path if path.is_dir() else None
