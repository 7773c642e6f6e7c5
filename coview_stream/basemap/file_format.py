"""The ``.coview`` file: safetensors, memory-mapped, versioned, checksummed, written atomically.

A safetensors file is a length, a JSON header and raw little-endian arrays; loading executes nothing. The header's
metadata hold the format version, all parameters, and the sha256 of parameters and arrays. In a signed file they also
hold the sha256 of each array and an ed25519 signature of the rest of the header, so that every byte is covered.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from coview_kernels.crop import MAX_POINTS
from coview_kernels.mapped import release
from coview_kernels.reference.field import CELL as FIELD_CELL
from coview_kernels.reference.field import TILE as FIELD_TILE
from coview_stream.basemap.signature import (
    FileIdentity,
    SigningKey,
    Trust,
    check_sections,
    check_signature,
    file_identity,
    open_plain,
    serialized,
    sha256_of,
    sign_header,
)
from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.config import MapConfig
from coview_stream.errors import MapError

FORMAT = "coview-map"
VERSION = 1

Arrays = dict[str, npt.NDArray[Any]]

_DAMAGE = (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError, MemoryError, OSError)
_MAX_ARRAYS = 256  # ten times as many as a map has
_CHUNK = 1 << 22  # bytes written or hashed at a time
_CACHE_LINE = 64  # bytes
_TYPES = {
    "F64": "<f8", "F32": "<f4", "F16": "<f2", "I64": "<i8", "I32": "<i4", "I16": "<i2", "I8": "|i1", "U16": "<u2",
    "U8": "|u1",
}  # fmt: skip
_NAMES = {kind: name for name, kind in _TYPES.items()}
_TIERS = ("", ".rest")  # suffixes of the two tiers of station codes
_Shape = tuple[str | int, ...]
_EXPECTED: dict[str, tuple[str, _Shape]] = {
    "origin": ("<f8", (3,)),
    "stations": ("<f4", ("stations", 3)),
    "points": ("<f4", ("points", 3)),
    "normals": ("|i1", ("points", 3)),
    "tile_index": ("<i8", ("tiles", 4)),
    "surveyed": ("|u1", ("rows", "columns")),
    "surveyed_corner": ("<f8", (2,)),
    **{f"station_codes{tier}": ("<i2", ("stations", 16, 16)) for tier in _TIERS},
    **{f"station_codes{tier}.step": ("<f4", (16, 2, 16)) for tier in _TIERS},
    **{f"station_codes{tier}.norm": ("<f4", (33,)) for tier in _TIERS},
    "field.tiles": ("<i4", ("field tiles", 3)),
    "field.occupied": ("<i8", ("field tiles", FIELD_TILE, FIELD_TILE)),
    "field.ground": ("<i2", ("field tiles", FIELD_TILE, FIELD_TILE)),
    "field.edge": ("|u1", ("field tiles", FIELD_TILE, FIELD_TILE)),
    "learned.local": ("|i1", ("learned tiles", "learned rows", "learned columns", "features")),
    "learned.sigma": ("|u1", ("learned tiles", "learned rows", "learned columns")),
    "learned.tiles": ("<i4", ("learned tiles", 2)),
    "learned.place": ("|i1", ("places", "numbers")),
    "learned.place_at": ("<f4", ("places", 2)),
}
"""Type and shape of each array; dimensions with the same name have the same length."""
_MAX_METRES = 1e7  # coordinate of a corner, a station or a point: no map of the Earth is larger
MAX_AREA = 5.4e8  # square metres of a map's bounding rectangle: kernels count its cells in int32
_FEATURES_TILE = 32.0  # metres
_BESIDE = 1300.0  # metres by which the field may exceed the surveyed cells: the largest tile of a site
_ROWS = 1 << 18  # points checked at a time


class Loaded(NamedTuple):
    """Content of a map file.

    Attributes:
        arrays: memory-mapped, read-only.
        parameters: settings and facts of the build.
        sha256: hash of arrays and parameters.
        identity: state of the file.
    """

    arrays: Arrays
    parameters: dict[str, Any]
    sha256: str
    identity: FileIdentity


def save(path: Path, arrays: Arrays, parameters: dict[str, Any], key: SigningKey | None = None) -> str:
    """Write a map, signed if there is a key, and return its sha256; an earlier file stays until the new is complete.

    Raises the MapError of :func:`check_target`, or one if the directory cannot be written.
    """
    check_target(path)
    text = json.dumps(parameters, sort_keys=True)
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    digest = _digest(text, contiguous, lambda name: _chunks(contiguous[name]))
    metadata = {"format": FORMAT, "version": str(VERSION), "parameters": text, "sha256": digest}
    header: dict[str, Any] = {"__metadata__": metadata}
    # arrays of whole cache lines first, so that each begins on a line; the rest by item size, for their alignment
    names = sorted(
        contiguous, key=lambda name: (contiguous[name].nbytes % _CACHE_LINE > 0, -contiguous[name].dtype.itemsize, name)
    )
    end = 0
    for name in names:
        array = contiguous[name]
        begin, end = end, end + array.nbytes
        header[name] = {"dtype": _NAMES[array.dtype.str], "shape": list(array.shape), "data_offsets": [begin, end]}
    if key is not None:
        sign_header(header, {name: sha256_of(_chunks(contiguous[name])) for name in sorted(names)}, key)
    try:
        # array by array: the safetensors library would hold a second copy of everything
        with atomic_file(path, sync=True) as file:
            file.write(_header_bytes(header))
            for name in names:
                for chunk in _chunks(contiguous[name]):
                    file.write(chunk)
    except OSError as error:
        raise MapError(f"{path}: cannot write the map ({error.strerror}); choose a writable place with room") from error
    return digest


def check_target(path: Path) -> None:
    """Refuse to replace anything but a map.

    Raises:
        MapError: the path is a directory, a device or a file that is not a map, or its directory does not exist.
    """
    if path.is_dir() or not path.resolve().parent.is_dir():
        raise MapError(f"{path}: not a place for a file; give a name in a directory that exists")
    if not path.exists():
        return
    if not path.is_file():
        raise MapError(f"{path}: not a regular file; give another name")
    if path.stat().st_size:
        try:
            with path.open("rb") as file:
                header, _ = _header(path, file)
        except (MapError, OSError):
            header = {}
        if header.get("__metadata__", {}).get("format") != FORMAT:
            raise MapError(f"{path}: exists and is not a coview map; delete it or give another name")


def _header_bytes(header: dict[str, Any]) -> bytes:
    """Serialise a header with its length in front, padded to whole cache lines."""
    text = serialized(header)
    text += b" " * (-(8 + len(text)) % _CACHE_LINE)
    return len(text).to_bytes(8, "little") + text


def _is_exact(file: BinaryIO, header: dict[str, Any], start: int) -> bool:
    """Return whether a file begins with exactly the bytes that :func:`save` writes for this header."""
    try:
        file.seek(0)
        return file.read(start) == _header_bytes(header)
    except (RecursionError, OSError):
        return False


def load(path: Path, check: bool = True) -> tuple[Arrays, dict[str, Any], str]:
    """Memory-map a map with :func:`open_file`, and return arrays, parameters and sha256."""
    return open_file(path, check)[:3]


def open_file(
    path: Path,
    check: bool = True,
    trust: Trust | None = None,
    checked: FileIdentity | None = None,
    opened: Callable[[BinaryIO], object] | None = None,
) -> Loaded:
    """Memory-map a map, signed or not.

    Everything is read from the file that was opened, even if another file takes its name.

    Args:
        path: the file.
        check: read the whole file once to compare it with its checksum; afterwards only used pages stay in memory. A
            file that must be signed is always compared with its signed hashes, unless ``trust`` says it has been.
        trust: requires a signature.
        checked: identity of a file that has been compared with its checksum already; the same file is not read again.
        opened: called with the open file before it is read.

    Raises:
        MapError: missing, not a base map, of another version, truncated, damaged, changed meanwhile, or not signed
            with the key. DependencyError: there is a key, and no ``cryptography``.
    """
    with _opened(path) as file:
        if opened is not None:
            opened(file)
        identity = file_identity(file)
        header, start = _header(path, file)
        metadata = header.get("__metadata__", {})
        if metadata.get("format") != FORMAT:
            raise MapError(f"{path}: not a coview map; build one with 'coview-stream build'")
        if metadata.get("version") != str(VERSION):
            raise MapError(
                f"{path}: map format {metadata.get('version')}, this program reads {VERSION}; build the map again"
            )
        if trust is not None:
            check_signature(path, header, _is_exact(file, header, start), trust.key)
        try:
            names = sorted(header.keys() - {"__metadata__"})
            if len(names) > _MAX_ARRAYS:
                raise ValueError(f"{len(names)} arrays, a map has {_MAX_ARRAYS} at most")
            arrays = {name: _mapped(file, identity.size, start, header[name]) for name in names}
            used = start + sum(array.nbytes for array in arrays.values())
            if used > identity.size:
                raise ValueError("its arrays overlap")  # overlapping arrays could take forever to read
            if trust is not None and used < identity.size:
                raise ValueError("it holds bytes that belong to no array and are not signed")
            digest = str(metadata.get("sha256"))
            if trust is not None and trust.verified != identity:
                check_sections(header, lambda name: _read(file, start, header[name]))
            elif trust is None and check and checked != identity:
                digest = _digest(metadata["parameters"], arrays, lambda name: _read(file, start, header[name]))
            parameters = json.loads(metadata["parameters"])
            if not isinstance(parameters, dict):
                raise TypeError("its parameters are not an object")
        except _DAMAGE as error:
            raise MapError(f"{path}: the map is damaged or truncated ({error}); copy or build it again") from error
        if digest != metadata.get("sha256"):
            raise MapError(f"{path}: the map is damaged (checksum differs); copy or build it again")
        if trust is not None and file_identity(file) != identity:
            raise MapError(f"{path}: the map was written to while it was verified; open it again when that is done")
    return Loaded(arrays, parameters, digest, identity)


def signer(path: Path) -> str | None:
    """Return the unverified fingerprint of a map's signing key, None if unsigned; MapError if the file is not a map."""
    with _opened(path) as file:
        metadata = _header(path, file)[0].get("__metadata__", {})
    return str(metadata.get("signer")) if "signature" in metadata else None


