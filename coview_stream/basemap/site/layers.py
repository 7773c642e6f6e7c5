"""Layers of a tile: their arrays and their encoding.

A layer is ``COVIEWL1``, the header's length (4 bytes, little-endian), a JSON header, and the arrays in its order, each
compressed by bzip2 or, where the header names no packing, by LZMA of byte planes. bzip2 compresses clouds as well as
LZMA in a seventh of the time, but features end up a tenth larger. Readers bound all sizes before they allocate.

The layer ``cloud`` has points sorted by voxel (row, column, height), 2.5 bytes each. It stores the number of points in
each column, the height steps between them, positions in the voxel in steps of ``voxel / STEPS`` (2 cm for 0.25 m), the
planarity, and upward normals by the octahedral map (Meyer et al., 2010) in 64 x 64 cells, within 2.3 degrees.

The layer ``stations`` has the blocks with stations, and the heights to the centimetre.
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
from coview_stream.geometry.arrays import Floats, Floats32, Int8s
from coview_stream.geometry.transforms import Points

LayerArrays = Mapping[str, npt.NDArray[Any]]
Packing = Literal["bz2", "lzma"]

_MAGIC = b"COVIEWL1"
_TYPES = {"u1": "|u1", "i1": "|i1", "u2": "<u2", "i2": "<i2", "i4": "<i4", "f4": "<f4"}
_MAX_HEADER = 1 << 16  # bytes
_MAX_ARRAYS = 32
_MAX_BYTES = 1 << 29  # of a layer in memory: ten times the densest tile
# no contexts: neighbouring bytes of these small numbers hardly predict each other
_FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": 6, "lc": 0, "lp": 0, "pb": 0, "dict_size": 1 << 22}]
PACKING: Mapping[str, Packing] = {"cloud": "bz2", "stations": "bz2", "features": "lzma"}
STEPS = 12  # per voxel edge
_CELLS = 64  # along each edge of the octahedral map
_PLANARITY = 15  # steps
_MAX_LEVEL = 30_000  # voxels above or below zero
_MAX_COLUMNS = 1 << 24
_PER_COLUMN = 16  # greatest mean number of points in a column of voxels: a wall of 4 m in every column
_POINT, _STATION = 10, 12  # bytes of each in the arrays of a layer
_ROWS = 1 << 18  # points unpacked at a time
Layer = dict[str, npt.NDArray[Any]]
_MAX_BLOCK = 1 << 26  # blocks from the origin: 100,000 km


def encode(arrays: LayerArrays, packing: Packing = "bz2") -> bytes:
    """Encode arrays of small integers or float32; the same arrays give the same bytes."""
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
            # byte planes: the high bytes of small numbers are alike
            planes = array.reshape(-1, 1).view(np.uint8).reshape(array.size, array.itemsize).T.tobytes()
            part = lzma.compress(planes, format=lzma.FORMAT_RAW, filters=_FILTERS)
        entries.append(entry | {"bytes": len(part)})
        parts.append(part)
    header = json.dumps(entries, separators=(",", ":")).encode()
    return b"".join([_MAGIC, len(header).to_bytes(4, "little"), header, *parts])


def most_points(tile: float, cell: float) -> int:
    """Return the greatest plausible number of points (``cell``: the voxel) or stations (the block) of a tile."""
    return _PER_COLUMN * columns_of(tile, cell) ** 2


def most_bytes(layer: str, points: int, stations: int, tile: float, voxel: float) -> int:
    """Return the largest unpacked size of a tile's layer, bytes."""
    of = {"cloud": 2 * columns_of(tile, voxel) ** 2 + _POINT * points, "stations": _STATION * stations}
    return of.get(layer, _MAX_BYTES)


