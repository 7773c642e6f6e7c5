"""Assembly of a site: the arrays of a map, out of the layers of some or all of its tiles.

What layers do not hold is made here: the likelihood field, the codes of the stations' descriptors, what has been
surveyed. Tiles are worked on one after the other, each with the points around it, so that memory is bounded by a tile
and by what a map keeps; the descriptors of the stations are never in memory all at once.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from coview_kernels import StationCodes
from coview_stream.basemap.build import surveyed_cells
from coview_stream.basemap.file_format import Arrays
from coview_stream.basemap.likelihood_field import field_arrays
from coview_stream.basemap.site.cloud_layer import read_cloud_layer
from coview_stream.basemap.site.grid import HALO, Key, SiteGrid
from coview_stream.basemap.site.layer_bytes import decode
from coview_stream.basemap.site.manifest import Manifest, TileEntry
from coview_stream.basemap.site.stations_layer import read_stations_layer
from coview_stream.basemap.site.tile_store import TileStore
from coview_stream.basemap.station_index import StationIndex, sampled_stations
from coview_stream.basemap.stations import Described, describe_storeys
from coview_stream.basemap.tiles import sort_by_tile_packed, unit_normals
from coview_stream.config import MapConfig, config_of_map
from coview_stream.errors import MapError
from coview_stream.geometry.arrays import Bools, Floats32, Int8s, Ints
from coview_stream.geometry.transforms import Points

Progress = Callable[[int, int], None]

_FIELD_MARGIN = 16.0  # metres around a tile that its field sees, one tile of the field
_LEARNED = ("local", "sigma", "tiles", "place", "place_at")


def assemble(
    manifest: Manifest, store: TileStore, progress: Progress | None = None, keys: Collection[Key] | None = None
) -> tuple[Arrays, dict[str, Any]]:
    """Return the arrays of a map, and its parameters.

    Args:
        manifest: of the site.
        store: its layers.
        progress: called with steps done and all steps.
        keys: the tiles to take; None takes all.

    Raises:
        MapError: a layer is missing or damaged, or no station is on these tiles.
    """
    entries = [tile for tile in manifest.tiles if keys is None or (tile.column, tile.row) in keys]
    grid = SiteGrid(manifest.origin, manifest.tile, config_of_map(manifest.parameters["config"]))
    steps, done = 3 * len(entries), 0

    def step() -> None:
        nonlocal done
        done += 1
        if progress:
            progress(done, steps)

    loaded = _Loaded(grid, store, entries, step)
    if not sum(len(each) for each in loaded.stations.values()):
        raise MapError("the site has no stations there; build it again, or ask for other tiles")
    arrays: Arrays = {
        "origin": np.array(manifest.origin, dtype=np.float64),
        "stations": np.concatenate(list(loaded.stations.values())),
        **loaded.cloud(),
    }
    surveyed, corner = surveyed_cells(arrays["points"], grid.config.block)
    arrays |= {"surveyed": surveyed, "surveyed_corner": corner}
    arrays |= _field(loaded, surveyed > 0, corner)
    arrays |= _codes(loaded, arrays["stations"], step)
    features = manifest.parameters.get("learned") is not None and all("features" in t.layers for t in entries)
    if features:
        arrays |= _features(entries, store)
    parameters = dict(manifest.parameters) | {"crs": manifest.crs, "site": manifest.sha256}
    return arrays, parameters | {"learned": manifest.parameters["learned"] if features else None}


class _Loaded:
    """Tiles in memory.

    Attributes:
        grid: the tiles.
        stations: (M, 3) of each tile, relative to the origin.
    """

    def __init__(
        self, grid: SiteGrid, store: TileStore, entries: Sequence[TileEntry], step: Callable[[], None]
    ) -> None:
        self.grid = grid
        self.stations: dict[Key, Floats32] = {}
        self._points: dict[Key, tuple[Points, Int8s]] = {}
        voxel, block = grid.config.voxel, grid.config.block
        for entry in entries:
            key = (entry.column, entry.row)
            layers = {name: layer_of(entry, name, store) for name in ("cloud", "stations")}
            self._points[key] = read_cloud_layer(layers["cloud"], grid.corner(key), grid.tile, voxel)
            self.stations[key] = read_stations_layer(layers["stations"], block)
            if (len(self._points[key][0]), len(self.stations[key])) != (entry.points, entry.stations):
                raise MapError(f"tile {key[0]}, {key[1]}: its layers are not those that the manifest counts")
            step()

    def cloud(self) -> Arrays:
        """Return the arrays of the cloud; a tile of it never lies on two tiles of the site."""
        parts, begin = [], 0
        for own, packed in self._points.values():
            if len(own):
                ordered, turned, rows = sort_by_tile_packed(own, packed, self.grid.config.tile)
                rows[:, 2:] += begin
                begin += len(own)
                parts.append((ordered, turned, rows))
        joined = [np.concatenate([part[k] for part in parts]) for k in range(3)]
        return dict(zip(("points", "normals", "tile_index"), joined, strict=True))

    def around(self, key: Key, margin: float) -> tuple[Points, Int8s]:
        """Return points and packed normals within ``margin`` metres of a tile."""
        low = self.grid.corner(key)[:2] - margin
        high = low + self.grid.tile + 2.0 * margin
        found = []
        for other in self.grid.around(key):
            if other in self._points:
                points, normals = self._points[other]
                near = ((points[:, :2] >= low) & (points[:, :2] < high)).all(axis=1)
                found.append((points[near], normals[near]))
        return np.concatenate([each for each, _ in found]), np.concatenate([each for _, each in found])


def layer_of(entry: TileEntry, name: str, store: TileStore) -> dict[str, np.ndarray]:
    """Return the arrays of a tile's layer; MapError where it is missing or damaged."""
    layer = entry.layers[name]
    content = store.get(layer.sha256, layer.bytes)
    return decode(content, str(store.path(layer.sha256)))