def _opened(path: Path) -> BinaryIO:
    try:
        return open_plain(path)
    except OSError as error:
        raise MapError(f"{path}: cannot read the map ({error.strerror}); check the path") from error


def _header(path: Path, file: BinaryIO) -> tuple[dict[str, Any], int]:
    try:
        size = int.from_bytes(file.read(8), "little")
        if not 2 <= size <= min(os.fstat(file.fileno()).st_size, 1 << 24):
            raise MapError(f"{path}: not a coview map; build one with 'coview-stream build'")
        text = file.read(size)
        header = json.loads(text)
    except OSError as error:
        raise MapError(f"{path}: cannot read the map ({error.strerror}); check the path") from error
    except (ValueError, RecursionError) as error:
        if isinstance(error, MapError):
            raise
        raise MapError(f"{path}: not a coview map, or its header is damaged; build it again") from error
    # only blanks may pad the header: JSON would also accept a line end, which is a damaged blank
    padded = text.rstrip(b" ").endswith(b"}")
    if not (padded and isinstance(header, dict) and isinstance(header.get("__metadata__", {}), dict)):
        raise MapError(f"{path}: not a coview map, or its header is damaged; build it again")
    return header, 8 + size


def _mapped(file: BinaryIO, size: int, start: int, entry: dict[str, Any]) -> npt.NDArray[Any]:
    dtype = np.dtype(_TYPES[entry["dtype"]])
    shape = tuple(entry["shape"])
    begin, end = entry["data_offsets"]
    if not all(type(n) is int and n >= 0 for n in (*shape, begin, end)):
        raise ValueError("a shape or an offset is not a natural number")
    if end - begin != dtype.itemsize * math.prod(shape) or start + end > size:
        raise ValueError("an array reaches beyond the file")
    if end == begin:
        return np.empty(shape, dtype=dtype)
    return np.memmap(file, dtype=dtype, mode="r", offset=start + begin, shape=shape)


