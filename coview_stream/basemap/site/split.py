"""Split of a map in one file into the tiles of a site, and the file of a site's tiles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from coview_stream.basemap import file_format
from coview_stream.basemap.file_format import Arrays
from coview_stream.basemap.signature import SigningKey
from coview_stream.basemap.site.array_files import ArrayFiles
from coview_stream.basemap.site.assemble import Progress, assemble
from coview_stream.basemap.site.cloud_layer import cloud_layer, square_metres
from coview_stream.basemap.site.earlier import PARAMETER
from coview_stream.basemap.site.grid import TILE, Key, SiteGrid
from coview_stream.basemap.site.layer_bytes import PACKING, encode
from coview_stream.basemap.site.manifest import LayerEntry, Manifest, TileEntry, in_order
from coview_stream.basemap.site.site_build import check_directory
from coview_stream.basemap.site.stations_layer import stations_layer
from coview_stream.basemap.site.tile_store import TileStore
from coview_stream.basemap.tiles import unit_normals
from coview_stream.config import config_of_map
from coview_stream.errors import MapError

_FEATURES_TILE = 32  # metres


def split(
    arrays: Arrays, parameters: dict[str, Any], directory: Path, key: SigningKey | None = None, tile: float = TILE
) -> Manifest:
    """Write a map as a site. Its points are rounded to 2 cm, its normals to 2 degrees.

    Args:
        arrays: of a map, as its file has them.
        parameters: likewise.
        directory: new or empty, or a site.
        key: signs the manifest.
        tile: edge of the tiles, metres.

    Raises:
        MapError: the directory cannot be used, or the map cannot be cut so.
    """
    check_directory(directory)
    grid = SiteGrid((0.0, 0.0, 0.0), tile, config_of_map(parameters["config"]))
    store, entries = TileStore(directory), []
    points, packed, stations = arrays["points"], arrays["normals"], arrays["stations"]
    of_points, of_stations = grid.cells(points), grid.cells(stations)
    learned = parameters.get("learned") is not None
    for column, row in np.unique(of_points, axis=0).tolist():
        own = (of_points == (column, row)).all(axis=1)
        standing = stations[(of_stations == (column, row)).all(axis=1)]
        local = (points[own] - grid.corner((column, row))).astype(np.float32)
        planarity = np.linalg.norm(packed[own].astype(np.float32), axis=1) / np.float32(127.0)
        layers = {
            "cloud": cloud_layer(local, unit_normals(packed[own]), np.clip(planarity, 0, 1), tile, grid.config.voxel),
            "stations": stations_layer(standing, grid.config.block),
        }
        if learned:
            layers["features"] = _features(arrays, (column, row), tile)
        named = {}
        for name, content in ((name, encode(each, PACKING[name])) for name, each in layers.items()):
            named[name] = LayerEntry(store.put(content), len(content))
        low, high = (round(float(each), 2) for each in (local[:, 2].min(), local[:, 2].max()))
        entries.append(TileEntry(column, row, len(local), len(standing), square_metres(local), low, high, named))
    kept = {name: value for name, value in parameters.items() if name not in ("crs", "site")}
    origin = tuple(float(each) for each in arrays["origin"])
    if len(origin) != 3:
        raise MapError("the map's origin is not one")
    manifest = Manifest(origin, tile, parameters["crs"], kept, in_order(entries))
    manifest = Manifest.from_bytes(manifest.to_bytes(), str(directory))
    if key is not None:
        manifest = manifest.signed(key)
    manifest.save(directory)
    store.prune(manifest.hashes())
    return manifest


def join(directory: Path, path: Path, key: SigningKey | None = None, progress: Progress | None = None) -> str:
    """Write a site as a map in one file, and return its sha256.

    Args:
        directory: of the site.
        path: the file.
        key: signs it.
        progress: called with steps done and all steps.

    Raises:
        MapError: no site, a layer is missing or damaged, or the file cannot be written.
    """
    file_format.check_target(path)
    with ArrayFiles(path.resolve().parent) as into:
        arrays, parameters = assemble(Manifest.load(directory), TileStore(directory), into, progress)
        del parameters[PARAMETER]
        return file_format.save(path, arrays, parameters, key)


def _features(arrays: Arrays, key: Key, tile: float) -> Arrays:
    """Return the learned features that lie on a tile."""
    per = round(tile / _FEATURES_TILE)
    tiles = arrays["learned.tiles"]
    own = (np.floor_divide(tiles, per) == key).all(axis=1)
    at = arrays["learned.place_at"]
    here = (np.floor(at / tile) == key).all(axis=1)
    found = {name: np.array(arrays[f"learned.{name}"][own]) for name in ("local", "sigma", "tiles")}
    return found | {name: np.array(arrays[f"learned.{name}"][here]) for name in ("place", "place_at")}
