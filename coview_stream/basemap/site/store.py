"""Store of a site's layers in files named by their sha256, and the cache of working files and mirrors.

The cache is ``$COVIEW_CACHE``, else ``coview-stream`` in the user's cache folder. The least recently used files are
deleted to keep it within ``$COVIEW_CACHE_GB`` (20). Its files are trusted, even with ``--verify-key``, because no other
user reaches them: a folder that others may write or replace is refused; a folder that they may read is closed to them,
and the files that they could write until then are deleted.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
import re
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from coview_kernels.runtime import is_private
from coview_stream.basemap.signature import FileIdentity, file_identity, open_plain
from coview_stream.clouds.atomic_file import atomic_file, atomic_path
from coview_stream.errors import ConfigError, MapError

SHA256 = re.compile(r"[0-9a-f]{64}")
_FOLDER = "layers"

_MAX_RECORD = 1 << 24  # bytes
_MARK = ".checked"  # suffix of the record of a file that has been compared with its checksum


def layer_path(sha256: str) -> str:
    """Return the path of a layer relative to its site's directory; MapError if ``sha256`` is not a hash."""
    if not SHA256.fullmatch(sha256):
        raise MapError(f"{sha256[:80]!r} is not a sha256 of a layer")
    return f"{_FOLDER}/{sha256[:2]}/{sha256}"


class TileStore:
    """Layers in the folder ``layers`` of a site's directory or of a mirror.

    Attributes:
        folder: folder of the files, with subfolders by the first two digits of their names.
    """

    def __init__(self, directory: Path) -> None:
        self.folder = directory / _FOLDER

    def path(self, sha256: str) -> Path:
        """Return the file of a layer, which need not exist; MapError if ``sha256`` is not a hash."""
        return self.folder.parent / layer_path(sha256)

    def put(self, content: bytes) -> str:
        """Write a layer, unless it exists, and return its hash; MapError if it cannot be written."""
        sha256 = hashlib.sha256(content).hexdigest()
        path = self.path(sha256)
        if self.holds(sha256, len(content)):
            return sha256
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_file(path, sync=True) as file:
                file.write(content)
        except OSError as error:
            raise MapError(
                f"{path}: cannot be written ({error.strerror}); make room or choose another place"
            ) from error
        return sha256

    def get(self, sha256: str, size: int) -> bytes:
        """Return a layer's bytes; MapError if the file is missing, truncated or changed."""
        path = self.path(sha256)
        try:
            with open_plain(path) as file:
                content = file.read(size + 1)
        except OSError as error:
            raise MapError(f"{path}: cannot be read ({error.strerror}); fetch or build the site again") from error
        if len(content) != size or hashlib.sha256(content).hexdigest() != sha256:
            raise MapError(f"{path}: is not what its name says: damaged or swapped; fetch or build the site again")
        return content

    def holds(self, sha256: str, size: int) -> bool:
        """Return whether a layer exists with the right length."""
        try:
            return self.path(sha256).stat().st_size == size
        except OSError:
            return False

    def is_whole(self, sha256: str, size: int) -> bool:
        """Return whether a layer exists with the right content."""
        try:
            self.get(sha256, size)
        except MapError:
            return False
        return True

    def prune(self, hashes: Collection[str]) -> None:
        """Delete all layers except these."""
        for path in self.folder.glob("[0-9a-f][0-9a-f]/*"):
            if SHA256.fullmatch(path.name) and path.name not in hashes:
                path.unlink(missing_ok=True)


_HASH = 40 * "[0-9a-f]"
_OURS = (f"{_HASH}*.coview", f"joined-{_HASH}*.coview", "parts/*", "sites/[0-9a-f]*/**/*")
"""Files of the cache, by pattern."""


