"""Names of several maps that are opened as one: a small file with the path of each, which is loaded like a map."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from coview_stream.basemap.site.cache import read_record, write_record
from coview_stream.errors import MapError

SUFFIX = ".joined"
_FORMAT = "coview-joined"


def write_names(maps: Sequence[tuple[str, Path]]) -> Path:
    """Write names and paths of maps, and return the file, one for each list.

    Raises:
        MapError: two have one name, or the cache cannot be written.
    """
    names = [name for name, _ in maps]
    for name, path in maps:
        if names.count(name) > 1:
            raise MapError(f"two maps are called {name}: name them, as in first={path}")
    rows = [[name, str(path.absolute())] for name, path in maps]
    name = hashlib.sha256(repr(rows).encode()).hexdigest()[:16] + SUFFIX
    return write_record(name, {"format": _FORMAT, "maps": rows})


def read_names(file: Path) -> list[tuple[str, Path]]:
    """Return the names and paths that a file has.

    Raises:
        MapError: it is something else.
    """
    try:
        data = read_record(file)
        if data["format"] != _FORMAT:
            raise ValueError("another format")
        return [(str(name), Path(str(path))) for name, path in data["maps"]]
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise MapError(f"{file}: names no maps ({error}); name the maps themselves again") from error
