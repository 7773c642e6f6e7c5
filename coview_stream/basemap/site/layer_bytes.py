"""Bytes of a tile's layer: named arrays, each compressed by itself, under a JSON header.

Layout: ``COVIEWL1``, the header's length (4 bytes, little endian), the header, the compressed arrays in its order. An
array's entry says how it is compressed: ``bz2``, or LZMA of its bytes by planes where it says nothing. bzip2 makes
clouds as small as LZMA does in a seventh of the time, which was a third of a tile's; features it makes a tenth larger.
The same arrays give the same bytes. Nothing is believed on reading: sizes are bounded before memory is taken.
"""

from __future__ import annotations

import bz2
import json
import lzma
import math
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from coview_stream.errors import MapError

Arrays = Mapping[str, npt.NDArray[Any]]
Packing = Literal["bz2", "lzma"]

_MAGIC = b"COVIEWL1"
_TYPES = {"u1": "|u1", "i1": "|i1", "u2": "<u2", "i2": "<i2", "i4": "<i4", "f4": "<f4"}
_MAX_HEADER = 1 << 16  # bytes
_MAX_ARRAYS = 32
MAX_BYTES = 1 << 29
"""Bytes that a layer may take in memory: ten times what the densest tile does; set by hand."""
_FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": 6, "lc": 0, "lp": 0, "pb": 0, "dict_size": 1 << 22}]
"""Bytes are predicted by nothing: rows of small numbers, whose neighbours in memory tell little of each other."""

PACKING: Mapping[str, Packing] = {"cloud": "bz2", "stations": "bz2", "features": "lzma"}
"""How the arrays of a tile's layers are compressed."""


def encode(arrays: Arrays, packing: Packing = "bz2") -> bytes:
    """Return the bytes of arrays of small integers or float32, whose names are sorted."""
    entries: list[dict[str, Any]] = []
    parts = []
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        kind = next(kind for kind, dtype in _TYPES.items() if np.dtype(dtype) == array.dtype)
        entry = {"name": name, "type": kind, "shape": list(array.shape)}
        if packing == "bz2":
            part = bz2.compress(array.tobytes())
            entry["packing"] = packing
        else:
            part = lzma.compress(_planes(array), format=lzma.FORMAT_RAW, filters=_FILTERS)
        entries.append(entry | {"bytes": len(part)})
        parts.append(part)
    header = json.dumps(entries, separators=(",", ":")).encode()
    return b"".join([_MAGIC, len(header).to_bytes(4, "little"), header, *parts])


def decode(raw: bytes, name: str) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays that :func:`encode` wrote, from anywhere.

    Args:
        raw: all of it.
        name: of the layer, for messages.

    Raises:
        MapError: it is something else, cut off, or larger than a layer can be.
    """
    try:
        return _decode(raw)
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError, OSError, EOFError, lzma.LZMAError) as error:
        raise MapError(f"{name}: is no layer of a tile ({error}); fetch or build it again") from error


def _decode(raw: bytes) -> dict[str, npt.NDArray[Any]]:
    size = int.from_bytes(raw[8:12], "little")
    if raw[:8] != _MAGIC or size > _MAX_HEADER or 12 + size > len(raw):
        raise ValueError("its header is not one")
    entries = json.loads(raw[12 : 12 + size])
    if not isinstance(entries, list) or len(entries) > _MAX_ARRAYS:
        raise ValueError("its header lists no arrays")
    at, total, arrays = 12 + size, 0, {}
    for entry in entries:
        dtype, shape, length = np.dtype(_TYPES[entry["type"]]), entry["shape"], entry["bytes"]
        if not all(type(n) is int and 0 <= n < 1 << 31 for n in [*shape, length]) or len(shape) > 4:
            raise ValueError("a shape is impossible")
        wanted = math.prod(shape) * dtype.itemsize
        total += wanted
        if total > MAX_BYTES or at + length > len(raw):
            raise ValueError("it is too large or cut off")
        if entry.get("packing", "lzma") not in ("bz2", "lzma"):
            raise ValueError("an array is compressed in a way that is not known")
        unpack = _from_bz2 if entry.get("packing") == "bz2" else _from_lzma
        arrays[str(entry["name"])] = unpack(raw[at : at + length], wanted, dtype).reshape(shape)
        at += length
    if at != len(raw):
        raise ValueError("something follows its end")
    return arrays


def _from_lzma(part: bytes, wanted: int, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    decoder = lzma.LZMADecompressor(format=lzma.FORMAT_RAW, filters=_FILTERS)
    planes = _whole(decoder.decompress(part, max_length=wanted + 1), wanted).reshape(dtype.itemsize, -1)
    return np.ascontiguousarray(planes.T).view(dtype)


def _from_bz2(part: bytes, wanted: int, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    found = bz2.BZ2Decompressor().decompress(part, max_length=wanted + 1)
    return _whole(found, wanted).view(dtype)


def _whole(found: bytes, wanted: int) -> npt.NDArray[np.uint8]:
    if len(found) != wanted:
        raise ValueError(f"an array has {len(found)} bytes or more, not {wanted}")
    return np.frombuffer(bytearray(found), dtype=np.uint8)


def _planes(array: npt.NDArray[Any]) -> bytes:
    """Return an array's bytes, the lowest ones of all numbers first: of small numbers the others are alike."""
    return array.reshape(-1, 1).view(np.uint8).reshape(array.size, array.itemsize).T.tobytes()
