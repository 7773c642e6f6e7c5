"""Manifest of a site, the JSON file ``manifest.json``: settings, and the tiles with the hashes of their layers.

Its hash identifies the state of the whole site. Its signature (ed25519) covers the layers by their hashes. Readers
verify the signature before they read anything else. Then they parse and check the tiles one by one: other threads run
in between, and a wrong manifest is refused before it fills the memory.
"""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn

from coview_stream.basemap.signature import SigningKey, VerifyKey, open_plain, sha256_of
from coview_stream.basemap.site.layers import most_bytes, most_points
from coview_stream.basemap.site.site_grid import Around, SiteGrid
from coview_stream.basemap.site.store import SHA256
from coview_stream.basemap.tiles import Key
from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.config import config_of_map
from coview_stream.errors import ConfigError, MapError

FORMAT = "coview-site"
VERSION = 2  # written; version 1, whose layers are compressed differently, can be read
FILE = "manifest.json"
OPENED = "opened.json"  # in a mirror: the last manifest from which a map was opened
LAYERS = ("cloud", "stations", "features")  # of a tile; features are optional
MAX_MANIFEST = 1 << 24  # bytes: 35,000 tiles, of which 5,300 can be opened as one map
MAX_LAYER = 1 << 28  # bytes
_MAX_HEAD = 1 << 21  # bytes before the tiles: 18,000 sources
_MAX_TAIL = 64  # bytes after the tiles: the version
_MAX_ENTRY = 2048  # bytes of a tile; usual are 450
_MOST_PACKED = 4  # points per byte of a cloud layer: ten times the density at which measured positions can be packed
_MAX_OVERHEAD = 1 << 17  # bytes of a layer besides its arrays
_MAX_INDEX = 1 << 20  # columns or rows from the origin
_MAX_METRES = 1e8
_MAX_DEPTH = 32  # of the parameters
_PURPOSE = b"site manifest\n"
_BEGIN = re.compile(rb'(?:, "signature": "([0-9a-f]*)", "signer": "([0-9a-f]*)")?(, "tile": [-+.0-9eE]+, "tiles": \[)')


@dataclass(frozen=True)
class LayerEntry:
    """One layer of a tile: the hash and the number of its bytes."""

    sha256: str
    bytes: int


