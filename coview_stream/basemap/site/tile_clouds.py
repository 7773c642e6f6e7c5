"""Clouds of a site's tiles, decoded once, sorted and kept in files, and the points around any of the tiles."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import numpy as np

from coview_stream.basemap.build import cells_of
from coview_stream.basemap.file_format import Arrays
from coview_stream.basemap.site.array_files import ArrayFiles
from coview_stream.basemap.site.layers import decode, read_cloud_layer, read_stations_layer
from coview_stream.basemap.site.manifest import Key, Manifest, SiteGrid, TileEntry
from coview_stream.basemap.site.store import TileStore
from coview_stream.basemap.tiles import sort_by_tile_packed
from coview_stream.errors import MapError
from coview_stream.geometry.arrays import Floats32, Int8s, Ints
from coview_stream.geometry.transforms import Points

log = logging.getLogger("coview_stream.maps")


class TileClouds:
    """Some tiles of a site, and the clouds of those around them that are in the store.

    Attributes:
        grid: the tiles.
        entries: the tiles, in the order of the map's arrays.
        stations: (M, 3) of each tile, relative to the origin.
        seen: hash of the cloud of each tile, those around included.
    """

    def __init__(
        self,
        manifest: Manifest,
        grid: SiteGrid,
        store: TileStore,
        entries: Sequence[TileEntry],
        into: ArrayFiles,
        step: Callable[[], None],
    ) -> None:
        """Decode all of them; MapError where a layer is missing or damaged, or is not what the manifest counts."""
        self.grid, self.entries = grid, entries
        self.stations: dict[Key, Floats32] = {}
        self.seen: dict[Key, str] = {}
        self._files = into
        self._spans: dict[Key, tuple[int, int]] = {}
        self._cells: dict[Key, Ints] = {}
        self._index: list[Ints] = []
        for entry in entries:
            self._add(entry, *self._read(entry, store))
            stations = read_stations_layer(layer_of(entry, "stations", store), grid.config.block)
            if len(stations) != entry.stations:
                raise MapError(f"tile {entry.column}, {entry.row}: its stations are not those that the manifest counts")
            self.stations[entry.column, entry.row] = stations
            step()
        self._own = len(self._spans)
        beside = {key for entry in entries for key in grid.around((entry.column, entry.row))} - self._spans.keys()
        for entry in manifest.tiles:
            cloud = entry.layers["cloud"]
            if (entry.column, entry.row) in beside and store.holds(cloud.sha256, cloud.bytes):
                try:
                    cloud_there = self._read(entry, store)
                except MapError as error:
                    log.warning("%s; the tiles beside it are made without it", error)
                    continue
                self._add(entry, *cloud_there)

    @property
    def points(self) -> int:
        """Number of points of the tiles themselves."""
        return sum(end - begin for begin, end in list(self._spans.values())[: self._own])

    def cells(self, beside: bool) -> Ints:
        """Return column and row (K, 2) of the blocks that hold points of the tiles, or of those around as well."""
        found = list(self._cells.values())
        return np.concatenate(found if beside else found[: self._own])

    def index(self) -> Ints:
        """Return the index (T, 4) of the map's own tiles of the cloud."""
        return np.concatenate(self._index[: self._own])

    def around(self, key: Key, margin: float) -> tuple[Points, Int8s]:
        """Return points and packed normals within ``margin`` metres of a tile."""
        low = self.grid.corner(key)[:2] - margin
        high = low + self.grid.tile + 2.0 * margin
        found = []
        for other in self.grid.around(key):
            if other in self._spans:
                points, normals = (self._files.rows(name, *self._spans[other]) for name in ("points", "normals"))
                near = ((points[:, :2] >= low) & (points[:, :2] < high)).all(axis=1)
                found.append((points[near], normals[near]))
        return np.concatenate([each for each, _ in found]), np.concatenate([each for _, each in found])

    def _read(self, entry: TileEntry, store: TileStore) -> tuple[Points, Int8s]:
        key = entry.column, entry.row
        layer = layer_of(entry, "cloud", store)
        points, packed = read_cloud_layer(layer, self.grid.corner(key), self.grid.tile, self.grid.config.voxel)
        if len(points) != entry.points:
            raise MapError(f"tile {key[0]}, {key[1]}: its cloud is not the one that the manifest counts")
        return points, packed

    def _add(self, entry: TileEntry, points: Points, packed: Int8s) -> None:
        key = entry.column, entry.row
        index = np.zeros((0, 4), dtype=np.int64)
        if len(points):
            points, packed, index = sort_by_tile_packed(points, packed, self.grid.config.tile)
        begin = self._files.append("points", points)
        self._files.append("normals", packed)
        index[:, 2:] += begin
        self._index.append(index)
        self._spans[key] = begin, begin + len(points)
        self._cells[key] = cells_of(points, self.grid.config.block)
        self.seen[key] = entry.layers["cloud"].sha256


def layer_of(entry: TileEntry, name: str, store: TileStore) -> Arrays:
    """Return the arrays of a tile's layer; MapError where it is missing or damaged."""
    layer = entry.layers[name]
    content = store.get(layer.sha256, layer.bytes)
    return decode(content, str(store.path(layer.sha256)))
