"""Assembly of a site: the arrays of a map, out of the layers of some or all of its tiles.

What layers do not hold is made here: the likelihood field, the codes of the stations' descriptors, what has been
surveyed. Tiles are worked on one after the other, each with the points around it, also those of tiles that are not
asked for but there. What is made is written to files as it is made, so that memory is bounded by a tile, not by the
map.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coview_kernels import StationCodes
from coview_stream.basemap.build import surveyed_around
from coview_stream.basemap.file_format import Arrays
from coview_stream.basemap.likelihood_field import FIELD_ARRAYS, LAYERS, field_arrays, layers_arrays
from coview_stream.basemap.site.array_files import ArrayFiles
from coview_stream.basemap.site.assemble_codes import station_codes
from coview_stream.basemap.site.earlier import PARAMETER, Earlier, record, states_of
from coview_stream.basemap.site.manifest import Key, Manifest, SiteGrid, TileEntry
from coview_stream.basemap.site.store import TileStore
from coview_stream.basemap.site.tile_clouds import TileClouds, layer_of
from coview_stream.basemap.tiles import unit_normals
from coview_stream.config import config_of_map
from coview_stream.errors import MapError
from coview_stream.geometry.arrays import Bools, Floats

Progress = Callable[[int, int], None]

_FIELD_MARGIN = 16.0  # metres around a tile that its field sees, one tile of the field
_IN_PARTS = "too large to be searched as one; open a part of the site, --around X,Y,RADIUS"
_LEARNED = ("local", "sigma", "tiles", "place", "place_at")


def assemble(
    manifest: Manifest,
    store: TileStore,
    into: ArrayFiles,
    progress: Progress | None = None,
    keys: Collection[Key] | None = None,
    earlier: Path | None = None,
) -> tuple[Arrays, dict[str, Any]]:
    """Return the arrays of a map, and its parameters.

    Args:
        manifest: of the site.
        store: its layers.
        into: where they are made; they stay usable after it is closed.
        progress: called with steps done and all steps.
        keys: the tiles to take; None takes all.
        earlier: a working file of the site, from which tiles that are the same are taken.

    Raises:
        MapError: a layer is missing or damaged, no station is on these tiles, or there is no room.
    """
    entries = [tile for tile in manifest.tiles if keys is None or (tile.column, tile.row) in keys]
    grid = SiteGrid(manifest.origin, manifest.tile, config_of_map(manifest.parameters["config"]))
    steps, done = 3 * len(entries), 0

    def step() -> None:
        nonlocal done
        done += 1
        if progress:
            progress(done, steps)

    stations = sum(entry.stations for entry in entries)
    if not stations:
        raise MapError("the site has no stations there; build it again, or ask for other tiles")
    if stations > StationCodes.MAX_STATIONS:
        raise MapError(f"{stations} stations, {StationCodes.MAX_STATIONS} at most: {_IN_PARTS}")
    clouds = TileClouds(manifest, grid, store, entries, into, step)
    states = states_of(manifest, clouds)
    taken = Earlier(states, earlier, grid.config.descriptor.channels)
    surveyed, corner = surveyed_around(clouds.cells(beside=False), grid.config.block)
    rows = _field(clouds, taken, into, step)
    small = station_codes(clouds, taken, into, step)
    arrays: Arrays = {
        "origin": np.array(manifest.origin, dtype=np.float64),
        "stations": np.concatenate(list(clouds.stations.values())),
        "tile_index": clouds.index(),
        "surveyed": surveyed,
        "surveyed_corner": corner,
        **into.arrays(),
        **small,
    }
    arrays |= {name: arrays[name][: clouds.points] for name in ("points", "normals")}  # without those around
    features = manifest.parameters.get("learned") is not None and all("features" in t.layers for t in entries)
    if features:
        arrays |= _features(entries, store)
    parameters = dict(manifest.parameters) | {"crs": manifest.crs, "site": manifest.sha256}
    if keys is not None and isinstance(read := parameters.get("source_points"), int):
        share = clouds.points / sum(tile.points for tile in manifest.tiles)
        parameters["source_points"] = round(share * read)  # about: how many lay on each tile is not kept
    counts = {key: len(each) for key, each in clouds.stations.items()}
    parameters[PARAMETER] = record(states, counts, rows)
    return arrays, parameters | {"learned": manifest.parameters["learned"] if features else None}


def layers(arrays: Arrays, into: ArrayFiles) -> Arrays:
    """Return the rasters in which the field of these arrays is looked up, made in files.

    Raises:
        MapError: the map is too large for them, or there is no room.
    """
    try:
        made = layers_arrays(arrays, into.zeros, into.release)
    except ValueError as error:
        raise MapError(f"{error}: {_IN_PARTS}") from error
    kept = into.arrays()
    return {name: kept.get(name.removeprefix(LAYERS), values) for name, values in made.items()}


def _field(clouds: TileClouds, earlier: Earlier, into: ArrayFiles, step: Callable[[], None]) -> dict[Key, int]:
    """Make the likelihood field tile by tile, and return how many of its rows are each tile's."""
    surveyed, corner = surveyed_around(clouds.cells(beside=True), clouds.grid.config.block)
    counts = {}
    for key in clouds.stations:
        made = earlier.field(key) or _field_of_tile(clouds, key, surveyed > 0, corner)
        for name, rows in made.items():
            into.append(name, rows)
        counts[key] = len(made[FIELD_ARRAYS[0]]) if made else 0
        earlier.release()
        step()
    return counts


def _field_of_tile(clouds: TileClouds, key: Key, surveyed: Bools, corner: Floats) -> Arrays:
    grid = clouds.grid
    block = grid.config.block
    first = np.rint(corner / block).astype(np.int64)
    low = np.rint((grid.corner(key)[:2] - _FIELD_MARGIN) / block).astype(np.int64)
    high = np.rint((grid.corner(key)[:2] + grid.tile + _FIELD_MARGIN) / block).astype(np.int64)
    begin = np.clip(low - first, 0, surveyed.shape[::-1])
    end = np.clip(high - first, begin, surveyed.shape[::-1])
    known = surveyed[begin[1] : end[1], begin[0] : end[0]]
    if not known.any():
        return {}
    points, packed = clouds.around(key, _FIELD_MARGIN)
    at = (begin + first) * block
    inside = ((points[:, :2] >= at) & (points[:, :2] < at + np.array(known.shape[::-1]) * block)).all(axis=1)
    made = field_arrays(points[inside], unit_normals(packed[inside]), known, at, block)
    rows, columns = made["field.tiles"][:, 0], made["field.tiles"][:, 1]
    per = round(grid.tile / _FIELD_MARGIN)
    own = (columns // per == key[0]) & (rows // per == key[1])
    return {name: values[own] for name, values in made.items()}


def _features(entries: Sequence[TileEntry], store: TileStore) -> Arrays:
    """Return the learned features of the tiles."""
    found: list[Mapping[str, np.ndarray]] = [layer_of(entry, "features", store) for entry in entries]
    try:
        return {f"learned.{name}": np.concatenate([layer[name] for layer in found]) for name in _LEARNED}
    except (KeyError, ValueError) as error:
        raise MapError(f"a tile's features are not what they should be ({error}); fetch or build it again") from error
