"""Answers of a node to those who want to look at its map: the view of it, made when it is first asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.summary import POINTS_ON_WIRE, MapView
from coview_stream.errors import MapError


class MapViewAnswer:
    """Answer to ``rpc/map_view``: :meth:`~coview_stream.basemap.summary.MapView.to_json` of the map that is served.

    Args:
        files: of the maps that the node has opened, by their hashes.
        sha256: returns the hash of the map that is served.
    """

    def __init__(self, files: Mapping[str, Path], sha256: Callable[[], str]) -> None:
        self._files = files
        self._sha256 = sha256
        self._made: tuple[str, dict[str, Any]] | None = None

    def __call__(self, parameters: dict[str, str]) -> dict[str, Any]:
        """Return the view; it is made once for each map.

        Raises:
            MapError: the file cannot be read, or is of another map than the one that is served.
        """
        served = self._sha256()
        if self._made is None or self._made[0] != served:
            path = self._files[served]
            base_map = BaseMap.load(path, check=False)  # the node has compared it when it opened the map
            if base_map.sha256 != served:
                raise MapError(f"{path}: the file is of another map than the one that is served")
            self._made = served, MapView.of(base_map, POINTS_ON_WIRE).to_json()
        return self._made[1]