@dataclass(frozen=True)
class TileEntry:
    """One tile.

    Attributes:
        column, row: it covers ``[column, column + 1) * tile`` metres in x, likewise in y, from the site's origin.
        points: number of points in its cloud.
        stations: number of stations.
        area: number of one-metre squares that hold points.
        low, high: heights of the lowest and the highest point, metres from the origin.
        layers: layers by name.
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
            layers[name] = LayerEntry(layer["sha256"], _whole(layer["bytes"], MAX_LAYER))
        if not {"cloud", "stations"} <= set(layers):
            raise ValueError(f"tile {column}, {row} lacks a layer")
        points, stations, area = (_whole(data[name], 1 << 31) for name in ("points", "stations", "area"))
        return cls(column, row, points, stations, area, _number(data["low"]), _number(data["high"]), layers)

    @property
    def nbytes(self) -> int:
        """Size of its layers, bytes."""
        return sum(layer.bytes for layer in self.layers.values())


@dataclass(frozen=True)
class Manifest:
    """Manifest of a site.

    Attributes:
        origin: (3,) metres, in the frame of the sources; zero of all other coordinates.
        tile: edge of a tile, metres.
        crs: reference system of the sources, None if they state none.
        parameters: parameters of the build: ``config``, ``sources`` and others, as in a map file.
        tiles: tiles sorted by row and column.
        signer: fingerprint of the signing key; empty if unsigned.
        signature: hexadecimal; empty if unsigned.
        version: format version.
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
        return sha256_of(self._pieces())

    @property
    def nbytes(self) -> int:
        """Size of all layers, bytes."""
        return sum(tile.nbytes for tile in self.tiles)

    def hashes(self) -> set[str]:
        """Return the hashes of all layers."""
        return {layer.sha256 for tile in self.tiles for layer in tile.layers.values()}

    def tiles_around(self, around: Around) -> set[Key]:
        """Return the tiles that touch a circle; MapError, with the distance of the nearest tile, if there are none."""
        x, y = around.x - self.origin[0], around.y - self.origin[1]
        distances = {}
        for entry in self.tiles:
            outside = (
                max(k * self.tile - value, 0.0, value - (k + 1) * self.tile)
                for k, value in ((entry.column, x), (entry.row, y))
            )
            distances[entry.column, entry.row] = math.hypot(*outside)
        near = {key for key, distance in distances.items() if distance <= around.radius}
        if not near:
            nearest = f"the nearest is {min(distances.values()):.0f} m away" if distances else "it has none"
            raise MapError(f"around {around}: no tile of the site is there, {nearest}; check the coordinates")
        return near

    def _pieces(self, joint: str = ", ", line: str = "") -> Iterator[bytes]:
        """Yield all but the signature as JSON; ``joint`` joins tiles, ``line`` precedes each and follows the last."""
        plain = {item.name: getattr(self, item.name) for item in fields(self)}
        del plain["signer"], plain["signature"]
        head = json.dumps({"format": FORMAT} | plain | {"tiles": []}, sort_keys=True, allow_nan=False)
        head, tail = head.rsplit("]", 1)
        yield head.encode()
        for number, tile in enumerate(self.tiles):
            entry = vars(tile) | {"layers": {name: vars(layer) for name, layer in tile.layers.items()}}
            text = json.dumps(entry, sort_keys=True, allow_nan=False)
            yield f"{joint if number else ''}{line}{text}".encode()
        yield f"{line}]{tail}".encode()

    def signed(self, key: SigningKey) -> Manifest:
        """Return a signed copy."""
        signature = key.sign(_PURPOSE + b"".join(self._pieces())).hex()
        return replace(self, signer=key.fingerprint, signature=signature)

    def to_bytes(self) -> bytes:
        """Return the file's content, with a line for each tile."""
        head, *rest = self._pieces(",", "\n")
        if self.signature and (begin := _BEGIN.search(head)):
            own = f', "signature": "{self.signature}", "signer": "{self.signer}"'
            head = head[: begin.start(3)] + own.encode() + head[begin.start(3) :]
        return b"".join([head, *rest, b"\n"])

    @classmethod
    def from_bytes(cls, raw: bytes, name: str, key: VerifyKey | None = None) -> Manifest:
        """Read untrusted bytes of :meth:`to_bytes`, or of earlier versions, which were indented.

        Checks the signature first if there is a key. MapError if the signature is wrong or missing, if the bytes are
        not a manifest, or if their version is unknown.
        """
        try:
            if len(raw) > MAX_MANIFEST:
                raise ValueError(f"more than {MAX_MANIFEST >> 20} MB")
            content = _in_one_line(raw)
            begin = _BEGIN.search(content, 0, _MAX_HEAD)
            if begin is None:
                _refuse_other(content, name)
            signature, signer = (part or b"" for part in begin.group(1, 2))
            content = content[: begin.start()] + content[begin.start(3) :]
            first = begin.end() - begin.start(3) + begin.start()  # of the tiles, without the signature
            if key is not None:
                _check_signature(content, signature, signer, key, name)
            tiles, end = _tiles_of(content, first)
            if len(content) - end > _MAX_TAIL:
                raise ValueError("more follows its tiles than the version")
            data = _loads(content[:first] + content[end:])
            if data["format"] != FORMAT or data["tiles"]:
                raise ValueError("it is of another kind")
            if data["version"] not in (1, VERSION):
                raise MapError(f"{name}: is of version {str(data['version'])[:20]}, this program reads {VERSION} and 1")
            origin = tuple(_number(value) for value in data["origin"])
            if len(origin) != 3:
                raise ValueError("origin is not a list of three numbers")
            tile, crs, parameters = _number(data["tile"]), data["crs"], data["parameters"]
            if not 1.0 <= tile <= 10_000.0 or not isinstance(crs, str | None) or not isinstance(parameters, dict):
                raise ValueError("tile, crs or parameters are invalid")
            _check_depth(parameters, _MAX_DEPTH)
            json.dumps([crs, parameters], ensure_ascii=False).encode()  # refuse lone surrogates: they cannot be printed
            grid = SiteGrid((0.0, 0.0, 0.0), tile, config_of_map(parameters["config"]))
            if len({(entry.column, entry.row) for entry in tiles}) != len(tiles):
                raise ValueError("a tile is named twice")
            most = most_points(tile, grid.config.voxel), most_points(tile, grid.config.block)
            if any(entry.points > most[0] or entry.stations > most[1] for entry in tiles):
                raise ValueError("a tile counts more than {} points or {} stations".format(*most))
            for entry in tiles:
                for kind, layer in entry.layers.items():
                    limit = most_bytes(kind, entry.points, entry.stations, tile, grid.config.voxel)
                    if layer.bytes > limit + limit // 8 + _MAX_OVERHEAD:
                        raise ValueError(f"a layer has {layer.bytes} bytes, and unpacks to {limit} at most")
                if entry.points > _MOST_PACKED * entry.layers["cloud"].bytes:
                    raise ValueError(f"a tile's {entry.points} points are in {entry.layers['cloud'].bytes} bytes")
            signed = signer.decode(), signature.decode()
            manifest = cls(origin, tile, crs, parameters, tuple(tiles), *signed, int(data["version"]))
            _ = manifest.sha256  # fails if it cannot be serialised
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
        """Write the manifest atomically into a site's directory; MapError if that fails."""
        write_manifest(directory, self.to_bytes(), name)

    @classmethod
    def load(cls, directory: Path, name: str = FILE, key: VerifyKey | None = None) -> Manifest:
        """Read the manifest of a site's directory; MapError as in :meth:`from_bytes`, or if it is missing."""
        return cls.from_bytes(read_manifest(directory, name), str(directory / name), key)


