"""Several maps joined into one, named by a small file, and loaded like one map."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coview_kernels.reference.field import CELL as FIELD_CELL
from coview_kernels.reference.field import TILE as FIELD_TILE
from coview_stream.basemap import file_format
from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.file_format import Arrays
from coview_stream.basemap.likelihood_field import FIELD_ARRAYS, layers_arrays
from coview_stream.basemap.map_parts import MapPart, MapParts
from coview_stream.basemap.signature import VerifyKey
from coview_stream.basemap.site.store import cache_folder, evict, read_record, remember_written, write_record
from coview_stream.basemap.site.working_file import open_made
from coview_stream.basemap.station_index import StationIndex
from coview_stream.descriptors.feature_map import TILE as FEATURE_TILE
from coview_stream.errors import MapError
from coview_stream.geometry.arrays import Floats, Ints

_CODE = 2
"""Counts changes of what is made of the same maps."""

_MIN_GAP = 300.0
"""Metres between two maps at least, set by hand: a lidar's range, and what a robot that leaves a map may drive on."""

_SHARED = ("block", "voxel", "tile", "descriptor")


def join_maps(maps: Mapping[str, BaseMap]) -> BaseMap:
    """Return one map of several.

    Args:
        maps: by name, in the order in which they are put from west to east.

    Raises:
        MapError: there are none, or they were built with different settings; both and the setting are named.
    """
    if not maps:
        raise MapError("no maps to join: name two or more")
    _check_alike(maps)
    config = next(iter(maps.values())).config
    step = _step(config.block, config.tile)
    gap = max(_MIN_GAP, 3.0 * config.descriptor.radius)
    parts, moves, edge = [], [], 0.0
    for name, base_map in maps.items():
        low, high = (np.asarray(each, dtype=np.float64) for each in _extent(base_map))
        move = np.append(np.ceil((np.array([edge, 0.0]) - low[:2]) / step) * step, 0.0)  # local to local
        begin, end = low[0] + move[0], high[0] + move[0]
        shift = move - base_map.origin
        parts.append(
            MapPart(name, base_map.sha256, base_map.crs, tuple(shift.tolist()), begin - gap / 2, end + gap / 2)
        )
        moves.append(move)
        edge = end + gap
    several = list(maps.values())
    arrays: Arrays = {"origin": np.zeros(3)}
    arrays |= _clouds(several, moves, config.tile)
    arrays["stations"] = np.concatenate([
        (each.stations.astype(np.float64) + move).astype(np.float32) for each, move in zip(several, moves, strict=True)
    ])  # fmt: skip
    arrays |= _surveyed(several, moves, config.block)
    arrays |= _fields(several, moves)
    learned = all(each.learned is not None for each in several)
    if learned:
        arrays |= _features(several, moves)
    described = {
        name: np.concatenate([each.descriptors(name) for each in several]) for name in config.descriptor.channels
    }
    arrays |= StationIndex.of(described).arrays()
    return BaseMap(arrays, _parameters(maps, parts, learned))


def joined_file(paths: Sequence[tuple[str, Path]], verify_key: VerifyKey | None = None) -> Path:
    """Return the file of several maps joined, made now if it is not in the cache.

    Args:
        paths: names and files, directories or parts of sites.
        verify_key: has to have signed each of them.

    Raises:
        MapError: a map cannot be loaded, or they cannot be joined.
    """
    maps = {name: BaseMap.load(path, verify_key=verify_key) for name, path in paths}
    key = repr([(name, each.sha256) for name, each in maps.items()])
    path = cache_folder() / f"joined-{hashlib.sha256(key.encode()).hexdigest()[:40]}.{_CODE}.coview"
    if not path.is_file():
        joined = join_maps(maps)
        layers = layers_arrays(joined.arrays) if FIELD_ARRAYS[0] in joined.arrays else {}
        file_format.save(path, joined.arrays | layers, joined.parameters)
        remember_written(path)
        evict(cache_folder(), path)
    return path


def _check_alike(maps: Mapping[str, BaseMap]) -> None:
    (first, one), *others = maps.items()
    for name, other in others:
        for setting in _SHARED:
            mine, its = (getattr(each.config, setting) for each in (one, other))
            if mine != its:
                raise MapError(f"{first} and {name} differ in {setting} ({mine} and {its}): build them with the same")
        if one.learned is not None and other.learned is not None and one.learned.weights != other.learned.weights:
            raise MapError(f"{first} and {name} hold features of different networks: build one of them again")


def _step(block: float, tile: float) -> float:
    """Metres by which maps are moved: whole stations, and tiles of all kinds."""
    edges = (block, tile, FIELD_CELL * FIELD_TILE, float(FEATURE_TILE))
    return math.lcm(*(round(1000 * edge) for edge in edges)) / 1000.0


def _extent(base_map: BaseMap) -> tuple[Floats, Floats]:
    """Corners (2,) of what a map covers, relative to its origin, metres."""
    points, surveyed = base_map.points, base_map.arrays["surveyed"]
    corner, block = base_map.arrays["surveyed_corner"], base_map.config.block
    low = np.minimum(points[:, :2].min(axis=0), corner)
    return low, np.maximum(points[:, :2].max(axis=0), corner + block * np.array(surveyed.shape[::-1]))