def cache_folder() -> Path:
    """Return the cache folder, created if it does not exist; MapError unless it is its user's alone."""
    named = os.environ.get("COVIEW_CACHE")
    base = os.environ.get("XDG_CACHE_HOME") or str(Path("~/.cache").expanduser())
    folder = Path(named) if named else Path(base) / "coview-stream"
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if hasattr(os, "getuid"):
            state = folder.stat()
            if state.st_uid != os.getuid():
                raise MapError(f"{folder}: belongs to another user; name a folder of your own in COVIEW_CACHE")
            if state.st_mode & 0o022 or not is_private(folder):
                raise MapError(
                    f"{folder}: others may write to it, or to a folder that it is in, so its maps may be theirs; "
                    "delete it and make it again with 'mkdir -m 700', or name another folder in COVIEW_CACHE"
                )
            if state.st_mode & 0o077:
                folder.chmod(0o700)
                # the umask may have let others write these; match by pattern, as the folder may hold other files too
                for path in itertools.chain.from_iterable(folder.glob(names) for names in _OURS):
                    if path.is_file() and path.stat().st_mode & 0o022:
                        path.unlink()
    except OSError as error:
        raise MapError(f"{folder}: cannot be used ({error.strerror}); name a folder in COVIEW_CACHE") from error
    return folder


def write_record(name: str, data: object) -> Path:
    """Write plain data into a small file of the cache, ``parts/NAME``, and return its path; MapError if that fails."""
    path = cache_folder() / "parts" / name
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as file:
            file.write(json.dumps(data).encode())
    except OSError as error:
        raise MapError(f"{path}: cannot be written ({error.strerror})") from error
    return path


def read_record(path: Path) -> Any:
    """Return the data of :func:`write_record`; OSError or ValueError if there are none."""
    with path.open("rb") as file:
        return json.loads(file.read(_MAX_RECORD))


def cache_bound() -> float:
    """Return the bytes that the cache may hold; ConfigError if ``$COVIEW_CACHE_GB`` is not a size."""
    text = os.environ.get("COVIEW_CACHE_GB", "20")
    try:
        bound = float(text)
    except ValueError:
        bound = -1.0
    if not bound > 0:
        raise ConfigError(f"COVIEW_CACHE_GB={text}: is not a size in GB")
    return bound * 1e9


def evict(folder: Path, *keep: Path) -> None:
    """Delete the least recently used ``.coview`` files and mirrors until the cache is within its bound.

    Files that a process holds (:func:`hold`), and ``keep``, stay.
    """
    bound, files = cache_bound(), []
    for path in (*folder.glob("*.coview"), *folder.glob("sites/*")):
        with contextlib.suppress(OSError):  # another process may delete it meanwhile
            parts = [path, *path.rglob("*")]  # a mirror with its files
            used = [at.stat().st_mtime for at in (path, path.with_suffix(_MARK)) if at.exists()]
            files.append((max(used, default=0.0), sum(part.stat().st_size for part in parts if part.is_file()), path))
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= bound:
            break
        if path in keep or (path.is_file() and _is_held(path)):
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
            path.with_suffix(_MARK).unlink(missing_ok=True)
        total -= size


def _is_held(path: Path) -> bool:
    try:
        import fcntl

        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except (ImportError, OSError):
        pass
    return False


def hold(file: BinaryIO) -> None:
    """Lock an open file against :func:`evict` while it, or a mapping of it, is open in any process."""
    with contextlib.suppress(ImportError, OSError):
        import fcntl

        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)


def checked(path: Path) -> FileIdentity | None:
    """Return the identity that a cached file had when last compared with its checksum, None if it never was.

    Also marks the file as just used.
    """
    mark = path.with_suffix(_MARK)
    try:
        os.utime(mark)
        return FileIdentity(*map(int, json.loads(mark.read_text())))
    except (OSError, ValueError, TypeError):
        return None


def remember_checked(path: Path, state: FileIdentity) -> None:
    """Record that the content of a cached file has been compared with its checksum."""
    with contextlib.suppress(OSError), atomic_path(path.with_suffix(_MARK)) as part:
        part.write_text(json.dumps(list(state)))


def remember_written(path: Path) -> None:
    """Record that a cached file has just been written, with the checksum of its content."""
    with path.open("rb") as file:
        remember_checked(path, file_identity(file))


@contextmanager
def lock(path: Path) -> Iterator[None]:
    """Let one process at a time write a file; on systems without locks several may write the same file."""
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
