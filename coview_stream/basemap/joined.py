"""Several maps placed side by side in one frame, so that one search compares places on all of them.

A place on another map competes like one on the same map: a robot whose scans fit two storeys equally gets no pose. The
gap between two maps is wider than any scan.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_kernels.reference.field import CELL as FIELD_CELL
from coview_kernels.reference.field import TILE as FIELD_TILE
from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.file_format import Arrays, save
from coview_stream.basemap.likelihood_field import FIELD_ARRAYS, layers_arrays
from coview_stream.basemap.map_parts import MapPart, MapParts
from coview_stream.basemap.signature import VerifyKey
from coview_stream.basemap.site.store import cache_folder, evict, read_record, remember_written, write_record
from coview_stream.basemap.site.working_file import open_made
from coview_stream.basemap.station_index import StationIndex
from coview_stream.descriptors.feature_map import TILE as FEATURE_TILE
from coview_stream.errors import MapError
from coview_stream.geometry.arrays import Floats, Ints

JOINED_SUFFIX = ".joined"

_NAMES_FORMAT = "coview-joined"
_VERSION = 5  # in the file's name; counts changes of the files that are made of the same maps

_MIN_GAP = 300.0  # metres: a lidar's range, and a margin beyond the map's edge
_SHARED = ("block", "voxel", "tile", "descriptor")


def load_map(path: Path, verify_key: VerifyKey | None = None) -> BaseMap:
    """Load one map (:meth:`BaseMap.load`), or several as one, from a file of :func:`write_names`.

    With a key, each map must be signed. MapError if the maps cannot be joined.
    """
    if path.suffix != JOINED_SUFFIX:
        return BaseMap.load(path, verify_key=verify_key)
    maps = read_names(path)
    joined, _ = open_made(lambda: joined_file(maps, verify_key))
    return BaseMap.load(joined, check=False)


def write_names(maps: Sequence[tuple[str, Path]]) -> Path:
    """Write names and paths of maps into a small file for :func:`load_map`, and return its path.

    MapError if two have the same name, or the cache cannot be written.
    """
    names = [name for name, _ in maps]
    for name, path in maps:
        if names.count(name) > 1:
            raise MapError(f"two maps are called {name}: name them, as in first={path}")
    rows = [[name, str(path.absolute())] for name, path in maps]
    name = hashlib.sha256(repr(rows).encode()).hexdigest()[:16] + JOINED_SUFFIX
    return write_record(name, {"format": _NAMES_FORMAT, "maps": rows})


def read_names(file: Path) -> list[tuple[str, Path]]:
    """Return the names and paths in a file of :func:`write_names`; MapError if it is no such file."""
    try:
        data = read_record(file)
        if data["format"] != _NAMES_FORMAT:
            raise ValueError("another format")
        return [(str(name), Path(str(path))) for name, path in data["maps"]]
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise MapError(f"{file}: names no maps ({error}); name the maps themselves again") from error


def joined_file(paths: Sequence[tuple[str, Path]], verify_key: VerifyKey | None = None) -> Path:
    """Return the cached file of several joined maps, written if it does not exist; MapError if that fails."""
    maps = {name: BaseMap.load(path, verify_key=verify_key) for name, path in paths}
    key = repr([(name, base_map.sha256) for name, base_map in maps.items()])
    path = cache_folder() / f"joined-{hashlib.sha256(key.encode()).hexdigest()[:40]}.{_VERSION}.coview"
    if not path.is_file():
        joined = join_maps(maps)
        layers = layers_arrays(joined.arrays) if FIELD_ARRAYS[0] in joined.arrays else {}
        save(path, joined.arrays | layers, joined.parameters)
        remember_written(path)
        evict(cache_folder(), path)
    return path


def join_maps(maps: Mapping[str, BaseMap]) -> BaseMap:
    """Join several maps, placed from west to east; MapError if there are none or their settings differ."""
    if not maps:
        raise MapError("no maps to join: name two or more")
    (first_name, first), *others = maps.items()
    for name, other in others:
        for setting in _SHARED:
            mine, its = getattr(first.config, setting), getattr(other.config, setting)
            if mine != its:
                raise MapError(
                    f"{first_name} and {name} differ in {setting} ({mine} and {its}): build them with the same"
                )
        if first.learned is not None and other.learned is not None and first.learned.weights != other.learned.weights:
            raise MapError(f"{first_name} and {name} hold features of different networks: build one of them again")
    several, config = list(maps.values()), first.config
    parts, moves = _placed(maps)
    pairs = list(zip(several, moves, strict=True))

    def united(name: str) -> npt.NDArray[Any]:
        return np.concatenate([np.asarray(base_map.arrays[name]) for base_map in several])

    def moved(name: str) -> npt.NDArray[Any]:
        columns = several[0].arrays[name].shape[1]
        return np.concatenate(
            [(m.arrays[name].astype(np.float64) + move[:columns]).astype(np.float32) for m, move in pairs]
        )

    def moved_tiles(name: str, edge: float, order: slice = slice(None)) -> Ints:
        """Shift each map's tile numbers; columns 0, 1 count east, north or, with ``order`` reversed, north, east."""
        rows = [np.array(m.arrays[name]) for m in several]
        for tiles, move in zip(rows, moves, strict=True):
            tiles[:, :2] += np.rint(move[:2] / edge).astype(np.int32)[order]
        return np.concatenate(rows)

    arrays: Arrays = {"origin": np.zeros(3), "normals": united("normals")}
    arrays |= {"points": moved("points"), "stations": moved("stations")}
    arrays["tile_index"] = moved_tiles("tile_index", config.tile)
    begins = np.cumsum([0, *(len(m.points) for m in several)])
    arrays["tile_index"][:, 2:] += np.repeat(begins[:-1], [len(m.arrays["tile_index"]) for m in several])[:, None]
    arrays |= _surveyed(pairs, config.block)
    if all(name in base_map.arrays for base_map in several for name in FIELD_ARRAYS):
        arrays |= {name: united(name) for name in FIELD_ARRAYS}
        arrays["field.tiles"] = moved_tiles("field.tiles", FIELD_CELL * FIELD_TILE, slice(None, None, -1))
    learned = all(base_map.learned is not None for base_map in several)
    if learned:
        arrays |= {name: united(name) for name in ("learned.local", "learned.sigma", "learned.place")}
        arrays["learned.tiles"] = moved_tiles("learned.tiles", float(FEATURE_TILE))
        arrays["learned.place_at"] = moved("learned.place_at")
    channels = config.descriptor.channels
    described = {name: np.concatenate([base_map.descriptors(name) for base_map in several]) for name in channels}
    arrays |= StationIndex.of(described).arrays()
    parameters: dict[str, Any] = {
        "config": first.parameters["config"],
        "crs": None,
        "parts": MapParts(parts).to_json(),
        "sources": {f"{name}/{source}": sha for name, m in maps.items() for source, sha in m.sources.items()},
        "source_points": sum(int(base_map.parameters.get("source_points", 0)) for base_map in several),
        "learned": first.parameters.get("learned") if learned else None,
    }
    return BaseMap(arrays, parameters)


