"""Arrays of a map from the layers of a site's tiles.

Each tile is processed with the points around it, including points of neighbours in the store that were not requested.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from coview_kernels import StationCodes
from coview_stream.basemap.file_format import MAX_AREA, Arrays
from coview_stream.basemap.likelihood_field import LAYERS, field_arrays, layers_arrays
from coview_stream.basemap.map_arrays import TOO_LARGE, EarlierMap, cells_of, map_arrays
from coview_stream.basemap.site.array_files import ArrayFiles
from coview_stream.basemap.site.layers import decode, most_bytes, read_cloud_layer, read_stations_layer
from coview_stream.basemap.site.manifest import Manifest, TileEntry
from coview_stream.basemap.site.site_grid import HALO, SiteGrid
from coview_stream.basemap.site.store import TileStore
from coview_stream.basemap.stations import Described, describe_storeys
from coview_stream.basemap.tiles import Key, sort_by_tile, unit_normals
from coview_stream.clouds.progress import Progress
from coview_stream.config import MapConfig, config_of_map
from coview_stream.errors import MapError
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Int8s, Ints
from coview_stream.geometry.transforms import Points

log = logging.getLogger("coview_stream.maps")

VERSION = 5  # in a working file's name; counts changes of the arrays that are built from the same layers
PARAMETER = "made_tiles"
"""Parameter of a working file: each tile's state, first station, station count, first field row and row count."""

_FIELD_MARGIN = 16.0  # metres around a tile that affect its field: one tile of the field
_PORTION = 8192  # stations described at a time: 20 MB of descriptors per channel
_LEARNED = ("local", "sigma", "tiles", "place", "place_at")


def assemble(
    manifest: Manifest,
    store: TileStore,
    into: ArrayFiles,
    progress: Progress | None = None,
    keys: Collection[Key] | None = None,
    earlier: Callable[[Mapping[Key, str]], EarlierMap] | None = None,
) -> tuple[Arrays, dict[str, Any]]:
    """Return arrays and parameters of a map of a site, or of some of its tiles; the arrays outlive ``into``.

    ``earlier`` opens an earlier map, given the states of the tiles (:meth:`SiteTiles.states`).

    Raises:
        MapError: a layer is missing or damaged, too few or too many stations, or no room.
    """
    entries = [tile for tile in manifest.tiles if keys is None or (tile.column, tile.row) in keys]
    steps, done = 3 * len(entries), 0

    def step() -> None:
        nonlocal done
        done += 1
        if progress:
            progress(done, steps)

    counted, block = sum(entry.stations for entry in entries), config_of_map(manifest.parameters["config"]).block
    if not counted:
        raise MapError("the site has no stations there; build it again, or ask for other tiles")
    across, down = (
        1 + max(numbers) - min(numbers) for numbers in zip(*((e.column, e.row) for e in entries), strict=True)
    )
    area = across * down * manifest.tile**2
    if (most := MAX_AREA * min(1.0, (block / MapConfig.block) ** 2)) < area:  # the same number of cells
        raise MapError(f"tiles in a rectangle of {area / 1e6:.0f} km2, {most / 1e6:.0f} at most: {TOO_LARGE}")
    if counted > StationCodes.MAX_STATIONS:
        raise MapError(f"{counted} stations, {StationCodes.MAX_STATIONS} at most: {TOO_LARGE}")
    tiles = SiteTiles(manifest, store, entries, into, step)
    states = tiles.states(manifest)
    arrays, rows = map_arrays(tiles, into, None if earlier is None else earlier(states), step)
    arrays |= {"origin": np.array(manifest.origin, dtype=np.float64), "tile_index": tiles.index()}
    arrays |= {name: arrays[name][: tiles.points] for name in ("points", "normals")}  # without the neighbours' points
    learned = manifest.parameters.get("learned")
    if learned is None or not all("features" in entry.layers for entry in entries):
        learned = None
    else:
        layers = [layer_of(entry, "features", store, tiles.grid) for entry in entries]
        try:
            arrays |= {f"learned.{name}": np.concatenate([layer[name] for layer in layers]) for name in _LEARNED}
        except (KeyError, ValueError) as error:
            flaw = f"a tile's features are damaged ({error})"
            raise MapError(f"{flaw}; fetch or build it again") from error
    parameters = dict(manifest.parameters) | {"crs": manifest.crs, "site": manifest.sha256, "learned": learned}
    if keys is not None and isinstance(read := parameters.get("source_points"), int):
        # an estimate: source points are not counted per tile
        parameters["source_points"] = round(read * tiles.points / sum(tile.points for tile in manifest.tiles))
    table: list[list[Any]] = []
    first = row = 0
    for key, stations in tiles.stations.items():
        table.append([states[key], first, len(stations), row, rows[key]])
        first, row = first + len(stations), row + rows[key]
    return arrays, parameters | {PARAMETER: table}


