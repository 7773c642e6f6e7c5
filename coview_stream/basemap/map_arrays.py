"""Arrays of a map file, built only here, from the clouds and stations of the map's tiles.

A map built as one file is one tile in memory (:class:`MemoryTile`). A site's working file is built tile by tile from
clouds in files, so memory is bounded by a tile, not by the map.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from coview_kernels import StationCodes
from coview_kernels.arrays import I16
from coview_kernels.mapped import release
from coview_stream.basemap.file_format import Arrays
from coview_stream.basemap.likelihood_field import FIELD_ARRAYS, field_arrays
from coview_stream.basemap.station_index import CODES, StationIndex, sampled_stations
from coview_stream.basemap.stations import Described
from coview_stream.basemap.tiles import Key, unit_normals
from coview_stream.config import MapConfig
from coview_stream.errors import MapError
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Int8s, Ints
from coview_stream.geometry.rasters import max_filter
from coview_stream.geometry.transforms import Points

TOO_LARGE = "too large to be searched as one; open a part of the site, --around X,Y,RADIUS"

_SURVEY_MARGIN = 1  # cells
_COPIED = 1 << 15  # stations copied at a time: 16 MB of each tier


class Tiles(Protocol):
    """Clouds and stations of a map's tiles."""

    config: MapConfig

    @property
    def stations(self) -> Mapping[Key, Floats32]:
        """Stations (M, 3) of each tile, in the order of the map's arrays."""

    def cells(self, beside: bool) -> Ints:
        """Return column and row (K, 2) of the blocks that hold points; with ``beside`` also blocks of tiles around."""

    def described(self, wanted: Ints, keys: Collection[Key] | None = None) -> Iterator[tuple[Described, Ints]]:
        """Yield descriptors and map numbers of the stations ``wanted`` (K,) that are on ``keys`` (None: any tile)."""

    def field(self, key: Key, surveyed: Bools, corner: Floats) -> Arrays:
        """Return the likelihood field of a tile; no arrays where nothing is surveyed."""


