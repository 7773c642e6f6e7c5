"""Loading of what a node is given: one map, or the names of several that are joined first."""

from __future__ import annotations

from pathlib import Path

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.joined.join_maps import joined_file
from coview_stream.basemap.joined.joined_names import SUFFIX, read_names
from coview_stream.basemap.signature import VerifyKey
from coview_stream.basemap.site.working_file import open_made


def load_map(path: Path, verify_key: VerifyKey | None = None) -> BaseMap:
    """Return a map.

    Args:
        path: as :meth:`BaseMap.load` takes it; or a file of names (:func:`write_names`), whose joined map is made
            first where it is not there.
        verify_key: has to have signed it, or each of several.

    Raises:
        As :meth:`BaseMap.load`; MapError: maps cannot be joined.
    """
    if path.suffix != SUFFIX:
        return BaseMap.load(path, verify_key=verify_key)
    maps = read_names(path)
    joined, _ = open_made(lambda: joined_file(maps, verify_key))
    return BaseMap.load(joined, check=False)
