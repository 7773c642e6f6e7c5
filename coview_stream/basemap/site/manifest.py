"""Manifest of a site (settings, and tiles by the hashes of their layers), grid of its tiles, and parts of sites.

The manifest is a JSON file, ``manifest.json``. Its hash identifies the state of the whole site; a signature (ed25519)
covers every byte of the layers. Readers check all numbers and names, and bound their count.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.basemap.signature import SigningKey, VerifyKey
from coview_stream.basemap.site.layers import most_points
from coview_stream.basemap.site.store import SHA256, read_record, write_record
from coview_stream.basemap.tiles import Key
from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.config import MapConfig, config_of_map
from coview_stream.errors import ConfigError, MapError
from coview_stream.geometry.arrays import Floats, Ints, Reals

FORMAT = "coview-site"
VERSION = 2  # is written; sites of version 1, with layers compressed otherwise, can be read
FILE = "manifest.json"
OPENED = "opened.json"  # in a mirror: the last manifest that a map was opened from
LAYERS = ("cloud", "stations", "features")  # of a tile; features are optional
MAX_MANIFEST = 1 << 28  # bytes: 400,000 tiles
_MAX_LAYER = 1 << 28  # bytes
_MAX_INDEX = 1 << 20  # columns or rows from the origin
_MAX_METRES = 1e8
_MAX_DEPTH = 32  # of the parameters
_PURPOSE = b"site manifest\n"

TILE = 320.0  # metres, a multiple of the other grids of a map (20, 16 and 32 m, stations' blocks of 2 m)
HALO = 64.0  # metres around a tile whose points affect its layers: the radius of a virtual scan, and a margin
FEATURE_HALO = 112.0  # likewise its learned features: 64 for the network, 48 for the ground below these
PART_SUFFIX = ".tiles"
_FORMAT = "coview-part"


@dataclass(frozen=True)
class LayerEntry:
    """One layer of a tile: hash and number of its bytes."""

    sha256: str
    bytes: int


@dataclass(frozen=True)
class TileEntry:
    """One tile.

    Attributes:
        column, row: it covers ``[column, column + 1) * tile`` metres in x, likewise in y, from the site's origin.
        points: in its cloud.
        stations: on it.
        area: number of squares of a metre that hold points.
        low, high: heights of the lowest and the highest point, metres from the origin.
        layers: by name.
    """

    column: int
    row: int
    points: int
    stations: int
    area: int
    low: float
    high: float
    layers: Mapping[str, LayerEntry]

    @classmethod
    def of(cls, data: dict[str, Any]) -> TileEntry:
        """Read untrusted plain data; ValueError, TypeError, KeyError or AttributeError if they are invalid."""
        column, row = (_whole(data[name], _MAX_INDEX, signed=True) for name in ("column", "row"))
        layers = {}
        for name, layer in data["layers"].items():
            if name not in LAYERS or not SHA256.fullmatch(layer["sha256"]):
                raise ValueError(f"tile {column}, {row} has a layer {str(name)[:20]!r} that is none")
            layers[name] = LayerEntry(layer["sha256"], _whole(layer["bytes"], _MAX_LAYER))
        if not {"cloud", "stations"} <= set(layers):
            raise ValueError(f"tile {column}, {row} lacks a layer")
        points, stations, area = (_whole(data[name], 1 << 31) for name in ("points", "stations", "area"))
        return cls(column, row, points, stations, area, _number(data["low"]), _number(data["high"]), layers)

    @property
    def nbytes(self) -> int:
        """Bytes of its layers."""
        return sum(layer.bytes for layer in self.layers.values())


@dataclass(frozen=True)
class Manifest:
    """A site.

    Attributes:
        origin: (3,) metres, in the frame of the sources; zero of all other coordinates.
        tile: edge of a tile, metres.
        crs: reference system of the sources, None if they state none.
        parameters: of the build: ``config``, ``sources`` and others, as in a map file.
        tiles: by row and column.
        signer: fingerprint of the signing key; empty if unsigned.
        signature: hexadecimal; empty if unsigned.
        version: of the format.
    """

    origin: tuple[float, float, float]
    tile: float
    crs: str | None
    parameters: Mapping[str, Any]
    tiles: tuple[TileEntry, ...] = field(repr=False)
    signer: str = ""
    signature: str = ""
    version: int = VERSION

    @cached_property
    def sha256(self) -> str:
        """Hash of all but the signature."""
        return hashlib.sha256(self._content()).hexdigest()

    @property
    def nbytes(self) -> int:
        """Bytes of all layers."""
        return sum(tile.nbytes for tile in self.tiles)

    def hashes(self) -> set[str]:
        """Return the hashes of all layers."""
        return {layer.sha256 for tile in self.tiles for layer in tile.layers.values()}

    def _content(self) -> bytes:
        plain = asdict(self)
        del plain["signer"], plain["signature"]
        return json.dumps({"format": FORMAT} | plain, sort_keys=True, allow_nan=False).encode()

    def signed(self, key: SigningKey) -> Manifest:
        """Return a signed copy."""
        return replace(self, signer=key.fingerprint, signature=key.sign(_PURPOSE + self._content()).hex())

    def check_signature(self, key: VerifyKey, name: str) -> None:
        """Verify the signature; MapError if it is not signed, or not by this key."""
        if not self.signature:
            raise MapError(
                f"{name}: the site is not signed, and a signature by {key.name} is asked for; build it with --sign and "
                f"the key that {key.name} belongs to"
            )
        try:
            signature = bytes.fromhex(self.signature)
        except ValueError:
            signature = b""
        if not key.verifies(_PURPOSE + self._content(), signature):
            raise MapError(
                f"{name}: is not signed with {key.name} ({key.fingerprint}) but by {self.signer[:32]}, or was changed "
                "since; give the public key of who built it, or a site of theirs"
            )

    def to_bytes(self) -> bytes:
        """Return the file's content."""
        plain = json.loads(self._content())
        if self.signature:
            plain |= {"signer": self.signer, "signature": self.signature}
        return (json.dumps(plain, sort_keys=True, indent=1) + "\n").encode()

    @classmethod
    def from_bytes(cls, raw: bytes, name: str) -> Manifest:
        """Read untrusted bytes of :meth:`to_bytes`; MapError if they are no manifest, or of an unknown version."""
        try:
            data = json.loads(raw, parse_float=_finite, parse_constant=_finite)
            if not isinstance(data, dict) or data.get("format") != FORMAT:
                raise MapError(f"{name}: is no manifest of a site; name the directory that 'build -o DIRECTORY/' made")
            if data.get("version") not in (1, VERSION):
                raise MapError(
                    f"{name}: is of version {str(data.get('version'))[:20]}, this program reads {VERSION} and 1"
                )
            origin = tuple(_number(value) for value in data["origin"])
            if len(origin) != 3:
                raise ValueError("origin is no list of three numbers")
            tile, crs, parameters = _number(data["tile"]), data["crs"], data["parameters"]
            if not 1.0 <= tile <= 10_000.0 or not isinstance(crs, str | None) or not isinstance(parameters, dict):
                raise ValueError("tile, crs or parameters are invalid")
            _check_depth(parameters, _MAX_DEPTH)
            grid = SiteGrid((0.0, 0.0, 0.0), tile, config_of_map(parameters["config"]))
            tiles = tuple(TileEntry.of(entry) for entry in data["tiles"])
            if len({(entry.column, entry.row) for entry in tiles}) != len(tiles):
                raise ValueError("a tile is named twice")
            most = most_points(tile, grid.config.voxel)
            if any(max(entry.points, entry.stations) > most for entry in tiles):
                raise ValueError(f"a tile counts more than {most} points or stations")
            signed = str(data.get("signer", "")), str(data.get("signature", ""))
            manifest = cls(origin, tile, crs, parameters, tiles, *signed, int(data["version"]))
            _ = manifest.sha256  # can be written again
            return manifest
        except MapError:
            raise
        except (
            ValueError,
            TypeError,
            LookupError,
            AttributeError,
            OverflowError,
            RecursionError,
            ConfigError,
        ) as error:
            reason = " ".join(str(error).split())[:120]
            raise MapError(f"{name}: cannot be read as a manifest ({reason}); fetch or build the site again") from error

    def save(self, directory: Path, name: str = FILE) -> None:
        """Write it into a site's directory, complete or not at all; MapError if it cannot be written."""
        try:
            with atomic_file(directory / name, sync=True) as file:
                file.write(self.to_bytes())
        except OSError as error:
            raise MapError(f"{directory / name}: cannot be written ({error.strerror})") from error

    @classmethod
    def load(cls, directory: Path, name: str = FILE) -> Manifest:
        """Read the manifest of a site's directory; MapError if it is missing, or cannot be read."""
        path = directory / name
        try:
            with path.open("rb") as file:
                raw = file.read(MAX_MANIFEST + 1)
        except OSError as error:
            raise MapError(
                f"{directory}: is no site, {name} cannot be read ({error.strerror}); give a .coview file, or a "
                "directory that 'build -o DIRECTORY/' made"
            ) from error
        if len(raw) > MAX_MANIFEST:
            raise MapError(f"{path}: is too large for a manifest")
        return cls.from_bytes(raw, str(path))


