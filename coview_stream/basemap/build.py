"""Build a map in memory, from clouds to arrays with the paper's virtual reference scans."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from coview_stream.basemap.file_format import Arrays
from coview_stream.basemap.ground import ground_filter
from coview_stream.basemap.map_arrays import MemoryArrays, MemoryTile, map_arrays
from coview_stream.basemap.sources import Source, short_names, warn_of_other_systems
from coview_stream.basemap.stations import describe_storeys, find_stations
from coview_stream.basemap.tiles import scaled_normals, sort_by_tile
from coview_stream.clouds.cloud import merge
from coview_stream.clouds.cloud_head import check_together, extent_in_words, head_of
from coview_stream.clouds.filters import estimate_normals, remove_outliers, voxel_grid
from coview_stream.clouds.progress import Progress, staged_bar
from coview_stream.config import MapConfig
from coview_stream.errors import MapError, warn

_MIN_POINTS = 1000  # after cleaning; fewer are not a site

_SHARES = {
    "reading": 0.04, "cleaning, finding normals": 0.18, "finding the ground": 0.07, "describing stations": 0.03,
    "computing learned features": 0.53, "computing the likelihood field": 0.15,
}  # fmt: skip
"""Shares of the build time for the progress bar, measured on a street survey of 0.2 km2."""


def build_arrays(sources: list[Source], config: MapConfig, progress: bool = False) -> tuple[Arrays, dict[str, Any]]:
    """Read ``sources``, and return a map's arrays and parameters.

    Raises:
        CloudError: a source cannot be read.
        MapError: too few points, or no ground to put stations on.
        InputError: learned features are requested without weights.
    """
    if config.learned:
        from coview_stream.descriptors.network import VIEW_NAMES, network

        for view in VIEW_NAMES:  # fail before reading clouds if weights are missing
            network(view)
    shares = {name: share for name, share in _SHARES.items() if config.learned or name != "computing learned features"}
    with staged_bar(shares, progress) as stage:
        return _build(sources, config, stage)


def _build(sources: list[Source], config: MapConfig, stage: Callable[[str], Progress]) -> tuple[Arrays, dict[str, Any]]:
    paths = [source.path for source in sources]
    names = str(paths[0]) if len(paths) == 1 else f"{paths[0]} and {len(paths) - 1} more"
    heads = [source.head() for source in sources]  # reject a bad head before reading any points
    warning = check_together(heads)
    warn(warning)
    warn_of_other_systems(sources, heads)
    step = stage("reading")
    clouds = []
    for source in sources:
        clouds.append(source.read())
        step(len(clouds), len(sources))
    heads = [head_of(path, cloud) for path, cloud in zip(paths, clouds, strict=True)]
    if warning is None:  # some formats have no extent in their heads
        warn(check_together(heads))
    whole = merge(clouds)
    extent = extent_in_words(whole)
    source_points = len(whole)
    origin, crs, raw = whole.origin, whole.crs, whole.points
    del clouds, whole
    # float32 needs a zero near the site, and the source's own origin may be far from it
    shift = np.round(np.median(raw[:: max(1, len(raw) // 100_000)], axis=0).astype(np.float64) / 10.0) * 10.0
    raw -= shift.astype(np.float32)

    step = stage("cleaning, finding normals")
    points = voxel_grid(raw, config.voxel)
    del raw
    step(1, 3)
    if config.outlier_neighbours:
        points, _ = remove_outliers(points, config.outlier_neighbours, config.outlier_std_ratio)
    if len(points) < _MIN_POINTS:
        raise MapError(
            f"{names}: {len(points)} of {source_points} points are left after cleaning, over {extent}; "
            f"a base map needs {_MIN_POINTS} or more: are the coordinates in metres?"
        )
    step(2, 3)
    normals, planarity = estimate_normals(points, config.normal_neighbours, config.normal_radius)
    step(3, 3)
    step = stage("finding the ground")
    stations = find_stations(points, config.block, config.levels)
    if not len(stations):
        raise MapError(
            f"{names}: no ground found in {source_points} points over {extent}; a base map needs points on "
            "the ground, and z up"
        )
    step(1, 1)
    step = stage("describing stations")
    described = describe_storeys(points, stations, config.block, config.descriptor, step)

    learned: tuple[Arrays, dict[str, Any] | None] = ({}, None)
    if config.learned:
        from coview_stream.descriptors.feature_map import feature_arrays

        step = stage("computing learned features")
        learned = feature_arrays(points, step)
    sorted_points, packed, index = sort_by_tile(points, scaled_normals(normals, planarity), config.tile)
    step = stage("computing the likelihood field")
    made, _ = map_arrays(MemoryTile(config, sorted_points, packed, stations, described), MemoryArrays())
    step(1, 1)
    arrays: Arrays = {
        "origin": origin + shift,
        "points": sorted_points,
        "normals": packed,
        "tile_index": index,
        **made,
        **learned[0],
    }
    parameters = {
        "crs": crs,
        "sources": {name: source.sha256() for name, source in zip(short_names(paths), sources, strict=True)},
        "source_points": source_points,
        "ground_filter": ground_filter(points),  # depends on the platform
        "learned": learned[1],
    }
    return arrays, parameters
