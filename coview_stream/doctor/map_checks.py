"""Checks of a base map: whether it opens, its contents, and the memory that a node needs for it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from coview_stream.doctor.finding import Finding, from_error
from coview_stream.doctor.machine_checks import GB, MIN_MEMORY
from coview_stream.errors import MapError

if TYPE_CHECKING:
    from coview_stream.basemap.basemap import BaseMap

# of onnxruntime, the network and other imports, in two processes
_NETWORK_MEMORY = 0.2 * GB
_INDEX_MEMORY = 1100.0  # bytes per station: 1024 of the index, the rest of a search's results
_FIELD_MEMORY = 88.0  # bytes per surveyed square metre: 20 a cell, and 8 of the coarse level
_FEATURE_MEMORY = 20.0  # bytes per square metre: 7 dimensions on cells of 2 m, spectra, a query's scores


def open_map(path: Path) -> tuple[BaseMap | None, Finding]:
    """Open a map, read all of it and compare its checksum; None if it cannot be used."""
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.basemap.file_format import VERSION

    try:
        base_map = BaseMap.load(path)
    except MapError as error:
        return None, from_error("map", error)
    text = f"{path}: format {VERSION}, {len(base_map)} stations, {len(base_map.points)} points, checksum holds"
    return base_map, Finding("ok", "map", text)


def map_findings(base_map: BaseMap, size: int, available: int | None) -> Iterator[Finding]:
    """Judge an open map whose file has ``size`` bytes, with ``available`` bytes of memory (None: unknown)."""
    yield Finding("ok", "map sha256", base_map.sha256)
    if not len(base_map):
        yield Finding("FAIL", "map stations", "none: nowhere to search", "build it again, from ground and walls")
    yield _features_finding(base_map)
    needed = node_memory(base_map)
    text = f"a node needs about {needed / GB:.1f} GB, and {size / GB:.2f} GB of page cache for the file"
    if available is not None and needed > available:
        remedy = f"{available / GB:.1f} GB are available: build with a larger --block-size, or cut the map"
        yield Finding("FAIL", "map memory", text, remedy)
    elif available is not None and needed + size > available:
        remedy = f"{available / GB:.1f} GB are available: searches will wait for the disk"
        yield Finding("warn", "map memory", text, remedy)
    else:
        yield Finding("ok", "map memory", text)


def _features_finding(base_map: BaseMap) -> Finding:
    missing = base_map.require_features("auto")
    if missing is not None:
        return replace(from_error("map features", missing), verdict="warn")
    if base_map.learned is None:
        return Finding("ok", "map features", "none: searches go by co-view descriptors")
    return Finding("ok", "map features", f"{base_map.learned.bytes / 1e6:.1f} MB, of the installed networks")


def node_memory(base_map: BaseMap) -> float:
    """Return a node's bytes: processes, the station index, the likelihood field, and a search."""
    surveyed = int((base_map.survey.values > 0).sum()) * base_map.config.block**2
    return MIN_MEMORY + len(base_map) * _INDEX_MEMORY + surveyed * _FIELD_MEMORY + _learned_memory(base_map)


def _learned_memory(base_map: BaseMap) -> float:
    """Return the bytes that learned features add: libraries, features, their spectra, and a query's scores.

    They fill the rectangle around the map, however little of it has points.
    """
    if base_map.require_features("auto") is not None or base_map.learned is None:
        return 0.0
    return _NETWORK_MEMORY + base_map.learned.box_area * _FEATURE_MEMORY
