"""Earlier working file of a site: what was made of tiles that are still the same is taken from it, not made again.

A tile's field and codes are made of its stations and of the clouds on it and around it. A working file names, for each
of its tiles, the hash of these layers and the settings, and the rows that were made of them. Codes of other tiles are
then made in the terms of the earlier file; they find the same stations (tests/basemap/site/test_earlier.py).
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coview_kernels import StationCodes
from coview_kernels.arrays import I16
from coview_kernels.mapped import release
from coview_stream.basemap import file_format
from coview_stream.basemap.file_format import Arrays
from coview_stream.basemap.likelihood_field import FIELD_ARRAYS
from coview_stream.basemap.site.manifest import Key, Manifest
from coview_stream.basemap.site.store import cache_folder, checked, read_record, write_record
from coview_stream.basemap.site.tile_clouds import TileClouds
from coview_stream.basemap.station_index import CODES, StationIndex
from coview_stream.config import Channel, config_of_map
from coview_stream.errors import MapError

log = logging.getLogger("coview_stream.maps")

VERSION = 3
"""Counts changes of what is made of the same layers."""

PARAMETER = "made_tiles"
"""Parameter of a working file: state, first station, stations, first row of the field, its rows; for each tile."""


class Earlier:
    """What of an earlier working file can be taken; of none, nothing."""

    def __init__(self, states: Mapping[Key, str], path: Path | None = None, channels: Sequence[Channel] = ()) -> None:
        """Open a file; one that cannot be read, or has another form, is as good as none.

        Args:
            states: of the tiles that are to be made now, by :func:`states_of`.
            path: the file.
            channels: of the descriptors.
        """
        self._arrays: Arrays = {}
        self._index: StationIndex | None = None
        self._spans: dict[Key, tuple[slice, slice]] = {}
        if path is None:
            return
        try:
            loaded = file_format.open_file(path, checked=checked(path))
            known = {
                str(state): (slice(first, first + count), slice(row, row + rows))
                for state, first, count, row, rows in loaded.parameters.get(PARAMETER, ())
            }
        except (MapError, ValueError, TypeError) as error:
            log.info("%s: nothing is taken from it (%s)", path, error)
            return
        self._arrays = loaded.arrays
        self._index = StationIndex.from_arrays(loaded.arrays, channels)
        if self._index is not None and all(name in loaded.arrays for name in FIELD_ARRAYS):
            self._spans = {key: known[state] for key, state in states.items() if state in known}

    def __len__(self) -> int:
        """Return how many of the tiles it has."""
        return len(self._spans)

    def stations(self, key: Key) -> slice | None:
        """Return where the stations of a tile are, None if they are not there."""
        return self._spans[key][0] if key in self._spans else None

    def field(self, key: Key) -> Arrays | None:
        """Return the field of a tile, None if it is not there."""
        if key not in self._spans:
            return None
        return {name: self._arrays[name][self._spans[key][1]] for name in FIELD_ARRAYS}

    def codes(self, name: str, part: slice) -> I16:
        """Return some codes of a tier."""
        return np.asarray(self._arrays[name][part])

    def tiers(self, into: Sequence[I16]) -> list[StationCodes] | None:
        """Return codes in the file's terms that are to be filled in; None if none of it are taken.

        None are where they were learned from fewer stations than codes of all these would be.
        """
        if self._index is None or not self._spans:
            return None
        if len(self._index) < min(len(into[0]), StationCodes.LEARNED):
            return None
        tiers = self._index.tiers
        return [
            StationCodes(codes, each.basis, each.step, each.norm.copy(), each.sectors)
            for codes, each in zip(into, tiers, strict=True)
        ]

    def release(self) -> None:
        """Let the memory go that reading takes."""
        for name in (*CODES, *FIELD_ARRAYS):
            if name in self._arrays:
                release(self._arrays[name])


def states_of(manifest: Manifest, clouds: TileClouds) -> dict[Key, str]:
    """Return the hash of what each tile is made of: its stations, the clouds on it and around it, the settings."""
    settings = [VERSION, manifest.origin, manifest.tile, repr(config_of_map(manifest.parameters["config"]))]
    found = {}
    for entry in clouds.entries:
        key = entry.column, entry.row
        around = [[*other, clouds.seen[other]] for other in clouds.grid.around(key) if other in clouds.seen]
        text = json.dumps([settings, key, entry.layers["stations"].sha256, around])
        found[key] = hashlib.sha256(text.encode()).hexdigest()[:32]
    return found


def earlier_file(directory: Path) -> Path | None:
    """Return the working file that was made last of a site's directory, if it is still there."""
    try:
        path = cache_folder() / str(read_record(cache_folder() / "parts" / _record_name(directory)))
    except (OSError, ValueError):
        return None
    return path if path.parent == cache_folder() and path.is_file() else None


def remember_file(directory: Path, path: Path) -> None:
    """Keep which working file was made last of a site's directory."""
    write_record(_record_name(directory), path.name)


def _record_name(directory: Path) -> str:
    return hashlib.sha256(str(directory.resolve()).encode()).hexdigest()[:16] + ".last"


def record(states: Mapping[Key, str], stations: Mapping[Key, int], rows: Mapping[Key, int]) -> list[list[Any]]:
    """Return :data:`PARAMETER` of tiles whose stations and rows of the field follow one another."""
    found: list[list[Any]] = []
    first = row = 0
    for key, state in states.items():
        found.append([state, first, stations[key], row, rows[key]])
        first, row = first + stations[key], row + rows[key]
    return found
