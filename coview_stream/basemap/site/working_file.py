"""Working file of a site: the one ``.coview`` file that a node maps into memory, made once and kept in the cache."""

from __future__ import annotations

import hashlib
import logging
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from coview_stream.basemap import file_format
from coview_stream.basemap.signature import VerifyKey
from coview_stream.basemap.site.array_files import ArrayFiles
from coview_stream.basemap.site.assemble import assemble, layers
from coview_stream.basemap.site.earlier import VERSION, earlier_file, remember_file
from coview_stream.basemap.site.manifest import Key, Manifest, read_part
from coview_stream.basemap.site.store import (
    TileStore,
    cache_folder,
    checked,
    evict,
    hold,
    lock,
    remember_checked,
    remember_written,
)
from coview_stream.errors import MapError

log = logging.getLogger("coview_stream.maps")


def open_site(place: Path, check: bool = True, verify_key: VerifyKey | None = None) -> tuple[Path, file_format.Loaded]:
    """Return the working file of a site and what is in it; one that is damaged is made again.

    Args:
        place: directory of the site, or the file of a part of it.
        check: compare its content with its checksum, unless that has been done since it was written.
        verify_key: has to have signed the site.

    Raises:
        MapError: as :func:`working_file`.
    """
    directory, keys = (place, None) if place.is_dir() else read_part(place)
    return open_made(lambda: working_file(directory, verify_key, keys=keys), check)


def open_made(make: Callable[[], Path], check: bool = True) -> tuple[Path, file_format.Loaded]:
    """Return a file of the cache and what is in it; one that is damaged is made again.

    Args:
        make: makes it, if it is not there, and returns it.
        check: compare its content with its checksum, unless that has been done since it was written.

    Raises:
        MapError: as ``make``.
    """
    path = make()
    before = checked(path)
    try:
        loaded = file_format.open_file(path, check, checked=before, opened=hold)
    except MapError as error:
        log.warning("%s; it is made again", error)
        path.unlink(missing_ok=True)
        path = make()
        before = checked(path)
        loaded = file_format.open_file(path, check, checked=before, opened=hold)
    if check and loaded.identity != before:
        remember_checked(path, loaded.identity)
    return path, loaded


def working_file(
    directory: Path,
    verify_key: VerifyKey | None = None,
    progress: bool | None = None,
    keys: Collection[Key] | None = None,
) -> Path:
    """Return the working file of a site, made now if it is not there.

    That takes some seconds a tile, less where an earlier one of the site has the same tiles.

    Args:
        directory: of the site.
        verify_key: has to have signed it.
        progress: show a bar on stderr; None does on a terminal.
        keys: tiles that it is to hold; None for all.

    Raises:
        MapError: no site, a layer is missing or damaged, not signed with the key, or no room in the cache.
    """
    manifest = Manifest.load(directory)
    if verify_key is not None:
        manifest.check_signature(verify_key, str(directory))
    folder, path = cache_folder(), _path(manifest, keys)
    with lock(path):
        if path.is_file():
            remember_file(directory, path)
            return path
        with _bar(f"{directory}: made ready for this machine", progress) as step, ArrayFiles(folder) as into:
            earlier = earlier_file(directory)
            arrays, parameters = assemble(manifest, TileStore(directory), into, step, keys, earlier)
            file_format.save(path, arrays | layers(arrays, into), parameters)
        remember_written(path)
        remember_file(directory, path)
        evict(folder, path, directory)
    return path


def working_path(directory: Path, keys: Collection[Key] | None = None) -> Path:
    """Return where the working file of a site is or would be, or of some tiles; MapError where it is no site."""
    return _path(Manifest.load(directory), keys)


def _path(manifest: Manifest, keys: Collection[Key] | None) -> Path:
    part = "" if keys is None else hashlib.sha256(repr(sorted(keys)).encode()).hexdigest()[:8]
    return cache_folder() / f"{manifest.sha256[:40]}{part}.{VERSION}.coview"


@contextmanager
def _bar(title: str, show: bool | None) -> Iterator[Callable[[int, int], None]]:
    from tqdm import tqdm

    wanted = sys.stderr.isatty() if show is None else show
    with tqdm(desc=title, unit="step", disable=not wanted, leave=False) as bar:

        def step(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield step