def _read(file: BinaryIO, start: int, entry: dict[str, Any]) -> Iterator[bytes]:
    """Yield an array's bytes in chunks, by reads: pages of a memory map would count as this process's memory."""
    begin, end = entry["data_offsets"]
    file.seek(start + begin)
    while begin < end:
        chunk = file.read(min(_CHUNK, end - begin))
        if not chunk:
            raise ValueError("an array reaches beyond the file")
        yield chunk
        begin += len(chunk)


def _chunks(array: npt.NDArray[Any]) -> Iterator[memoryview]:
    """Yield an array's bytes in chunks, and release mapped pages as they are consumed."""
    data = array.reshape(-1).view(np.uint8)
    for begin in range(0, len(data), _CHUNK):
        yield data[begin : begin + _CHUNK].data
        release(array)


def release_arrays(arrays: Arrays) -> None:
    """Release the pages of arrays that are mapped from a file."""
    for array in arrays.values():
        release(array)


def _digest(parameters: str, arrays: Arrays, content: Callable[[str], Iterator[bytes | memoryview]]) -> str:
    """Hash parameters, and names, types, shapes and content of the arrays."""
    total = hashlib.sha256(parameters.encode())
    for name in sorted(arrays):
        total.update(f"{name} {arrays[name].dtype.str} {arrays[name].shape}".encode())
        for chunk in content(name):
            total.update(chunk)
    return total.hexdigest()