class MemoryArrays:
    """Arrays by name that grow tile by tile, in memory."""

    def __init__(self) -> None:
        self._parts: dict[str, list[npt.NDArray[Any]]] = {}

    def zeros(self, name: str, shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        """Return a new array of zeros to write to."""
        self._parts[name] = [np.zeros(shape, dtype)]
        return self._parts[name][0]

    def append(self, name: str, rows: npt.NDArray[Any]) -> int:
        """Append rows (N, ...) to an array, and return its earlier length."""
        parts = self._parts.setdefault(name, [])
        parts.append(rows)
        return sum(map(len, parts[:-1]))

    def arrays(self) -> Arrays:
        """Return all arrays by name."""
        return {name: parts[0] if len(parts) == 1 else np.concatenate(parts) for name, parts in self._parts.items()}

    def release(self) -> None:
        """Release the memory of arrays that a subclass keeps in files; arrays in memory stay."""


class MemoryTile:
    """The single tile of a map that is built in memory."""

    def __init__(
        self, config: MapConfig, points: Points, normals: Int8s, stations: Floats32, descriptors: Described
    ) -> None:
        # points (N, 3) and int8 normals (N, 3) in the order of the file, stations (M, 3)
        self.config, self.stations = config, {(0, 0): stations}
        self._points, self._normals, self._descriptors = points, normals, descriptors
        self._cells = cells_of(points, config.block)

    def cells(self, beside: bool) -> Ints:
        """Return column and row (K, 2) of the blocks that hold points."""
        return self._cells

    def described(self, wanted: Ints, keys: Collection[Key] | None = None) -> Iterator[tuple[Described, Ints]]:
        """Yield the descriptors of stations (K,), and their numbers."""
        whole = len(wanted) == len(self.stations[0, 0])
        yield self._descriptors if whole else {name: v[wanted] for name, v in self._descriptors.items()}, wanted

    def field(self, key: Key, surveyed: Bools, corner: Floats) -> Arrays:
        """Return the likelihood field."""
        return field_arrays(self._points, unit_normals(self._normals), surveyed, corner, self.config.block)


class EarlierMap:
    """Arrays of an earlier state of a site, from which unchanged tiles are copied; by default empty.

    The field and the codes of a tile depend on its stations and on the clouds on and around it. Changed tiles are coded
    with the earlier basis; their codes find the same stations (tests/basemap/site/test_working_file.py).
    """

    def __init__(
        self, arrays: Arrays | None = None, spans: Mapping[Key, tuple[slice, slice]] | None = None, channels: Any = ()
    ) -> None:
        """Take arrays, spans (stations, rows of the field) of the unchanged tiles, and the descriptors' channels."""
        self.arrays = arrays or {}
        self._index = StationIndex.from_arrays(self.arrays, channels)
        usable = self._index is not None and all(name in self.arrays for name in FIELD_ARRAYS)
        self._spans = dict(spans or {}) if usable else {}

    def stations(self, key: Key) -> slice | None:
        """Return the numbers of a tile's stations in the earlier map; None for a tile that has changed."""
        return self._spans[key][0] if key in self._spans else None

    def field(self, key: Key) -> Arrays | None:
        """Return the field of a tile; None for a tile that has changed."""
        return {name: self.arrays[name][self._spans[key][1]] for name in FIELD_ARRAYS} if key in self._spans else None

    def tiers(self, into: Sequence[I16]) -> list[StationCodes] | None:
        """Return codes with the earlier map's basis, to be filled in.

        None if every tile has changed, or if the basis was learned from fewer stations than a new one would be.
        """
        if self._index is None or not self._spans:
            return None
        if len(self._index) < min(len(into[0]), StationCodes.LEARNED):
            return None
        return [
            StationCodes(codes, tier.basis, tier.step, tier.norm.copy(), tier.sectors)
            for codes, tier in zip(into, self._index.tiers, strict=True)
        ]

    def release(self) -> None:
        """Release the memory of mapped pages."""
        for name in (*CODES, *FIELD_ARRAYS):
            if name in self.arrays:
                release(self.arrays[name])


def map_arrays(
    tiles: Tiles, into: MemoryArrays, earlier: EarlierMap | None = None, step: Callable[[], None] = lambda: None
) -> tuple[Arrays, dict[Key, int]]:
    """Build stations, surveyed cells, likelihood field and station codes of a map, and count field rows by tile.

    Large arrays are built in ``into``; its earlier arrays are returned as well. ``step`` is called twice per tile.
    MapError if there are too many stations, or no room.
    """
    earlier = EarlierMap() if earlier is None else earlier
    stations = sum(map(len, tiles.stations.values()))
    if stations > StationCodes.MAX_STATIONS:
        raise MapError(f"{stations} stations, {StationCodes.MAX_STATIONS} at most: {TOO_LARGE}")
    block = tiles.config.block
    surveyed, corner = surveyed_around(tiles.cells(beside=False), block)
    around, around_corner = surveyed_around(tiles.cells(beside=True), block)
    rows = {}
    for key in tiles.stations:
        made = earlier.field(key) or tiles.field(key, around > 0, around_corner)
        for name, values in made.items():
            into.append(name, values)
        rows[key] = len(made[FIELD_ARRAYS[0]]) if made else 0
        earlier.release()
        step()
    index = _station_codes(tiles, stations, into, earlier, step)
    whole = np.concatenate(list(tiles.stations.values()))
    return {"stations": whole, "surveyed": surveyed, "surveyed_corner": corner, **into.arrays(), **index}, rows


def _station_codes(
    tiles: Tiles, stations: int, into: MemoryArrays, earlier: EarlierMap, step: Callable[[], None]
) -> Arrays:
    """Build the station codes in ``into``, and return the other arrays of the station index.

    Descriptors of all stations are never in memory at once, unless the tiles hold them.
    """

    def together(wanted: Ints) -> tuple[Ints, Described]:
        parts, numbers = zip(*tiles.described(wanted), strict=True)
        return np.concatenate(numbers), {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    made = [into.zeros(name, StationCodes.shape_of(stations), np.int16) for name in CODES]
    sampled, tiers = sampled_stations(stations), earlier.tiers(made)
    copies = tiers is not None
    if tiers is None:
        learned = StationCodes.learned_from(stations)
        numbers, values = together(np.union1d(learned, sampled))
        tiers = StationCodes.empty_tiers(
            [v[np.searchsorted(numbers, learned)] for v in values.values()], 2, stations, made
        )
        sample = {name: v[np.searchsorted(numbers, sampled)] for name, v in values.items()}
    else:
        sample = together(sampled)[1]
    begin = 0
    for key, positions in tiles.stations.items():
        count, before = len(positions), earlier.stations(key) if copies else None
        if before is None:
            for part, numbers in tiles.described(np.arange(begin, begin + count), [key]):
                StationCodes.encode_tiers(tiers, slice(int(numbers[0]), int(numbers[-1]) + 1), list(part.values()))
                into.release()
        else:
            for start in range(0, count, _COPIED):
                end = min(start + _COPIED, count)
                for name, codes in zip(CODES, made, strict=True):
                    codes[begin + start : begin + end] = earlier.arrays[name][before][start:end]
                into.release()
                earlier.release()
        begin += count
        step()
    arrays = StationIndex(tiers[0], tiers[1], sample).arrays()
    return {name: values for name, values in arrays.items() if name not in CODES}


def cells_of(points: Points, block: float) -> Ints:
    """Return column and row (K, 2) of the block-sized cells that hold points (N, 3), each once."""
    cells = np.floor(points[:, :2].astype(np.float64) / block).astype(np.int64)
    if not len(cells):
        return cells
    low = cells.min(axis=0)
    columns, rows = (cells - low).T
    grid = np.zeros((int(rows.max()) + 1, int(columns.max()) + 1), dtype=bool)
    grid[rows, columns] = True
    return np.asarray(np.argwhere(grid)[:, ::-1] + low)


def surveyed_around(cells: Ints, block: float) -> tuple[npt.NDArray[np.uint8], Floats]:
    """Mask cells (H, W) that hold points, given as (K, 2), or touch one that does; also return the lower corner (2,).

    The neighbours bridge the shadows of buildings, which were surveyed but have no points.
    """
    low = cells.min(axis=0) - _SURVEY_MARGIN
    columns, rows = (cells - low).T
    grid = np.zeros((int(rows.max()) + 1 + _SURVEY_MARGIN, int(columns.max()) + 1 + _SURVEY_MARGIN), dtype=bool)
    grid[rows, columns] = True
    return (max_filter(grid.astype(np.float32), 2 * _SURVEY_MARGIN + 1) > 0.0).astype(np.uint8), low * block
