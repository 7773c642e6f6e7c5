"""Part of a site: a small file that names a site's directory and some of its tiles, and is opened like a map."""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from coview_stream.basemap.site.cache import cache_folder, read_record, write_record
from coview_stream.basemap.site.grid import Key
from coview_stream.basemap.site.manifest import Manifest
from coview_stream.errors import ConfigError, MapError

log = logging.getLogger("coview_stream.maps")

SUFFIX = ".tiles"
_FORMAT = "coview-part"


@dataclass(frozen=True)
class Around:
    """A circle.

    Attributes:
        x, y: its centre, in the frame of the site's sources, metres.
        radius: metres.
    """

    x: float
    y: float
    radius: float

    def __post_init__(self) -> None:
        """Check it; ConfigError where it is none."""
        if not all(map(math.isfinite, (self.x, self.y, self.radius))) or self.radius < 0:
            raise ConfigError(f"around {self}: give X,Y,RADIUS in the map's coordinates, metres")

    @classmethod
    def parse(cls, text: str) -> Around:
        """Return the circle that ``X,Y,RADIUS`` means; ConfigError where it means none."""
        try:
            x, y, radius = map(float, text.split(","))
        except ValueError:
            raise ConfigError(f"around {text!r}: give X,Y,RADIUS in the map's coordinates, metres") from None
        return cls(x, y, radius)

    def __str__(self) -> str:
        """Return it as it is given."""
        return ",".join(f"{value:.15g}" for value in (self.x, self.y, self.radius))


def tiles_around(manifest: Manifest, *circles: Around) -> set[Key]:
    """Return the tiles that circles meet.

    Raises:
        MapError: there is none; how far the nearest one is, is said.
    """
    near, nearest = set(), []
    for around in circles:
        distances = _distances(manifest, around)
        near |= {key for key, distance in distances.items() if distance <= around.radius}
        nearest.append(min(distances.values(), default=math.inf))
    if not near:
        away = f"the nearest is {min(nearest):.0f} m away" if manifest.tiles else "it has none"
        raise MapError(f"around {circles[0]}: no tile of the site is there, {away}; check the coordinates")
    return near


def _distances(manifest: Manifest, around: Around) -> dict[Key, float]:
    """Return how far each tile is from the middle of a circle, metres."""
    x, y = around.x - manifest.origin[0], around.y - manifest.origin[1]

    def away(column: int, row: int) -> float:
        beside = (
            max(k * manifest.tile - value, 0.0, value - (k + 1) * manifest.tile) for k, value in ((column, x), (row, y))
        )
        return math.hypot(*beside)

    return {(tile.column, tile.row): away(tile.column, tile.row) for tile in manifest.tiles}


def part_file(directory: Path, keys: Collection[Key], name: str) -> Path:
    """Write which tiles of a site to open, and return the file, one for each site and name.

    Raises:
        MapError: the cache cannot be written.
    """
    place = str(directory.resolve())
    record = hashlib.sha256(f"{place}\n{name}".encode()).hexdigest()[:16] + SUFFIX
    return write_record(record, {"format": _FORMAT, "directory": place, "tiles": sorted(keys)})


def read_part(path: Path) -> tuple[Path, set[Key]]:
    """Return the site's directory and the tiles that a file names.

    Raises:
        MapError: it is something else.
    """
    try:
        data = read_record(path)
        if data["format"] != _FORMAT:
            raise ValueError("another format")
        return Path(str(data["directory"])), {(int(column), int(row)) for column, row in data["tiles"]}
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise MapError(f"{path}: names no part of a site ({error}); use --around again") from error


def keep_places(directory: Path, name: str, places: Mapping[str, tuple[float, float]]) -> None:
    """Write where robots were on a part of a site, for the next start; what goes wrong is left to the log."""
    try:
        write_record(_places_record(directory, name), places)
    except MapError as error:
        log.warning("%s", error)


def kept_places(directory: Path, name: str) -> dict[str, tuple[float, float]]:
    """Return what :func:`keep_places` has written, nothing where there is no such file, or another one."""
    try:
        data = read_record(cache_folder() / "parts" / _places_record(directory, name))
        found = {str(robot): (float(x), float(y)) for robot, (x, y) in data.items()}
        return {robot: place for robot, place in found.items() if all(map(math.isfinite, place))}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def _places_record(directory: Path, name: str) -> str:
    return hashlib.sha256(f"{directory.resolve()}\n{name}".encode()).hexdigest()[:16] + ".places"


def site_directory(path: Path) -> Path | None:
    """Return the directory of the site that a map's path means, or is a part of; None for a file."""
    if path.suffix == SUFFIX and path.is_file():
        return read_part(path)[0]
    return path if path.is_dir() else None
