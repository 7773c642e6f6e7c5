"""Conversion of maps: one file to the tiles of a site, a site to one file, and light copies of sites.

A light copy is for robots with a small disk or a slow link. It has no learned features, and keeps in each cube of half
a metre only the point nearest to the mean, rounded to four centimetres instead of two. The cubes are the cells of the
likelihood field and the voxels that descriptors count, so the same cells stay occupied.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from coview_stream.basemap.file_format import Arrays, check_target, save
from coview_stream.basemap.signature import SigningKey
from coview_stream.basemap.site.array_files import ArrayFiles
from coview_stream.basemap.site.assemble import PARAMETER, assemble, layer_of
from coview_stream.basemap.site.layers import STEPS, cloud_layer, read_cloud_layer
from coview_stream.basemap.site.manifest import VERSION, Manifest, in_order, is_site
from coview_stream.basemap.site.site_build import check_directory
from coview_stream.basemap.site.site_grid import TILE, SiteGrid
from coview_stream.basemap.site.store import TileStore
from coview_stream.basemap.site.tile_build import put_layer, write_tile
from coview_stream.basemap.tiles import Key, unit_normals
from coview_stream.clouds.progress import Progress
from coview_stream.config import config_of_map
from coview_stream.errors import MapError
from coview_stream.geometry.arrays import Floats32, Int8s, Ints
from coview_stream.geometry.transforms import Points

CUBE = 0.5
"""Edge of a cube, metres: a cell of the likelihood field."""

_FEATURES_TILE = 32  # metres
_LIGHT = "light"  # parameter that only the manifest of a light copy has


def split(arrays: Arrays, parameters: dict[str, Any], directory: Path, key: SigningKey | None = None) -> Manifest:
    """Write a map as a site into a directory that is new, empty or a site, signed if there is a key.

    Points are rounded to 2 cm, normals within 2.3 degrees. MapError if the directory cannot be used.
    """
    check_directory(directory)
    grid = SiteGrid((0.0, 0.0, 0.0), TILE, config_of_map(parameters["config"]))
    store, entries = TileStore(directory), []
    points, packed, stations = arrays["points"], arrays["normals"], arrays["stations"]
    of_points, of_stations = grid.cells(points), grid.cells(stations)
    learned = parameters.get("learned") is not None
    for column, row in np.unique(of_points, axis=0).tolist():
        tile = (column, row)
        own = (of_points == tile).all(axis=1)
        local = (points[own] - grid.corner(tile)).astype(np.float32)
        standing = stations[(of_stations == tile).all(axis=1)]
        features = _features(arrays, tile) if learned else None
        entries.append(write_tile(store, grid, tile, (local, *_unpacked(packed[own])), standing, features))
    x, y, z = (float(value) for value in arrays["origin"])
    site_parameters = {name: value for name, value in parameters.items() if name not in ("crs", "site")}
    manifest = Manifest((x, y, z), TILE, parameters["crs"], site_parameters, in_order(entries))
    manifest = Manifest.from_bytes(manifest.to_bytes(), str(directory))
    return _finish(manifest, directory, key)


def join(directory: Path, path: Path, key: SigningKey | None = None, progress: Progress | None = None) -> str:
    """Write a site as a map in one file, signed if there is a key, and return its sha256.

    MapError if a layer is missing or damaged, or the file cannot be written. ``progress`` counts steps.
    """
    check_target(path)
    with ArrayFiles(path.resolve().parent) as into:
        arrays, parameters = assemble(Manifest.load(directory), TileStore(directory), into, progress)
        del parameters[PARAMETER]
        return save(path, arrays, parameters, key)


def lighten(source: Path, target: Path, key: SigningKey | None = None, progress: Progress | None = None) -> Manifest:
    """Write a light copy of a site into a directory that is new, empty or a light copy, and return its manifest.

    MapError if a layer is missing or damaged, or the target cannot be used. ``progress`` counts tiles.
    """
    manifest = Manifest.load(source)
    here, there = source.resolve(), target.resolve()
    if here == there:
        raise MapError(f"{target}: is the site itself; name another directory for the light copy")
    if here in there.parents or there in here.parents:
        raise MapError(f"{target}: one of {source} and {target} lies in the other; name a directory beside the site")
    if _LIGHT in manifest.parameters:
        raise MapError(f"{source}: is a light copy already; are the names the other way round?")
    if is_site(target) and _LIGHT not in Manifest.load(target).parameters:
        raise MapError(f"{target}: is a whole site, which a light copy would replace; name a new directory")
    check_directory(target)
    grid = SiteGrid(manifest.origin, manifest.tile, config_of_map(manifest.parameters["config"]))
    store, light_store, entries = TileStore(source), TileStore(target), []
    voxel, step = grid.config.voxel, 2.0 * grid.config.voxel / STEPS
    for done, entry in enumerate(manifest.tiles, start=1):
        # relative to the tile's corner, which is a corner of a cube
        points, packed = read_cloud_layer(layer_of(entry, "cloud", store, grid), np.zeros(3), grid.tile, voxel)
        chosen = one_of_each_cube(points)
        rounded = ((np.floor(points[chosen].astype(np.float64) / step) + 0.5) * step).astype(np.float32)
        cloud = put_layer(light_store, "cloud", cloud_layer(rounded, *_unpacked(packed[chosen]), grid.tile, voxel))
        stations = entry.layers["stations"]
        light_store.put(store.get(stations.sha256, stations.bytes))
        entries.append(replace(entry, points=len(chosen), layers={"cloud": cloud, "stations": stations}))
        if progress:
            progress(done, len(manifest.tiles))
    parameters = dict(manifest.parameters) | {"learned": None, _LIGHT: {"cube": CUBE, "of": manifest.sha256}}
    parameters["config"] = dict(manifest.parameters["config"]) | {"learned": False}
    light = replace(manifest, parameters=parameters, tiles=tuple(entries), signer="", signature="", version=VERSION)
    return _finish(light, target, key)


def _finish(manifest: Manifest, directory: Path, key: SigningKey | None) -> Manifest:
    """Sign and save a manifest, and delete the layers that it does not name."""
    if key is not None:
        manifest = manifest.signed(key)
    manifest.save(directory)
    TileStore(directory).prune(manifest.hashes())
    return manifest


def _unpacked(packed: Int8s) -> tuple[Points, Floats32]:
    """Return unit normals (N, 3) and planarity (N,) of a map's normals."""
    planarity = np.linalg.norm(packed.astype(np.float32), axis=1) / np.float32(127.0)
    return unit_normals(packed), np.clip(planarity, 0, 1)