def _field(loaded: _Loaded, surveyed: Bools, corner: np.ndarray) -> Arrays:
    """Return the likelihood field, made tile by tile."""
    parts: list[Arrays] = []
    grid = loaded.grid
    block = grid.config.block
    first = np.rint(corner / block).astype(np.int64)
    for key in loaded.stations:
        low = np.rint((grid.corner(key)[:2] - _FIELD_MARGIN) / block).astype(np.int64)
        high = np.rint((grid.corner(key)[:2] + grid.tile + _FIELD_MARGIN) / block).astype(np.int64)
        begin = np.maximum(low - first, 0)
        end = np.minimum(high - first, surveyed.shape[::-1])
        known = surveyed[begin[1] : end[1], begin[0] : end[0]]
        if not known.any():
            continue
        points, packed = loaded.around(key, _FIELD_MARGIN)
        at = (begin + first) * block
        inside = ((points[:, :2] >= at) & (points[:, :2] < at + np.array(known.shape[::-1]) * block)).all(axis=1)
        made = field_arrays(points[inside], unit_normals(packed[inside]), known, at, block)
        rows, columns = made["field.tiles"][:, 0], made["field.tiles"][:, 1]
        per = round(grid.tile / _FIELD_MARGIN)
        own = (columns // per == key[0]) & (rows // per == key[1])
        parts.append({name: values[own] for name, values in made.items()})
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _codes(loaded: _Loaded, stations: Floats32, step: Callable[[], None]) -> Arrays:
    """Return the arrays of the station index: learned from some stations of all tiles, then made tile by tile."""
    learned = [part for part, _ in _described(loaded, StationCodes.learned_from(len(stations)), step)]
    descriptors = [np.concatenate([part[name] for part in learned]) for name in learned[0]]
    tiers = StationCodes.empty_tiers(descriptors, 2, len(stations))
    sample = sampled_stations(len(stations))
    kept = {name: np.zeros((len(sample), *each.shape[1:]), each.dtype) for name, each in learned[0].items()}
    for part, numbers in _described(loaded, np.arange(len(stations)), step):
        StationCodes.encode_tiers(tiers, slice(int(numbers[0]), int(numbers[-1]) + 1), list(part.values()))
        chosen = np.flatnonzero((sample >= numbers[0]) & (sample <= numbers[-1]))
        for name, values in part.items():
            kept[name][chosen] = values[sample[chosen] - numbers[0]]
    return StationIndex(tiers[0], tiers[1], kept).arrays()


def _described(loaded: _Loaded, wanted: Ints, step: Callable[[], None]) -> Iterator[tuple[Described, Ints]]:
    """Yield the descriptors of some stations, tile by tile, with their numbers."""
    config: MapConfig = loaded.grid.config
    begin = 0
    for key, stations in loaded.stations.items():
        numbers = wanted[(wanted >= begin) & (wanted < begin + len(stations))]
        if len(numbers):
            margin = max(HALO, config.descriptor.radius + 2.0 * config.block)
            points, _ = loaded.around(key, margin)
            yield describe_storeys(points, stations, config.block, config.descriptor, None, numbers - begin), numbers
        begin += len(stations)
        step()


def _features(entries: Sequence[TileEntry], store: TileStore) -> Arrays:
    """Return the learned features of the tiles."""
    layers: list[Mapping[str, np.ndarray]] = [layer_of(entry, "features", store) for entry in entries]
    try:
        return {f"learned.{name}": np.concatenate([layer[name] for layer in layers]) for name in _LEARNED}
    except (KeyError, ValueError) as error:
        raise MapError(f"a tile's features are not what they should be ({error}); fetch or build it again") from error
