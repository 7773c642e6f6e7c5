"""Working file of a site: the one ``.coview`` file that a node maps into memory, made once and kept in the cache."""

from __future__ import annotations

import hashlib
import logging
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from coview_stream.basemap import file_format
from coview_stream.basemap.likelihood_field import layers_arrays
from coview_stream.basemap.signature import VerifyKey
from coview_stream.basemap.site import cache
from coview_stream.basemap.site.assemble import assemble
from coview_stream.basemap.site.grid import Key
from coview_stream.basemap.site.manifest import Manifest
from coview_stream.basemap.site.part import read_part
from coview_stream.basemap.site.tile_store import TileStore
from coview_stream.errors import MapError

log = logging.getLogger("coview_stream.maps")

_CODE = 2
"""Counts changes of what is made of the same layers."""


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
    path = working_file(directory, verify_key, keys=keys)
    checked = cache.checked(path)
    try:
        loaded = file_format.open_file(path, check, checked=checked)
    except MapError as error:
        log.warning("%s; it is made again", error)
        path.unlink(missing_ok=True)
        path = working_file(directory, verify_key, keys=keys)
        loaded = file_format.open_file(path, check)
    if check and loaded.identity != checked:
        cache.remember_checked(path, loaded.identity)
    return path, loaded


def working_file(
    directory: Path,
    verify_key: VerifyKey | None = None,
    progress: bool | None = None,
    keys: Collection[Key] | None = None,
) -> Path:
    """Return the working file of a site, made now if it is not there: half a minute for a tenth of a km2.

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
    part = "" if keys is None else hashlib.sha256(repr(sorted(keys)).encode()).hexdigest()[:8]
    folder = cache.cache_folder()
    path = folder / f"{manifest.sha256[:40]}{part}.{_CODE}.coview"
    with cache.lock(path):
        if path.is_file():
            return path
        with _bar(f"{directory}: made ready for this machine", progress) as step:
            arrays, parameters = assemble(manifest, TileStore(directory), step, keys)
        file_format.save(path, arrays | layers_arrays(arrays), parameters)
        cache.evict(folder, keep=path)
    return path


@contextmanager
def _bar(title: str, show: bool | None) -> Iterator[Callable[[int, int], None]]:
    from tqdm import tqdm

    wanted = sys.stderr.isatty() if show is None else show
    with tqdm(desc=title, unit="step", disable=not wanted, leave=False) as bar:

        def step(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield step
