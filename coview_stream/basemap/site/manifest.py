"""Manifest of a site: what its tiles are, by the hashes of their layers, and how they were made.

A JSON file, ``manifest.json``. Its hash names the state of the whole site; a signature (ed25519) covers every byte that
it names. Nothing is believed on reading: numbers and names are checked, and their count bounded.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from coview_stream.basemap.signature import SigningKey, VerifyKey
from coview_stream.basemap.site.tile_store import SHA256
from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.errors import MapError

FORMAT = "coview-site"
VERSION = 2
"""Of what is written; layers of sites of version 1, compressed otherwise, are read as well."""
FILE = "manifest.json"
LAYERS = ("cloud", "stations", "features")
"""Layers of a tile: its points with normals, its stations, and learned features, which need not be there."""

MAX_MANIFEST = 1 << 28
"""Bytes of a manifest at most: 400,000 tiles; set by hand."""

_MAX_LAYER = 1 << 28  # bytes
_MAX_INDEX = 1 << 20  # columns or rows from the origin
_MAX_METRES = 1e8
_PURPOSE = b"site manifest\n"


@dataclass(frozen=True)
class LayerEntry:
    """One layer of a tile.

    Attributes:
        sha256: of its bytes.
        bytes: how many they are.
    """

    sha256: str
    bytes: int


@dataclass(frozen=True)
class TileEntry:
    """One tile.

    Attributes:
        column, row: it covers ``[column, column + 1) * tile`` metres in x, likewise in y, from the site's origin.
        points: in its cloud.
        stations: on it.
        area: square metres of it that hold points, in squares of a metre.
        low, high: heights of its lowest and its highest point, metres from the origin.
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

    @property
    def nbytes(self) -> int:
        """Bytes of its layers."""
        return sum(layer.bytes for layer in self.layers.values())


@dataclass(frozen=True)
class Manifest:
    """A site.

    Attributes:
        origin: (3,) metres, in the frame of the sources; all else counts from it.
        tile: edge of a tile, metres.
        crs: reference system of the sources, None if they state none.
        parameters: how the map was built: ``config``, ``sources`` and what else a map's file says of it.
        tiles: by row and column.
        signer: fingerprint of the key that it is signed with; empty for none.
        signature: hexadecimal; empty for none.
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

    @property
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
        plain = asdict(replace(self, signer="", signature=""))
        del plain["signer"], plain["signature"]
        return json.dumps({"format": FORMAT} | plain, sort_keys=True, allow_nan=False).encode()

    def signed(self, key: SigningKey) -> Manifest:
        """Return it with a signature."""
        return replace(self, signer=key.fingerprint, signature=key.sign(_PURPOSE + self._content()).hex())

    def check_signature(self, key: VerifyKey, name: str) -> None:
        """Verify the signature.

        Raises:
            MapError: it is not signed, or not by this key.
        """
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
        """Read what :meth:`to_bytes` wrote, from anyone.

        Raises:
            MapError: it is something else, or of a version that is not known.
        """
        try:
            data = json.loads(raw)
            if not isinstance(data, dict) or data.get("format") != FORMAT:
                raise MapError(f"{name}: is no manifest of a site; name the directory that 'build -o DIRECTORY/' made")
            if data.get("version") not in (1, VERSION):
                raise MapError(
                    f"{name}: is of version {str(data.get('version'))[:20]}, this program reads {VERSION} and 1"
                )
            return _manifest(data)
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
            reason = " ".join(str(error).split())[:120]
            raise MapError(f"{name}: cannot be read as a manifest ({reason}); fetch or build the site again") from error

    def save(self, directory: Path) -> None:
        """Write it into a site's directory, complete or not at all.

        Raises:
            MapError: it cannot be written.
        """
        try:
            with atomic_file(directory / FILE, sync=True) as file:
                file.write(self.to_bytes())
        except OSError as error:
            raise MapError(f"{directory / FILE}: cannot be written ({error.strerror})") from error

    @classmethod
    def load(cls, directory: Path) -> Manifest:
        """Read that of a site's directory.

        Raises:
            MapError: there is none, or it cannot be read.
        """
        path = directory / FILE
        try:
            with path.open("rb") as file:
                raw = file.read(MAX_MANIFEST + 1)
        except OSError as error:
            raise MapError(
                f"{directory}: is no site, {FILE} cannot be read ({error.strerror}); give a .coview file, or a "
                "directory that 'build -o DIRECTORY/' made"
            ) from error
        if len(raw) > MAX_MANIFEST:
            raise MapError(f"{path}: is too large for a manifest")
        return cls.from_bytes(raw, str(path))


def is_site(path: Path) -> bool:
    """Tell whether a path is a directory with a manifest."""
    return (path / FILE).is_file()


def in_order(tiles: Iterable[TileEntry]) -> tuple[TileEntry, ...]:
    """Return tiles by row and column."""
    return tuple(sorted(tiles, key=lambda tile: (tile.row, tile.column)))


def _manifest(data: dict[str, Any]) -> Manifest:
    origin = tuple(_number(each) for each in data["origin"])
    if len(origin) != 3:
        raise ValueError("origin is no list of three numbers")
    tile, crs, parameters = _number(data["tile"]), data["crs"], data["parameters"]
    if not 1.0 <= tile <= 10_000.0 or not isinstance(crs, str | None) or not isinstance(parameters, dict):
        raise ValueError("tile, crs or parameters are not what they should be")
    tiles = tuple(_tile(each) for each in data["tiles"])
    if len({(each.column, each.row) for each in tiles}) != len(tiles):
        raise ValueError("a tile is named twice")
    signed = str(data.get("signer", "")), str(data.get("signature", ""))
    return Manifest(origin, tile, crs, parameters, tiles, *signed, int(data["version"]))


def _tile(data: dict[str, Any]) -> TileEntry:
    column, row = (_whole(data[name], _MAX_INDEX, signed=True) for name in ("column", "row"))
    layers = {}
    for name, each in data["layers"].items():
        if name not in LAYERS or not SHA256.fullmatch(each["sha256"]):
            raise ValueError(f"tile {column}, {row} has a layer {str(name)[:20]!r} that is none")
        layers[name] = LayerEntry(each["sha256"], _whole(each["bytes"], _MAX_LAYER))
    if not {"cloud", "stations"} <= set(layers):
        raise ValueError(f"tile {column}, {row} lacks a layer")
    points, stations, area = (_whole(data[name], 1 << 31) for name in ("points", "stations", "area"))
    return TileEntry(column, row, points, stations, area, _number(data["low"]), _number(data["high"]), layers)


def _whole(value: Any, limit: int, signed: bool = False) -> int:
    if type(value) is not int or not (-limit if signed else 0) <= value <= limit:
        raise ValueError(f"{str(value)[:40]} is no whole number up to {limit}")
    return value


def _number(value: Any) -> float:
    if type(value) not in (int, float) or not math.isfinite(value) or abs(value) > _MAX_METRES:
        raise ValueError(f"{str(value)[:40]} is no length")
    return float(value)