def read_manifest(directory: Path, name: str = FILE) -> bytes:
    """Return the bytes of the manifest of a site's directory; MapError if it is missing."""
    try:
        with open_plain(directory / name) as file:
            return file.read(MAX_MANIFEST + 1)
    except OSError as error:
        raise MapError(
            f"{directory}: is not a site, {name} cannot be read ({error.strerror}); give a .coview file, or a "
            "directory that 'build -o DIRECTORY/' made"
        ) from error


def write_manifest(directory: Path, raw: bytes, name: str = FILE) -> None:
    """Write the bytes of a manifest atomically into a site's directory; MapError if that fails."""
    try:
        with atomic_file(directory / name, sync=True) as file:
            file.write(raw)
    except OSError as error:
        raise MapError(f"{directory / name}: cannot be written ({error.strerror})") from error


def _loads(text: bytes) -> Any:
    return json.loads(text, parse_float=_finite, parse_constant=_finite)


def _in_one_line(raw: bytes) -> bytes:
    """Join JSON of several lines to the one line of json.dumps; JSON strings hold no line ends."""
    lines = (line.strip(b" \r\n") for line in io.BytesIO(raw))
    return b"".join(line + b" " if line.endswith(b",") else line for line in lines)


def _refuse_other(content: bytes, name: str) -> NoReturn:
    """Raise the MapError for bytes that list no tiles."""
    if f'"format": "{FORMAT}"'.encode() in content[:_MAX_HEAD]:
        raise ValueError("it lists no tiles as 'build' writes them")
    raise MapError(f"{name}: is not a manifest of a site; name the directory that 'build -o DIRECTORY/' made")


def _check_signature(content: bytes, signature: bytes, signer: bytes, key: VerifyKey, name: str) -> None:
    if not signature:
        raise MapError(
            f"{name}: the site is not signed, and a signature by {key.name} is asked for; build it with --sign and "
            f"the key that {key.name} belongs to"
        )
    if len(signature) % 2 or not key.verifies(_PURPOSE + content, bytes.fromhex(signature.decode())):
        raise MapError(
            f"{name}: is not signed with {key.name} ({key.fingerprint}) but by {signer[:32].decode()}, or was changed "
            "since; give the public key of who built it, or a site of theirs"
        )


def _tiles_of(content: bytes, at: int) -> tuple[list[TileEntry], int]:
    """Return the tiles listed from byte ``at`` on, and the end of their list; ValueError if they are invalid."""
    decoder, tiles = json.JSONDecoder(parse_float=_finite, parse_constant=_finite), []
    more = content[at : at + 1] != b"]"
    while more:
        entry, length = decoder.raw_decode(content[at : at + _MAX_ENTRY].decode("ascii"))
        tiles.append(TileEntry.of(entry))
        at += length
        more = content[at : at + 2] == b", "
        at += 2 * more
    if content[at : at + 1] != b"]":
        raise ValueError(f"its list of tiles breaks off after {len(tiles)}")
    return tiles, at


def is_site(path: Path) -> bool:
    """Return whether a path is a directory with a manifest."""
    return (path / FILE).is_file()


def in_order(tiles: Iterable[TileEntry]) -> tuple[TileEntry, ...]:
    """Return tiles sorted by row and column."""
    return tuple(sorted(tiles, key=lambda tile: (tile.row, tile.column)))


def _whole(value: Any, limit: int, signed: bool = False) -> int:
    if type(value) is not int or not (-limit if signed else 0) <= value <= limit:
        raise ValueError(f"{str(value)[:40]} is not a whole number up to {limit}")
    return value


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:40]} is not a finite number")
    return value


def _check_depth(value: object, left: int) -> None:
    if not left:
        raise ValueError("its parameters are nested too deeply")
    for item in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _check_depth(item, left - 1)


def _number(value: Any) -> float:
    if type(value) not in (int, float) or not math.isfinite(value) or abs(value) > _MAX_METRES:
        raise ValueError(f"{str(value)[:40]} is not a length")
    return float(value)