def _features(arrays: Arrays, key: Key) -> Arrays:
    """Return the learned features that lie on a tile."""
    own = (np.floor_divide(arrays["learned.tiles"], round(TILE / _FEATURES_TILE)) == key).all(axis=1)
    here = (np.floor(arrays["learned.place_at"] / TILE) == key).all(axis=1)
    local = {name: np.array(arrays[f"learned.{name}"][own]) for name in ("local", "sigma", "tiles")}
    return local | {name: np.array(arrays[f"learned.{name}"][here]) for name in ("place", "place_at")}


def one_of_each_cube(points: Points, cube: float = CUBE) -> Ints:
    """Return the numbers (K,), ascending, of the point of (N, 3) nearest to the mean in each cube."""
    cells = np.floor(points.astype(np.float64) / cube).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    shape = cells.max(axis=0, initial=0) + 1
    flat = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
    _, number, count = np.unique(flat, return_inverse=True, return_counts=True)
    number = number.reshape(-1)
    mean = np.stack([np.bincount(number, weights=points[:, d]) for d in range(3)], axis=1) / count[:, None]
    away = np.square(points - mean[number]).sum(axis=1)
    order = np.lexsort((away, number))
    first = np.unique(number[order], return_index=True)[1]
    return np.sort(order[first])
