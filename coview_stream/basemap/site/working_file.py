"""Cache files that nodes map into memory: the working file of a site, and the layers of a map's field."""

from __future__ import annotations

import contextlib
import hashlib
import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path

from coview_stream.basemap.file_format import Arrays, Loaded, check_arrays, open_file, save
from coview_stream.basemap.likelihood_field import FIELD_ARRAYS, LAYERS
from coview_stream.basemap.map_arrays import EarlierMap
from coview_stream.basemap.signature import VerifyKey
from coview_stream.basemap.site.array_files import ArrayFiles
from coview_stream.basemap.site.assemble import PARAMETER, VERSION, assemble, field_layers
from coview_stream.basemap.site.manifest import OPENED, Manifest
from coview_stream.basemap.site.site_grid import read_part
from coview_stream.basemap.site.store import (
    TileStore,
    cache_folder,
    checked,
    evict,
    hold,
    lock,
    read_record,
    remember_checked,
    remember_written,
    write_record,
)
from coview_stream.basemap.tiles import Key
from coview_stream.clouds.progress import progress_bar
from coview_stream.config import Channel, config_of_map
from coview_stream.errors import CoViewError, MapError, warn

log = logging.getLogger("coview_stream.maps")


def open_site(place: Path, check: bool = True, verify_key: VerifyKey | None = None) -> tuple[Path, Loaded]:
    """Return the working file of a site, or of the part that a file names, and its content; rebuild a damaged one.

    ``check`` compares the content with its checksum, unless that has been done since it was written.
    """
    directory, keys = (place, None) if place.is_dir() else read_part(place)
    return open_made(lambda: working_file(directory, verify_key, keys=keys), check)


def open_made(make: Callable[[], Path], check: bool = True) -> tuple[Path, Loaded]:
    """Return the cached file that ``make`` returns or writes, and its content; rebuild a damaged one."""
    path = make()
    before = checked(path)
    try:
        loaded = open_file(path, check, checked=before, opened=hold)
    except MapError as error:
        log.warning("%s; it is made again", error)
        path.unlink(missing_ok=True)
        path = make()
        before = checked(path)
        loaded = open_file(path, check, checked=before, opened=hold)
    if check and loaded.identity != before:
        remember_checked(path, loaded.identity)
    return path, loaded


def working_file(
    directory: Path,
    verify_key: VerifyKey | None = None,
    progress: bool | None = None,
    keys: Collection[Key] | None = None,
) -> Path:
    """Return the working file of a site, or of some tiles; write it, some seconds a tile, if it does not exist.

    Unchanged tiles are copied from the earlier working file. ``progress`` None shows a bar on a terminal. If a mirror's
    state gives no map, the state that was opened last is used, with a warning.

    Raises:
        MapError: no site, a layer is missing or damaged, not signed with the key, or no room in the cache.
    """
    manifest = Manifest.load(directory, key=verify_key)
    if directory.resolve().parent != (cache_folder() / "sites").resolve():
        return _written(directory, manifest, progress, keys)
    opened = None
    with contextlib.suppress(MapError):  # none yet
        opened = Manifest.load(directory, OPENED, verify_key)
    try:
        path = _written(directory, manifest, progress, keys)
    except MapError as error:
        if opened is None or opened == manifest:
            raise
        warn(f"{error}; going on with the map that was opened before, manifest {opened.sha256[:12]}")
        return _written(directory, opened, progress, keys)
    if opened != manifest:
        manifest.save(directory, OPENED)
    return path


def _written(directory: Path, manifest: Manifest, progress: bool | None, keys: Collection[Key] | None) -> Path:
    folder, path = cache_folder(), working_path(manifest, keys)
    with lock(path):
        if path.is_file():
            write_record(_record_name(directory), path.name)
            return path

        config = config_of_map(manifest.parameters["config"])
        earlier = partial(_open_earlier, earlier_file(directory), config.descriptor.channels)
        with (
            progress_bar(f"{directory}: made ready for this machine", progress, "step") as step,
            ArrayFiles(folder) as into,
        ):
            arrays, parameters = assemble(manifest, TileStore(directory), into, step, keys, earlier)
            check_arrays(arrays, config, points=False)  # their tiles bound the points
            save(path, arrays | field_layers(arrays, into), parameters)
        remember_written(path)
        write_record(_record_name(directory), path.name)
        evict(folder, path, directory)
    return path


def with_shared_layers(arrays: Arrays, sha256: str) -> Arrays:
    """Return a map's arrays with the layers of its field mapped from one cache file for all processes.

    A site's working file already holds its layers. If the cache cannot be used they are left out, and built in memory.
    """
    if f"{LAYERS}table" not in arrays and FIELD_ARRAYS[0] in arrays:
        with contextlib.suppress(CoViewError, OSError):
            return arrays | open_made(lambda: _layers_file(arrays, sha256))[1].arrays
    return arrays


def _layers_file(arrays: Arrays, sha256: str) -> Path:
    folder = cache_folder()
    path = folder / f"{sha256[:40]}.field.{VERSION}.coview"
    with lock(path):
        if not path.is_file():
            with ArrayFiles(folder) as into:
                save(path, field_layers(arrays, into), {})
            remember_written(path)
            evict(folder, path)
    return path


def earlier_file(directory: Path) -> Path | None:
    """Return the last used working file of a site, if it still exists."""
    try:
        path = cache_folder() / str(read_record(cache_folder() / "parts" / _record_name(directory)))
    except (OSError, ValueError):
        return None
    return path if path.parent == cache_folder() and path.is_file() else None


def _open_earlier(path: Path | None, channels: Sequence[Channel], states: Mapping[Key, str]) -> EarlierMap:
    """Open an earlier working file; an unreadable file, or one of another form, counts as none."""
    if path is None:
        return EarlierMap()
    try:
        loaded = open_file(path, checked=checked(path))
        table = {
            str(state): (slice(first, first + count), slice(row, row + rows))
            for state, first, count, row, rows in loaded.parameters.get(PARAMETER, ())
        }
    except (MapError, ValueError, TypeError) as error:
        log.info("%s: nothing is taken from it (%s)", path, error)
        return EarlierMap()
    spans = {key: table[state] for key, state in states.items() if state in table}
    log.info("%s: %d of %d tiles are copied from it", path, len(spans), len(states))
    return EarlierMap(loaded.arrays, spans, channels)


def _record_name(directory: Path) -> str:
    return hashlib.sha256(str(directory.resolve()).encode()).hexdigest()[:16] + ".last"


def working_path(manifest: Manifest, keys: Collection[Key] | None = None) -> Path:
    """Return the path of a site's working file, which need not exist."""
    part = "" if keys is None else hashlib.sha256(repr(sorted(keys)).encode()).hexdigest()[:8]
    return cache_folder() / f"{manifest.sha256[:40]}{part}.{VERSION}.coview"
