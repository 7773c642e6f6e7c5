"""Working file of a site: the one ``.coview`` file that a node maps into memory, made once and kept in a cache.

The cache is ``$COVIEW_CACHE``, by default ``coview-stream`` in the user's cache folder; of files that have not been
used for longest as many are deleted as keep it within ``$COVIEW_CACHE_GB`` (20). What is in it is trusted as far as the
user's other files are: it lies in a folder that nobody else can write.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from coview_stream.basemap import file_format
from coview_stream.basemap.signature import VerifyKey
from coview_stream.basemap.site.assemble import assemble
from coview_stream.basemap.site.grid import Key
from coview_stream.basemap.site.manifest import Manifest
from coview_stream.basemap.site.tile_store import TileStore
from coview_stream.errors import ConfigError, MapError

_CODE = 1
"""Counts changes of what is made of the same layers."""

_GB = 1e9
_MAX_GB = 20.0  # set by hand


def cache_folder() -> Path:
    """Return the folder of the cache, made if need be, which nobody else may write."""
    named = os.environ.get("COVIEW_CACHE")
    base = os.environ.get("XDG_CACHE_HOME") or str(Path("~/.cache").expanduser())
    folder = Path(named) if named else Path(base) / "coview-stream"
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if hasattr(os, "getuid") and folder.stat().st_uid != os.getuid():
            raise MapError(f"{folder}: belongs to another user; name a folder of your own in COVIEW_CACHE")
    except OSError as error:
        raise MapError(f"{folder}: cannot be used ({error.strerror}); name a folder in COVIEW_CACHE") from error
    return folder


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
    with _lock(path):
        if path.is_file():
            with contextlib.suppress(OSError):
                os.utime(path)  # the newest is used last
            return path
        with _bar(f"{directory}: made ready for this machine", progress) as step:
            arrays, parameters = assemble(manifest, TileStore(directory), step, keys)
        file_format.save(path, arrays, parameters)
        evict(folder, keep=path)
    return path


def evict(folder: Path, keep: Path | None = None) -> None:
    """Delete what has not been used for longest, working files and mirrors, until the cache is within its bound."""
    found = []
    for path in (*folder.glob("*.coview"), *folder.glob("sites/*")):
        with contextlib.suppress(OSError):
            found.append((path.stat().st_mtime, _size(path), path))
    total, bound = sum(size for _, size, _ in found), _bound()
    for _, size, path in sorted(found):
        if total <= bound:
            break
        if path != keep:
            _remove(path)  # who has mapped it keeps it until it ends
            total -= size


def _size(path: Path) -> int:
    if path.is_dir():
        return sum(each.stat().st_size for each in path.rglob("*") if each.is_file())
    return path.stat().st_size


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _bound() -> float:
    text = os.environ.get("COVIEW_CACHE_GB", str(_MAX_GB))
    try:
        bound = float(text)
    except ValueError:
        bound = -1.0
    if not bound > 0:
        raise ConfigError(f"COVIEW_CACHE_GB={text}: is no size in GB")
    return bound * _GB


@contextmanager
def _lock(path: Path) -> Iterator[None]:
    """Let one process make a file at a time; where the system has no locks, several may make the same."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    with path.with_suffix(".lock").open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        try:
            yield
        finally:
            fcntl.flock(file, fcntl.LOCK_UN)


@contextmanager
def _bar(title: str, show: bool | None) -> Iterator[Callable[[int, int], None]]:
    from tqdm import tqdm

    wanted = sys.stderr.isatty() if show is None else show
    with tqdm(desc=title, unit="step", disable=not wanted, leave=False) as bar:

        def step(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield step