def decode(raw: bytes, name: str, most: int = _MAX_BYTES) -> dict[str, npt.NDArray[Any]]:
    """Decode untrusted bytes of :func:`encode` to arrays by name.

    MapError, with the layer's ``name``, if they are invalid or unpack to more than ``most`` bytes.
    """
    try:
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
            if total > min(most, _MAX_BYTES) or at + length > len(raw):
                raise ValueError("it is too large or cut off")
            content = _unpacked(raw[at : at + length], entry.get("packing", "lzma"), wanted, dtype.itemsize)
            arrays[str(entry["name"])] = content.view(dtype).reshape(shape)
            at += length
        if at != len(raw):
            raise ValueError("something follows its end")
        return arrays
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError, OSError, EOFError, lzma.LZMAError) as error:
        raise MapError(f"{name}: is not a layer of a tile ({error}); fetch or build it again") from error


def _unpacked(part: bytes, packing: object, wanted: int, itemsize: int) -> npt.NDArray[np.uint8]:
    if packing not in ("bz2", "lzma"):
        raise ValueError("an array is compressed in a way that is not known")
    decoder: bz2.BZ2Decompressor | lzma.LZMADecompressor = bz2.BZ2Decompressor()
    if packing == "lzma":
        decoder = lzma.LZMADecompressor(format=lzma.FORMAT_RAW, filters=_FILTERS)
    content = np.frombuffer(decoder.decompress(part, max_length=wanted + 1), dtype=np.uint8)
    if len(content) != wanted:
        raise ValueError(f"an array has {len(content)} bytes or more, not {wanted}")
    return content if packing == "bz2" else np.ascontiguousarray(content.reshape(itemsize, -1).T).reshape(-1)


def cloud_layer(points: Points, normals: Points, planarity: Floats32, tile: float, voxel: float) -> Layer:
    """Return the arrays of a tile's cloud; ``tile`` and ``voxel`` are edges in metres.

    Points (N, 3) are float32 metres from the tile's lower corner, in [0, tile) in x and y; unit normals (N, 3) do not
    point down; planarity (N,) is in [0, 1].
    """
    across = columns_of(tile, voxel)
    cell = np.floor(points.astype(np.float64) / voxel).astype(np.int64)
    np.clip(cell[:, :2], 0, across - 1, out=cell[:, :2])
    np.clip(cell[:, 2], -_MAX_LEVEL, _MAX_LEVEL, out=cell[:, 2])
    order = np.lexsort((cell[:, 2], cell[:, 0], cell[:, 1]))
    cell = cell[order]
    inside = points[order].astype(np.float64) / voxel - cell
    counts = np.bincount(cell[:, 1] * across + cell[:, 0], minlength=across * across)
    # the upper half of the octahedron maps to a square turned by 45 degrees
    normals = normals[order]
    length = np.abs(normals).sum(axis=1, dtype=np.float64)
    x, y = (normals[:, :2] / np.maximum(length, 1e-9)[:, None]).T
    square = np.clip((np.stack([x + y, x - y], axis=1) + 1.0) * 0.5, 0.0, 1.0)
    return {
        "counts": counts.astype(np.uint16).reshape(across, across),
        "levels": np.diff(cell[:, 2], prepend=0).astype(np.int32),
        "inside": np.ascontiguousarray(np.clip(np.floor(inside * STEPS), 0, STEPS - 1).astype(np.uint8).T),
        "normals": np.rint(square * (_CELLS - 1)).astype(np.uint8),
        "planarity": np.rint(planarity[order] * _PLANARITY).astype(np.uint8),
    }


