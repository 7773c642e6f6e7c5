"""Working file of a site: the one ``.coview`` file that a node maps into memory, made once and kept in the cache."""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from coview_stream.basemap import file_format
from coview_stream.basemap.signature import VerifyKey
from coview_stream.basemap.site.assemble import assemble
from coview_stream.basemap.site.cache import cache_folder, evict, lock
from coview_stream.basemap.site.grid import Key
from coview_stream.basemap.site.manifest import Manifest
from coview_stream.basemap.site.tile_store import TileStore

_CODE = 1
"""Counts changes of what is made of the same layers."""


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
    folder = cache_folder()
    path = folder / f"{manifest.sha256[:40]}{part}.{_CODE}.coview"
    with lock(path):
        if path.is_file():
            with contextlib.suppress(OSError):
                os.utime(path)  # the newest is used last
            return path
        with _bar(f"{directory}: made ready for this machine", progress) as step:
            arrays, parameters = assemble(manifest, TileStore(directory), step, keys)
        file_format.save(path, arrays, parameters)
        evict(folder, keep=path)
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