def _clouds(maps: Sequence[BaseMap], moves: Sequence[Floats], tile: float) -> Arrays:
    points, index, begin = [], [], 0
    for each, move in zip(maps, moves, strict=True):
        points.append((each.points.astype(np.float64) + move).astype(np.float32))
        rows = np.array(each.arrays["tile_index"])
        rows[:, :2] += _tiles(move, tile)
        rows[:, 2:] += begin
        index.append(rows)
        begin += len(each.points)
    return {
        "points": np.concatenate(points),
        "normals": np.concatenate([np.asarray(each.arrays["normals"]) for each in maps]),
        "tile_index": np.concatenate(index),
    }


def _surveyed(maps: Sequence[BaseMap], moves: Sequence[Floats], block: float) -> Arrays:
    """One raster of what has been surveyed: the gaps are not."""
    corners = [each.arrays["surveyed_corner"] + move[:2] for each, move in zip(maps, moves, strict=True)]
    low = np.min(corners, axis=0)
    starts = [np.rint((corner - low) / block).astype(np.int64)[::-1] for corner in corners]
    shapes = [np.array(each.arrays["surveyed"].shape) for each in maps]
    whole = np.zeros(np.max([start + shape for start, shape in zip(starts, shapes, strict=True)], axis=0), np.uint8)
    for each, (row, column), (height, width) in zip(maps, starts, shapes, strict=True):
        whole[row : row + height, column : column + width] = each.arrays["surveyed"]
    return {"surveyed": whole, "surveyed_corner": low}


def _fields(maps: Sequence[BaseMap], moves: Sequence[Floats]) -> Arrays:
    if any(name not in each.arrays for each in maps for name in FIELD_ARRAYS):
        return {}  # it is made when it is first used
    found: Arrays = {
        name: np.concatenate([np.asarray(each.arrays[name]) for each in maps])
        for name in FIELD_ARRAYS
        if name != "field.tiles"
    }
    tiles = []
    for each, move in zip(maps, moves, strict=True):
        rows = np.array(each.arrays["field.tiles"])
        rows[:, :2] += _tiles(move, FIELD_CELL * FIELD_TILE)[::-1].astype(np.int32)
        tiles.append(rows)
    return {**found, "field.tiles": np.concatenate(tiles)}


def _features(maps: Sequence[BaseMap], moves: Sequence[Floats]) -> Arrays:
    kept = ("local", "sigma", "place")
    found: Arrays = {
        f"learned.{name}": np.concatenate([np.asarray(each.arrays[f"learned.{name}"]) for each in maps])
        for name in kept
    }
    tiles, places = [], []
    for each, move in zip(maps, moves, strict=True):
        tiles.append(each.arrays["learned.tiles"] + _tiles(move, float(FEATURE_TILE)).astype(np.int32))
        places.append((each.arrays["learned.place_at"] + move[:2]).astype(np.float32))
    return {**found, "learned.tiles": np.concatenate(tiles), "learned.place_at": np.concatenate(places)}


def _tiles(move: Floats, edge: float) -> Ints:
    """How many tiles a map is moved by, east and north."""
    return np.rint(move[:2] / edge).astype(np.int64)


def _parameters(maps: Mapping[str, BaseMap], parts: Sequence[MapPart], learned: bool) -> dict[str, Any]:
    several = list(maps.values())
    first = dict(several[0].parameters)
    return first | {
        "crs": None,
        "parts": MapParts(parts).to_json(),
        "sources": {f"{name}/{source}": sha for name, each in maps.items() for source, sha in each.sources.items()},
        "source_points": sum(int(each.parameters.get("source_points", 0)) for each in several),
        "learned": first.get("learned") if learned else None,
    }


JOINED_SUFFIX = ".joined"
_NAMES_FORMAT = "coview-joined"


def write_names(maps: Sequence[tuple[str, Path]]) -> Path:
    """Write names and paths of maps, and return the file, one for each list.

    Raises:
        MapError: two have one name, or the cache cannot be written.
    """
    names = [name for name, _ in maps]
    for name, path in maps:
        if names.count(name) > 1:
            raise MapError(f"two maps are called {name}: name them, as in first={path}")
    rows = [[name, str(path.absolute())] for name, path in maps]
    name = hashlib.sha256(repr(rows).encode()).hexdigest()[:16] + JOINED_SUFFIX
    return write_record(name, {"format": _NAMES_FORMAT, "maps": rows})


def read_names(file: Path) -> list[tuple[str, Path]]:
    """Return the names and paths that a file has.

    Raises:
        MapError: it is something else.
    """
    try:
        data = read_record(file)
        if data["format"] != _NAMES_FORMAT:
            raise ValueError("another format")
        return [(str(name), Path(str(path))) for name, path in data["maps"]]
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise MapError(f"{file}: names no maps ({error}); name the maps themselves again") from error


def load_map(path: Path, verify_key: VerifyKey | None = None) -> BaseMap:
    """Return a map.

    Args:
        path: as :meth:`BaseMap.load` takes it; or a file of names (:func:`write_names`), whose joined map is made
            first where it is not there.
        verify_key: has to have signed it, or each of several.

    Raises:
        As :meth:`BaseMap.load`; MapError: maps cannot be joined.
    """
    if path.suffix != JOINED_SUFFIX:
        return BaseMap.load(path, verify_key=verify_key)
    maps = read_names(path)
    joined, _ = open_made(lambda: joined_file(maps, verify_key))
    return BaseMap.load(joined, check=False)