def read_cloud_layer(layer: Layer, corner: Floats, tile: float, voxel: float) -> tuple[Points, Int8s]:
    """Return a tile's points (N, 3) float32, and int8 normals (N, 3) scaled by the planarity.

    ``corner`` (3,) is the tile's lower corner in the map's frame, metres. MapError if the untrusted arrays are
    inconsistent.
    """
    across = columns_of(tile, voxel)
    try:
        counts, levels, inside = layer["counts"], layer["levels"], layer["inside"]
        normals, planarity = layer["normals"], layer["planarity"]
    except KeyError as error:
        raise MapError(f"a tile's cloud lacks {error}; fetch or build it again") from error
    kinds = [array.dtype.str for array in (counts, levels, inside, normals, planarity)]
    number = len(levels)
    shapes = inside.shape == (3, number) and normals.shape == (number, 2) and planarity.shape == (number,)
    if kinds != ["<u2", "<i4", "|u1", "|u1", "|u1"] or counts.shape != (across, across) or not shapes:
        raise MapError("a tile's cloud has other arrays than it should; fetch or build it again")
    level = np.cumsum(levels, dtype=np.int64)
    if int(counts.sum(dtype=np.int64)) != number or (number and np.abs(level).max() > _MAX_LEVEL):
        raise MapError("a tile's cloud does not fit together; fetch or build it again")
    columns = np.repeat(np.arange(across * across, dtype=np.int32), counts.reshape(-1))
    points, packed = np.empty((number, 3), np.float32), np.empty((number, 3), np.int8)
    for start in range(0, number, _ROWS):
        part = slice(start, start + _ROWS)
        column = columns[part]
        cell = np.stack([column % across, column // across, level[part]])
        places = (cell + (inside[:, part].astype(np.float64) + 0.5) / STEPS) * voxel
        points[part] = places.T + np.asarray(corner, dtype=np.float64)
        a, b = normals[part].astype(np.float64).T / (_CELLS - 1) * 2.0 - 1.0
        x, y = (a + b) * 0.5, (a - b) * 0.5
        unit = np.stack([x, y, 1.0 - np.abs(x) - np.abs(y)], axis=1)
        unit /= np.maximum(np.linalg.norm(unit, axis=1), 1e-9)[:, None]
        length = np.maximum(planarity[part].astype(np.float32) * np.float32(127.0 / _PLANARITY), np.float32(8.0))
        packed[part] = np.rint(unit.astype(np.float32) * length[:, None])
    return points, packed


def square_metres(points: Points) -> int:
    """Return the number of one-metre squares that hold points (N, 3)."""
    column, row = np.floor(points[:, :2]).astype(np.int64).T
    return len(np.unique(column * (1 << 32) + row))


def columns_of(tile: float, voxel: float) -> int:
    """Return the number of voxels along a tile's edge; MapError if there are none or too many."""
    across = int(np.ceil(tile / voxel - 1e-6)) if voxel > 0 else 0
    if not 0 < across * across <= _MAX_COLUMNS:
        raise MapError(f"tiles of {tile:g} m in voxels of {voxel:g} m: choose smaller tiles or larger voxels")
    return across


def stations_layer(stations: Floats32, block: float) -> Layer:
    """Return the arrays of stations (M, 3) at the centres of blocks, metres in the site's frame."""
    cells = np.floor(stations[:, :2].astype(np.float64) / block).astype(np.int64)
    order = np.lexsort((stations[:, 2], cells[:, 0], cells[:, 1]))
    height = np.rint(stations[order, 2].astype(np.float64) * 100.0).astype(np.int64)
    rows = np.column_stack([cells[order], height])
    return {"steps": np.ascontiguousarray(np.diff(rows, axis=0, prepend=np.zeros((1, 3), dtype=np.int64)).T, "<i4")}


def read_stations_layer(layer: Layer, block: float) -> Floats32:
    """Return the stations (M, 3), by rows and columns and from low to high; MapError if the arrays are invalid."""
    steps = layer.get("steps")
    if steps is None or steps.dtype.str != "<i4" or steps.ndim != 2 or len(steps) != 3:
        raise MapError("a tile's stations are damaged; fetch or build it again")
    rows = np.cumsum(steps.astype(np.int64), axis=1)
    if rows.size and np.abs(rows).max() > _MAX_BLOCK:
        raise MapError("a tile's stations lie beyond any site; fetch or build it again")
    xy, height = (rows[:2] + 0.5) * block, rows[2] / 100.0
    return np.column_stack([*xy, height]).astype(np.float32)
