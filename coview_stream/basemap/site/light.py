"""Light copy of a site, for robots with little room or a slow link: fewer points, and no learned features.

Of each cube of half a metre one point is kept, with its normal, rounded to four centimetres in place of two: the one
nearest to the middle of those in it. Cubes are those of the likelihood field and of the voxels that descriptors count,
so that both see the same cells occupied.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from coview_stream.basemap.signature import SigningKey
from coview_stream.basemap.site.cloud_layer import STEPS, cloud_layer, read_cloud_layer
from coview_stream.basemap.site.grid import SiteGrid
from coview_stream.basemap.site.layer_bytes import PACKING, encode
from coview_stream.basemap.site.manifest import VERSION, LayerEntry, Manifest, TileEntry, is_site
from coview_stream.basemap.site.site_build import check_directory
from coview_stream.basemap.site.tile_clouds import layer_of
from coview_stream.basemap.site.tile_store import TileStore
from coview_stream.basemap.tiles import unit_normals
from coview_stream.config import config_of_map
from coview_stream.errors import MapError
from coview_stream.geometry.arrays import Ints
from coview_stream.geometry.transforms import Points

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