def _surveyed(pairs: Sequence[tuple[BaseMap, Floats]], block: float) -> Arrays:
    """Return one raster of surveyed cells; the gaps are not surveyed."""
    corners = [base_map.arrays["surveyed_corner"] + move[:2] for base_map, move in pairs]
    low = np.min(corners, axis=0)
    starts = [np.rint((corner - low) / block).astype(np.int64)[::-1] for corner in corners]
    rasters = [base_map.arrays["surveyed"] for base_map, _ in pairs]
    ends = [start + raster.shape for start, raster in zip(starts, rasters, strict=True)]
    whole = np.zeros(np.max(ends, axis=0), np.uint8)
    for raster, (row, column), (end_row, end_column) in zip(rasters, starts, ends, strict=True):
        whole[row:end_row, column:end_column] = raster
    return {"surveyed": whole, "surveyed_corner": low}


def _placed(maps: Mapping[str, BaseMap]) -> tuple[list[MapPart], list[Floats]]:
    """Return the parts of the joined map, and the shift (3,) of each map, metres."""
    config = next(iter(maps.values())).config
    # shift by whole blocks of stations and whole tiles of all kinds
    edges = (config.block, config.tile, FIELD_CELL * FIELD_TILE, float(FEATURE_TILE))
    step = math.lcm(*(round(1000 * edge) for edge in edges)) / 1000.0
    gap = max(_MIN_GAP, 3.0 * config.descriptor.radius)
    parts, moves, edge = [], [], 0.0
    for name, base_map in maps.items():
        points, corner = base_map.points, base_map.arrays["surveyed_corner"]
        low = np.minimum(points[:, :2].min(axis=0), corner)
        size = config.block * np.array(base_map.arrays["surveyed"].shape[::-1])
        high = np.maximum(points[:, :2].max(axis=0), corner + size)
        low, high = low.astype(np.float64), high.astype(np.float64)
        move = np.append(np.ceil((np.array([edge, 0.0]) - low) / step) * step, 0.0)
        begin, end = low[0] + move[0], high[0] + move[0]
        shift = tuple((move - base_map.origin).tolist())
        parts.append(MapPart(name, base_map.sha256, base_map.crs, shift, begin - gap / 2, end + gap / 2))
        moves.append(move)
        edge = end + gap
    return parts, moves
