"""The ``.coview`` file: safetensors, memory-mapped, versioned, checksummed, written atomically.

safetensors is a length, a JSON header and raw little-endian arrays: nothing in it is executed on loading. The header's
metadata hold the format version, all parameters, and the sha256 of parameters and arrays.
"""

from __future__ import annotations

import hashlib
import json
import math
import mmap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.errors import MapError

FORMAT = "coview-map"
VERSION = 1

Arrays = dict[str, npt.NDArray[Any]]

_DAMAGE = (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError, MemoryError, OSError)
_MAX_ARRAYS = 256  # set by hand: ten times what a map has
_CHUNK = 1 << 22  # bytes written or hashed at a time
_CACHE_LINE = 64  # bytes
_TYPES = {
    "F64": "<f8", "F32": "<f4", "F16": "<f2", "I64": "<i8", "I32": "<i4", "I16": "<i2", "I8": "|i1", "U8": "|u1",
}  # fmt: skip
_NAMES = {kind: name for name, kind in _TYPES.items()}


def save(path: Path, arrays: Arrays, parameters: dict[str, Any]) -> str:
    """Write a map and return its sha256; an existing file stays whole until the new one is complete.

    Raises:
        MapError: the directory does not exist or cannot be written, or the path holds something else than a map.
    """
    check_target(path)
    text = json.dumps(parameters, sort_keys=True)
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    digest = _digest(text, contiguous, lambda name: _chunks(contiguous[name]))
    metadata = {"format": FORMAT, "version": str(VERSION), "parameters": text, "sha256": digest}
    try:
        with atomic_file(path, sync=True) as file:
            _write(file, contiguous, metadata)
    except OSError as error:
        raise MapError(f"{path}: cannot write the map ({error.strerror}); choose a writable place") from error
    return digest


def check_target(path: Path) -> None:
    """Refuse to replace anything but a map.

    Raises:
        MapError: the path is a directory, a device, another kind of file, or in a directory that does not exist.
    """
    if path.is_dir() or not path.resolve().parent.is_dir():
        raise MapError(f"{path}: not a place for a file; give a name in a directory that exists")
    if not path.exists():
        return
    if not path.is_file():
        raise MapError(f"{path}: not a regular file; give another name")
    if path.stat().st_size:
        try:
            header, _ = _header(path)
        except MapError:
            header = {}
        if header.get("__metadata__", {}).get("format") != FORMAT:
            raise MapError(f"{path}: exists and is no coview map; delete it or give another name")


def _write(file: BinaryIO, arrays: Arrays, metadata: dict[str, str]) -> None:
    """Write the safetensors layout array by array: the library's own writer holds a second copy of everything."""
    header: dict[str, Any] = {"__metadata__": metadata}
    # those that fill cache lines first, so that each of them begins with one; then the wide types, so that every array
    # begins at a multiple of its item size
    names = sorted(arrays, key=lambda name: (arrays[name].nbytes % _CACHE_LINE > 0, -arrays[name].dtype.itemsize, name))
    end = 0
    for name in names:
        array = arrays[name]
        begin, end = end, end + array.nbytes
        header[name] = {"dtype": _NAMES[array.dtype.str], "shape": list(array.shape), "data_offsets": [begin, end]}
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-(8 + len(text)) % _CACHE_LINE)
    file.write(len(text).to_bytes(8, "little") + text)
    for name in names:
        for chunk in _chunks(arrays[name]):
            file.write(chunk)


