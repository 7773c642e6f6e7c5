"""Light copy of a site, for robots with little room or a slow link: fewer points, and no learned features.

Of each cube of half a metre one point is kept, with its normal, rounded to four centimetres in place of two: the one
nearest to the middle of those in it. Cubes are those of the likelihood field and of the voxels that descriptors count,
so that both see the same cells occupied.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from coview_stream.basemap import file_format
from coview_stream.basemap.file_format import Arrays
from coview_stream.basemap.signature import SigningKey
from coview_stream.basemap.site.array_files import ArrayFiles
from coview_stream.basemap.site.assemble import PARAMETER, Progress, assemble, layer_of
from coview_stream.basemap.site.layers import (
    PACKING,
    STEPS,
    cloud_layer,
    encode,
    read_cloud_layer,
    square_metres,
    stations_layer,
)
from coview_stream.basemap.site.manifest import (
    TILE,
    VERSION,
    LayerEntry,
    Manifest,
    SiteGrid,
    TileEntry,
    in_order,
    is_site,
)
from coview_stream.basemap.site.site_build import check_directory
from coview_stream.basemap.site.store import TileStore
from coview_stream.basemap.tiles import Key, unit_normals
from coview_stream.config import config_of_map
from coview_stream.errors import MapError
from coview_stream.geometry.arrays import Ints
from coview_stream.geometry.transforms import Points

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


CUBE = 0.5
"""Edge of a cube, metres: a cell of the likelihood field."""

_LIGHT = "light"  # parameter of a manifest


def lighten(
    source: Path, target: Path, key: SigningKey | None = None, progress: Callable[[int, int], None] | None = None
) -> Manifest:
    """Write a light copy of a site, and return its manifest.

    Args:
        source: directory of the site.
        target: new or empty directory, or a light copy, which is replaced.
        key: signs the manifest.
        progress: called with tiles done and all tiles.

    Raises:
        MapError: no site, a layer is missing or damaged, or the target cannot be used.
    """
    manifest = Manifest.load(source)
    _check(source, target, manifest)
    grid = SiteGrid(manifest.origin, manifest.tile, config_of_map(manifest.parameters["config"]))
    kept, made, entries = TileStore(source), TileStore(target), []
    for done, entry in enumerate(manifest.tiles, start=1):
        entries.append(_light_tile(entry, grid, kept, made))
        if progress:
            progress(done, len(manifest.tiles))
    parameters = dict(manifest.parameters) | {"learned": None, _LIGHT: {"cube": CUBE, "of": manifest.sha256}}
    parameters["config"] = dict(manifest.parameters["config"]) | {"learned": False}
    light = replace(manifest, parameters=parameters, tiles=tuple(entries), signer="", signature="", version=VERSION)
    if key is not None:
        light = light.signed(key)
    light.save(target)
    made.prune(light.hashes())
    return light


def _check(source: Path, target: Path, manifest: Manifest) -> None:
    """Refuse what would lose something: another site in the target's place, a copy within a site, a copy of a copy."""
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


def _light_tile(entry: TileEntry, grid: SiteGrid, kept: TileStore, made: TileStore) -> TileEntry:
    voxel = grid.config.voxel
    local = np.zeros(3)  # about the tile's corner, which lies on the cubes
    points, packed = read_cloud_layer(layer_of(entry, "cloud", kept), local, grid.tile, voxel)
    chosen = one_of_each_cube(points)
    step = 2.0 * voxel / STEPS
    rounded = ((np.floor(points[chosen].astype(np.float64) / step) + 0.5) * step).astype(np.float32)
    planarity = np.linalg.norm(packed[chosen].astype(np.float32), axis=1) / np.float32(127.0)
    cloud = cloud_layer(rounded, unit_normals(packed[chosen]), np.clip(planarity, 0, 1), grid.tile, voxel)
    content = encode(cloud, PACKING["cloud"])
    stations = entry.layers["stations"]
    layers = {"cloud": LayerEntry(made.put(content), len(content)), "stations": stations}
    made.put(kept.get(stations.sha256, stations.bytes))
    return replace(entry, points=len(chosen), layers=layers)


def one_of_each_cube(points: Points, cube: float = CUBE) -> Ints:
    """Choose of points (N, 3) the numbers (K,), ascending, of one in each cube: the nearest to their mean."""
    cells = np.floor(points.astype(np.float64) / cube).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    shape = cells.max(axis=0, initial=0) + 1
    flat = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
    _, number, count = np.unique(flat, return_inverse=True, return_counts=True)
    number = number.reshape(-1)
    mean = np.stack([np.bincount(number, weights=points[:, d]) for d in range(3)], axis=1) / count[:, None]
    away = np.square(points - mean[number]).sum(axis=1)
    order = np.lexsort((away, number))
    first = np.flatnonzero(np.append(True, np.diff(number[order]) != 0)) if len(order) else order
    return np.sort(order[first])