def is_site(path: Path) -> bool:
    """Return whether a path is a directory with a manifest."""
    return (path / FILE).is_file()


def in_order(tiles: Iterable[TileEntry]) -> tuple[TileEntry, ...]:
    """Return tiles by row and column."""
    return tuple(sorted(tiles, key=lambda tile: (tile.row, tile.column)))


def _whole(value: Any, limit: int, signed: bool = False) -> int:
    if type(value) is not int or not (-limit if signed else 0) <= value <= limit:
        raise ValueError(f"{str(value)[:40]} is no whole number up to {limit}")
    return value


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:40]} is no finite number")
    return value


def _check_depth(value: object, left: int) -> None:
    if not left:
        raise ValueError("its parameters are nested too deeply")
    for item in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _check_depth(item, left - 1)


def _number(value: Any) -> float:
    if type(value) not in (int, float) or not math.isfinite(value) or abs(value) > _MAX_METRES:
        raise ValueError(f"{str(value)[:40]} is no length")
    return float(value)


@dataclass(frozen=True)
class SiteGrid:
    """Grid of a site's tiles, and settings of their build.

    Attributes:
        origin: (3,) metres, in the frame of the sources; corner of a tile.
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
    """Return the origin of a site with corners (3,): in the middle, rounded to 320 m; the lowest z, rounded to 10 m."""
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
        """Parse ``X,Y,RADIUS``; ConfigError if it is something else."""
        try:
            x, y, radius = map(float, text.split(","))
        except ValueError:
            raise ConfigError(f"around {text!r}: give X,Y,RADIUS in the map's coordinates, metres") from None
        return cls(x, y, radius)

    def __str__(self) -> str:
        """Return ``X,Y,RADIUS``."""
        return ",".join(f"{value:.15g}" for value in (self.x, self.y, self.radius))


def tiles_around(manifest: Manifest, around: Around) -> set[Key]:
    """Return the tiles that touch a circle; MapError, with the distance of the nearest one, if there are none."""
    x, y = around.x - manifest.origin[0], around.y - manifest.origin[1]
    distances = {}
    for entry in manifest.tiles:
        outside = (
            max(k * manifest.tile - value, 0.0, value - (k + 1) * manifest.tile)
            for k, value in ((entry.column, x), (entry.row, y))
        )
        distances[entry.column, entry.row] = math.hypot(*outside)
    near = {key for key, distance in distances.items() if distance <= around.radius}
    if not near:
        nearest = f"the nearest is {min(distances.values()):.0f} m away" if distances else "it has none"
        raise MapError(f"around {around}: no tile of the site is there, {nearest}; check the coordinates")
    return near


def part_file(directory: Path, keys: Collection[Key], name: str) -> Path:
    """Write a small file that is opened like a map: directory and tiles of a part of a site; return its path.

    There is one file for each site and ``name``. MapError if the cache cannot be written.
    """
    place = str(directory.resolve())
    record = hashlib.sha256(f"{place}\n{name}".encode()).hexdigest()[:16] + PART_SUFFIX
    return write_record(record, {"format": _FORMAT, "directory": place, "tiles": sorted(keys)})


def read_part(path: Path) -> tuple[Path, set[Key]]:
    """Return the site's directory and the tiles in a file of :func:`part_file`; MapError if it is another file."""
    try:
        data = read_record(path)
        if data["format"] != _FORMAT:
            raise ValueError("another format")
        return Path(str(data["directory"])), {(int(column), int(row)) for column, row in data["tiles"]}
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise MapError(f"{path}: names no part of a site ({error}); use --around again") from error


def site_directory(path: Path) -> Path | None:
    """Return the directory of the site at a map's path, or of the site of a part; None for a map file."""
    if path.suffix == PART_SUFFIX and path.is_file():
        return read_part(path)[0]
    return path if path.is_dir() else None