def load(path: Path, check: bool = True) -> tuple[Arrays, dict[str, Any], str]:
    """Memory-map a map: its arrays (read-only), parameters and sha256.

    The whole file is read once, to compare it with its checksum, if ``check``; after that only the pages used are in
    memory.

    Raises:
        MapError: missing, not a base map, of another version, truncated, or damaged.
    """
    header, start = _header(path)
    metadata = header.pop("__metadata__", {})
    if metadata.get("format") != FORMAT:
        raise MapError(f"{path}: not a coview map; build one with 'coview-stream build'")
    if metadata.get("version") != str(VERSION):
        raise MapError(
            f"{path}: map format {metadata.get('version')}, this program reads {VERSION}; build the map again"
        )
    try:
        if len(header) > _MAX_ARRAYS:
            raise ValueError(f"{len(header)} arrays, a map has {_MAX_ARRAYS} at most")
        arrays = {name: _mapped(path, start, entry) for name, entry in sorted(header.items())}
        if start + sum(array.nbytes for array in arrays.values()) > path.stat().st_size:
            raise ValueError("its arrays overlap")  # or reading them takes any time
        digest = str(metadata.get("sha256"))
        if check:
            with path.open("rb") as file:
                digest = _digest(metadata["parameters"], arrays, lambda name: _read(file, start, header[name]))
        parameters = json.loads(metadata["parameters"])
        if not isinstance(parameters, dict):
            raise TypeError("its parameters are no object")
    except _DAMAGE as error:
        raise MapError(f"{path}: the map is damaged or truncated ({error}); copy or build it again") from error
    if digest != metadata.get("sha256"):
        raise MapError(f"{path}: the map is damaged (checksum differs); copy or build it again")
    return arrays, parameters, digest


def _header(path: Path) -> tuple[dict[str, Any], int]:
    try:
        with path.open("rb") as file:
            size = int.from_bytes(file.read(8), "little")
            if not 2 <= size <= min(path.stat().st_size, 1 << 24):
                raise MapError(f"{path}: not a coview map; build one with 'coview-stream build'")
            text = file.read(size)
            header = json.loads(text)
    except OSError as error:
        raise MapError(f"{path}: cannot read the map ({error.strerror}); check the path") from error
    except (ValueError, RecursionError) as error:
        raise MapError(f"{path}: not a coview map, or its header is damaged; build it again") from error
    # only blanks may pad it: JSON would also accept a blank damaged into a line end
    padded = text.rstrip(b" ").endswith(b"}")
    if not (padded and isinstance(header, dict) and isinstance(header.get("__metadata__", {}), dict)):
        raise MapError(f"{path}: not a coview map, or its header is damaged; build it again")
    return header, 8 + size


def _mapped(path: Path, start: int, entry: dict[str, Any]) -> npt.NDArray[Any]:
    dtype = np.dtype(_TYPES[entry["dtype"]])
    shape = tuple(entry["shape"])
    begin, end = entry["data_offsets"]
    if not all(type(n) is int and n >= 0 for n in (*shape, begin, end)):
        raise ValueError("a shape or an offset is no natural number")
    if end - begin != dtype.itemsize * math.prod(shape) or start + end > path.stat().st_size:
        raise ValueError("an array reaches beyond the file")
    if end == begin:
        return np.empty(shape, dtype=dtype)
    return np.memmap(path, dtype=dtype, mode="r", offset=start + begin, shape=shape)


def _read(file: BinaryIO, start: int, entry: dict[str, Any]) -> Iterator[bytes]:
    """Read an array's bytes in chunks: pages of a memory map would count as this process's memory."""
    begin, end = entry["data_offsets"]
    file.seek(start + begin)
    while begin < end:
        chunk = file.read(min(_CHUNK, end - begin))
        if not chunk:
            raise ValueError("an array reaches beyond the file")
        yield chunk
        begin += len(chunk)


def _chunks(array: npt.NDArray[Any]) -> Iterator[memoryview]:
    """Cut an array's bytes into chunks."""
    data = array.reshape(-1).view(np.uint8)
    for begin in range(0, len(data), _CHUNK):
        yield data[begin : begin + _CHUNK].data


def release(array: npt.NDArray[Any]) -> None:
    """Let the memory of a memory-mapped array go; it is read from the file again when it is touched."""
    mapped = getattr(array, "_mmap", None)
    if mapped is not None and hasattr(mmap, "MADV_DONTNEED"):
        mapped.madvise(mmap.MADV_DONTNEED)


def _digest(parameters: str, arrays: Arrays, content: Callable[[str], Iterator[bytes | memoryview]]) -> str:
    """Hash parameters, and names, types, shapes and content of the arrays."""
    total = hashlib.sha256(parameters.encode())
    for name in sorted(arrays):
        total.update(f"{name} {arrays[name].dtype.str} {arrays[name].shape}".encode())
        for chunk in content(name):
            total.update(chunk)
    return total.hexdigest()