def field_layers(arrays: Arrays, into: ArrayFiles) -> Arrays:
    """Return the layers of a map's field, built in files; MapError if they are too large."""
    try:
        made = layers_arrays(arrays, into.zeros, into.release)
    except ValueError as error:
        raise MapError(f"{error}: {TOO_LARGE}") from error
    files = into.arrays()
    return {name: files.get(name.removeprefix(LAYERS), values) for name, values in made.items()}


class SiteTiles:
    """Tiles of a site for :func:`~coview_stream.basemap.map_arrays.map_arrays`, with their clouds in files.

    Attributes:
        config: settings of the map.
        stations: (M, 3) stations of each tile, relative to the origin.
        grid: grid of the site.
    """

    def __init__(
        self,
        manifest: Manifest,
        store: TileStore,
        entries: Sequence[TileEntry],
        into: ArrayFiles,
        step: Callable[[], None],
    ) -> None:
        # MapError where a layer is missing or damaged, or does not match the manifest
        self.config = config_of_map(manifest.parameters["config"])
        self.stations: dict[Key, Floats32] = {}
        self.grid = SiteGrid(manifest.origin, manifest.tile, self.config)
        self._entries, self._files = entries, into
        self._clouds: dict[Key, str] = {}  # hash of the layer
        self._spans: dict[Key, tuple[int, int]] = {}
        self._cells: dict[Key, Ints] = {}
        self._index: list[Ints] = []
        for entry in entries:
            self._add(entry, store)
            stations = read_stations_layer(layer_of(entry, "stations", store, self.grid), self.config.block)
            if len(stations) != entry.stations:
                raise MapError(f"tile {entry.column}, {entry.row}: its stations are not those that the manifest counts")
            low = self.grid.corner((entry.column, entry.row))[:2] - self.config.block
            high = low + self.grid.tile + 2.0 * self.config.block
            if not ((stations[:, :2] >= low) & (stations[:, :2] <= high)).all():
                raise MapError(f"tile {entry.column}, {entry.row}: its stations lie beside it; fetch or build it again")
            self.stations[entry.column, entry.row] = stations
            step()
        neighbours = {key for own in self._spans for key in self.grid.around(own)} - self._spans.keys()
        for entry in manifest.tiles:
            cloud = entry.layers["cloud"]
            if (entry.column, entry.row) in neighbours and store.holds(cloud.sha256, cloud.bytes):
                try:
                    self._add(entry, store)
                except MapError as error:
                    log.warning("%s; the tiles beside it are made without it", error)

    @property
    def points(self) -> int:
        """Number of points, excluding neighbours."""
        return sum(end - begin for begin, end in (self._spans[key] for key in self.stations))

    def cells(self, beside: bool) -> Ints:
        """Return column and row (K, 2) of the blocks that hold points; with ``beside`` also blocks of neighbours."""
        return np.concatenate([self._cells[key] for key in (self._cells if beside else self.stations)])

    def index(self) -> Ints:
        """Return the tile index (T, 4) of the map's cloud."""
        return np.concatenate(self._index[: len(self.stations)])

    def states(self, manifest: Manifest) -> dict[Key, str]:
        """Return for each tile a hash of the settings, its stations, and the clouds on and around it."""
        settings = [VERSION, manifest.origin, manifest.tile, repr(self.config)]
        states = {}
        for entry in self._entries:
            key = entry.column, entry.row
            around = [[*other, self._clouds[other]] for other in self.grid.around(key) if other in self._clouds]
            text = json.dumps([settings, key, entry.layers["stations"].sha256, around])
            states[key] = hashlib.sha256(text.encode()).hexdigest()[:32]
        return states

    def described(self, wanted: Ints, keys: Collection[Key] | None = None) -> Iterator[tuple[Described, Ints]]:
        """Yield descriptors of stations, portion by portion, with their numbers in the map."""
        config = self.config.descriptor
        begin = 0
        for key, stations in self.stations.items():
            numbers = wanted[(wanted >= begin) & (wanted < begin + len(stations))]
            if len(numbers) and (keys is None or key in keys):
                points, _ = self._around(key, max(HALO, config.radius + 2.0 * self.config.block))
                for start in range(0, len(numbers), _PORTION):
                    part = numbers[start : start + _PORTION]
                    yield describe_storeys(points, stations, self.config.block, config, None, part - begin), part
            begin += len(stations)

    def field(self, key: Key, surveyed: Bools, corner: Floats) -> Arrays:
        """Return the likelihood field of a tile; no arrays where nothing is surveyed."""
        block, tile = self.config.block, self.grid.tile
        first = np.rint(corner / block).astype(np.int64)
        low = np.rint((self.grid.corner(key)[:2] - _FIELD_MARGIN) / block).astype(np.int64)
        high = np.rint((self.grid.corner(key)[:2] + tile + _FIELD_MARGIN) / block).astype(np.int64)
        begin = np.clip(low - first, 0, surveyed.shape[::-1])
        end = np.clip(high - first, begin, surveyed.shape[::-1])
        window = surveyed[begin[1] : end[1], begin[0] : end[0]]
        if not window.any():
            return {}
        points, packed = self._around(key, _FIELD_MARGIN)
        at = (begin + first) * block
        inside = ((points[:, :2] >= at) & (points[:, :2] < at + np.array(window.shape[::-1]) * block)).all(axis=1)
        made = field_arrays(points[inside], unit_normals(packed[inside]), window, at, block)
        rows, columns = made["field.tiles"][:, 0], made["field.tiles"][:, 1]
        per = round(tile / _FIELD_MARGIN)
        own = (columns // per == key[0]) & (rows // per == key[1])
        return {name: values[own] for name, values in made.items()}

    def _around(self, key: Key, margin: float) -> tuple[Points, Int8s]:
        """Return points (N, 3) and int8 normals (N, 3) within ``margin`` metres of a tile."""
        low = self.grid.corner(key)[:2] - margin
        high = low + self.grid.tile + 2.0 * margin
        clouds = []
        for other in self.grid.around(key):
            if other in self._spans:
                points, normals = (self._files.rows(name, *self._spans[other]) for name in ("points", "normals"))
                near = ((points[:, :2] >= low) & (points[:, :2] < high)).all(axis=1)
                clouds.append((points[near], normals[near]))
        return np.concatenate([points for points, _ in clouds]), np.concatenate([normals for _, normals in clouds])

    def _add(self, entry: TileEntry, store: TileStore) -> None:
        key = entry.column, entry.row
        cloud = layer_of(entry, "cloud", store, self.grid)
        points, packed = read_cloud_layer(cloud, self.grid.corner(key), self.grid.tile, self.config.voxel)
        if len(points) != entry.points:
            raise MapError(f"tile {key[0]}, {key[1]}: its cloud is not the one that the manifest counts")
        index = np.zeros((0, 4), dtype=np.int64)
        if len(points):
            points, packed, index = sort_by_tile(points, packed, self.config.tile)
        begin = self._files.append("points", points)
        self._files.append("normals", packed)
        index[:, 2:] += begin
        self._index.append(index)
        self._spans[key] = begin, begin + len(points)
        self._cells[key] = cells_of(points, self.config.block)
        self._clouds[key] = entry.layers["cloud"].sha256


def layer_of(entry: TileEntry, name: str, store: TileStore, grid: SiteGrid) -> Arrays:
    """Return the arrays of a tile's layer; MapError if it is missing, damaged, or larger than the entry says."""
    layer = entry.layers[name]
    most = most_bytes(name, entry.points, entry.stations, grid.tile, grid.config.voxel)
    return decode(store.get(layer.sha256, layer.bytes), str(store.path(layer.sha256)), most)
