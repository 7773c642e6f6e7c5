"""Building of a map in memory: clouds to arrays (paper, section 3.1, and the virtual reference scans of 3.2)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from coview_stream.basemap.file_format import Arrays
from coview_stream.basemap.ground import ground_filter
from coview_stream.basemap.map_arrays import MemoryArrays, MemoryTile, map_arrays
from coview_stream.basemap.sources import Source
from coview_stream.basemap.stations import Progress, below_another, describe_storeys, find_stations
from coview_stream.basemap.tiles import scaled_normals, sort_by_tile
from coview_stream.clouds.cloud import Cloud, merge
from coview_stream.clouds.cloud_head import check_together, extent_in_words, head_of
from coview_stream.clouds.filters import estimate_normals, remove_outliers, voxel_grid
from coview_stream.config import MapConfig
from coview_stream.errors import MapError, warn

_MIN_POINTS = 1000  # fewer are no site


def build_arrays(sources: list[Source], config: MapConfig, progress: bool = False) -> tuple[Arrays, dict[str, Any]]:
    """Read ``sources``, and return a map's arrays and parameters.

    Raises:
        CloudError: a source cannot be read.
        MapError: too few points, or no ground to put stations on.
        DependencyError, InputError: learned features are asked for, and there is no onnxruntime or no weights.
    """
    if config.learned:
        from coview_stream.descriptors.network import VIEW_NAMES, network

        for view in VIEW_NAMES:  # before the clouds are read: they may be missing
            network(view)
    paths = [source.path for source in sources]
    warning = check_together([source.head() for source in sources])  # all heads before the first points
    warn(warning)
    with _progress_bar(progress, "reading") as step:
        clouds = [_read(source, k, len(sources), step) for k, source in enumerate(sources)]
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

    with _progress_bar(progress, "cleaning and normals") as step:
        points = voxel_grid(raw, config.voxel)
        del raw
        step(1, 3)
        if config.outlier_neighbours:
            points, _ = remove_outliers(points, config.outlier_neighbours, config.outlier_std_ratio)
        if len(points) < _MIN_POINTS:
            raise MapError(
                f"{_names(paths)}: {len(points)} of {source_points} points are left after cleaning, over {extent}; "
                f"a base map needs {_MIN_POINTS} or more: are the coordinates in metres?"
            )
        step(2, 3)
        normals, planarity = estimate_normals(points, config.normal_neighbours, config.normal_radius)
        step(3, 3)
    with _progress_bar(progress, "ground") as step:
        stations = find_stations(points, config.block, config.levels)
        if not len(stations):
            raise MapError(
                f"{_names(paths)}: no ground found in {source_points} points over {extent}; a base map needs points on "
                "the ground, and z up"
            )
        step(1, 1)
    with _progress_bar(progress, "describing stations") as step:
        described = describe_storeys(points, stations, config.block, config.descriptor, step)

    learned: tuple[Arrays, dict[str, Any] | None] = ({}, None)
    if config.learned:
        from coview_stream.descriptors.feature_map import feature_arrays

        with _progress_bar(progress, "learned features") as step:
            learned = feature_arrays(points, step)
    sorted_points, packed, index = sort_by_tile(points, scaled_normals(normals, planarity), config.tile)
    with _progress_bar(progress, "likelihood field") as step:
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
        "sources": {_label(source.path, paths): source.sha256() for source in sources},
        "source_points": source_points,
        "ground_filter": ground_filter(points),  # depends on the platform
        "stations_below_another": int(below_another(stations, config.block).sum()),
        "learned": learned[1],
    }
    return arrays, parameters


def _read(source: Source, done: int, total: int, step: Progress) -> Cloud:
    cloud = source.read()
    step(done + 1, total)
    return cloud


def _names(paths: list[Path]) -> str:
    return str(paths[0]) if len(paths) == 1 else f"{paths[0]} and {len(paths) - 1} more"


def _label(path: Path, paths: list[Path]) -> str:
    """Name a source by its file name, or by its path where several have that name."""
    return path.name if [other.name for other in paths].count(path.name) == 1 else str(path)


@contextmanager
def _progress_bar(show: bool, title: str) -> Iterator[Progress]:
    """Draw a progress bar on stderr with an ETA, if ``show``."""
    from tqdm import tqdm

    with tqdm(total=1, desc=title, unit="", disable=not show, leave=False) as bar:

        def step(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield step
