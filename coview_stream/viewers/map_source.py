"""Map sources: where the view of a map comes from, by the name of a robot that is served on it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from coview_stream.basemap.summary import MAX_WIRE_BYTES, MapView
from coview_stream.stream.transport.transport import Transport

_TIMEOUT = 10.0  # seconds of a question, set by hand: the first makes the node thin its map

MapSource = Callable[[str], MapView]
"""Returns the map that a robot is served on; what goes wrong is a CoViewError."""


def asked_of_node(transport: Transport, base: str) -> MapSource:
    """Return a map source that asks the node of a robot."""

    def ask(robot: str) -> MapView:
        key = f"{base}/{robot}/rpc/map_view"
        return MapView.from_json(transport.query(key, timeout=_TIMEOUT, max_bytes=MAX_WIRE_BYTES))

    return ask


def read_from_files(files: Mapping[str, Path], sha256: Callable[[], str]) -> MapSource:
    """Return a map source that reads a node's files, by the hash of the map that the node serves: ``sha256()``."""
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.errors import MapError

    def load(robot: str) -> MapView:
        served = sha256()
        base_map = BaseMap.load(files[served], check=False)  # the node has compared it when it opened the map
        if base_map.sha256 != served:
            raise MapError(f"{files[served]}: the file is of another map than the one that is served")
        return MapView.of(base_map)

    return load