def check_arrays(arrays: Mapping[str, npt.NDArray[Any]], config: MapConfig, points: bool = True) -> None:
    """Check types and shapes of a map's arrays, and the values used as indices; MapError names the wrong array.

    Stations, field and, with ``points``, the points must lie on the raster of surveyed cells. That raster is in the
    file, so it bounds the size of all other rasters.
    """
    bins, channels = (config.descriptor.rings, config.descriptor.sectors), len(config.descriptor.channels)
    descriptor = ("<f2", ("stations", *bins))
    expected = _EXPECTED | {f"descriptor.{name}": descriptor for name in config.descriptor.channels}
    expected |= {
        f"station_codes{tier}.basis": ("<f4", (16, 16, config.descriptor.rings * channels, 2)) for tier in _TIERS
    }
    expected["station_codes.sample"] = ("<f2", (channels, "sample", *bins))
    known: dict[str, int] = {}
    for name, (kind, dimensions) in expected.items():
        array = arrays.get(name)
        if array is None:
            continue  # BaseMap checks for missing arrays
        if array.dtype != np.dtype(kind) or array.ndim != len(dimensions):
            raise _refused(
                name, f"is {array.dtype} {array.shape}, not {np.dtype(kind)} in {len(dimensions)} dimensions"
            )
        for actual, dimension in zip(array.shape, dimensions, strict=True):
            length = dimension if isinstance(dimension, int) else known.setdefault(dimension, actual)
            if actual != length:
                raise _refused(name, f"has the shape {array.shape}, with {actual} where {length} were expected")
    for name in ("stations", "points"):
        if not len(arrays[name]):
            raise _refused(name, "are none")
    if not np.isfinite(arrays["origin"]).all():
        raise _refused("origin", "is not finite")
    size = config.block * np.array(arrays["surveyed"].shape[::-1], dtype=np.float64)
    corner = arrays["surveyed_corner"]
    if not (np.abs(corner) < _MAX_METRES).all():  # false for NaN as well
        raise _refused("surveyed_corner", f"is not finite, or beyond {_MAX_METRES:g} m")
    if size.prod() > MAX_AREA:
        raise _refused("surveyed", f"covers {size.prod() / 1e6:.0f} km2, {MAX_AREA / 1e6:.0f} at most")
    low, high = corner - config.block, corner + size + config.block
    for name in ("stations", "points") if points else ("stations",):
        _check_places(name, arrays[name], low, high)
    # tiles of the field are (row, column), all others (x, y)
    for name, unit, xy in (
        ("field.tiles", FIELD_CELL * FIELD_TILE, [1, 0]),
        ("learned.tiles", _FEATURES_TILE, [0, 1]),
        ("learned.place_at", 1.0, [0, 1]),
    ):
        if (places := arrays.get(name)) is not None and len(places):
            first, last = (
                unit * np.asarray(each, dtype=np.float64)[xy] for each in (places.min(axis=0), places.max(axis=0))
            )
            if not ((first >= low - _BESIDE) & (last <= high + _BESIDE)).all():  # false for NaN as well
                raise _refused(name, "lies beside the surveyed cells")
    # tiles must not share points: no crop may be larger than the map
    stretches = arrays["tile_index"][:, 2:]
    begin, end = stretches[np.lexsort(stretches.T)].T if len(stretches) else stretches.T
    if len(arrays["points"]) > MAX_POINTS:
        raise _refused("points", f"has {len(arrays['points'])} rows, {MAX_POINTS} at most")
    if not ((begin >= 0) & (begin <= end) & (end <= len(arrays["points"]))).all():
        raise _refused("tile_index", "names points that are not there")
    if not (end[:-1] <= begin[1:]).all():
        raise _refused("tile_index", "names points twice")


def _check_places(name: str, places: npt.NDArray[Any], low: npt.NDArray[Any], high: npt.NDArray[Any]) -> None:
    for start in range(0, len(places), _ROWS):
        part = places[start : start + _ROWS]
        bottom, top = part.min(axis=0).astype(np.float64), part.max(axis=0).astype(np.float64)
        release(places)
        if not (np.abs([bottom, top]) < _MAX_METRES).all():  # min and max propagate NaN
            raise _refused(name, f"is not finite, or beyond {_MAX_METRES:g} m")
        if not ((bottom[:2] >= low) & (top[:2] <= high)).all():
            raise _refused(name, "lies beside the surveyed cells")


def _refused(name: str, flaw: str) -> MapError:
    return MapError(f"the map's {name} {flaw}; copy or build it again")
