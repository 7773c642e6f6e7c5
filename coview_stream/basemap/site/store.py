"""Cache of what is made of sites or fetched: ``$COVIEW_CACHE``, else ``coview-stream`` in the user's cache folder.

Of files that have not been used for longest as many are deleted as keep it within ``$COVIEW_CACHE_GB`` (20). What is in
it is trusted as far as the user's other files are: it lies in a folder that nobody else can write.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from coview_stream.basemap.signature import FileIdentity, file_identity
from coview_stream.clouds.atomic_file import atomic_file, atomic_path
from coview_stream.errors import ConfigError, MapError

SHA256 = re.compile(r"[0-9a-f]{64}")
_FOLDER = "layers"


def layer_path(sha256: str) -> str:
    """Return the place of a layer below a site's directory; MapError where ``sha256`` is no hash."""
    if not SHA256.fullmatch(sha256):
        raise MapError(f"{sha256[:80]!r} is no sha256 of a layer")
    return f"{_FOLDER}/{sha256[:2]}/{sha256}"


class TileStore:
    """Layers in the folder ``layers`` of a site's directory, or of a cache.

    Attributes:
        folder: of the files; they lie in folders by the first two digits of their names.
    """

    def __init__(self, directory: Path) -> None:
        self.folder = directory / _FOLDER

    def path(self, sha256: str) -> Path:
        """Return the file of a hash, which need not be there.

        Raises:
            MapError: it is no hash.
        """
        return self.folder.parent / layer_path(sha256)

    def put(self, content: bytes) -> str:
        """Write a layer, unless it is there, and return its hash.

        Raises:
            MapError: it cannot be written.
        """
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
        """Return a layer whose bytes are what they should be.

        Raises:
            MapError: it is missing, cut off or changed; the file is named.
        """
        path = self.path(sha256)
        try:
            with path.open("rb") as file:
                content = file.read(size + 1)
        except OSError as error:
            raise MapError(f"{path}: cannot be read ({error.strerror}); fetch or build the site again") from error
        if len(content) != size or hashlib.sha256(content).hexdigest() != sha256:
            raise MapError(f"{path}: is not what its name says: damaged or swapped; fetch or build the site again")
        return content

    def holds(self, sha256: str, size: int) -> bool:
        """Tell whether a layer is there, by its length alone."""
        try:
            return self.path(sha256).stat().st_size == size
        except OSError:
            return False

    def is_whole(self, sha256: str, size: int) -> bool:
        """Tell whether a layer is there and its bytes are what they should be."""
        try:
            self.get(sha256, size)
        except MapError:
            return False
        return True

    def prune(self, kept: Collection[str]) -> int:
        """Delete all layers but some, and return how many bytes that gave back."""
        freed = 0
        for path in self.folder.glob("[0-9a-f][0-9a-f]/*"):
            if SHA256.fullmatch(path.name) and path.name not in kept:
                freed += path.stat().st_size
                path.unlink(missing_ok=True)
        return freed


_GB = 1e9
_MAX_GB = 20.0  # set by hand
_MAX_RECORD = 1 << 24  # bytes
_MARK = ".checked"  # suffix of the small file beside one that has been compared with its checksum


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


def write_record(name: str, data: object) -> Path:
    """Write plain data into a small file of the cache, ``parts/NAME``, and return it; MapError where that fails."""
    path = cache_folder() / "parts" / name
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as file:
            file.write(json.dumps(data).encode())
    except OSError as error:
        raise MapError(f"{path}: cannot be written ({error.strerror})") from error
    return path


def read_record(path: Path) -> Any:
    """Return what :func:`write_record` has written; OSError or ValueError for anything else."""
    with path.open("rb") as file:
        return json.loads(file.read(_MAX_RECORD))


def evict(folder: Path, *keep: Path) -> None:
    """Delete what has not been used for longest, working files and mirrors, until the cache is within its bound.

    Files that a process holds (:func:`hold`) and those to keep stay.
    """
    found = []
    for path in (*folder.glob("*.coview"), *folder.glob("sites/*")):
        with contextlib.suppress(OSError):
            found.append((_last_used(path), _size(path), path))
    total, bound = sum(size for _, size, _ in found), _bound()
    for _, size, path in sorted(found):
        if total <= bound:
            break
        if path not in keep and not _is_held(path):
            _remove(path)
            total -= size


def hold(file: BinaryIO) -> None:
    """Have an open file of the cache stay there as long as it, or what is mapped of it, is open in any process."""
    with contextlib.suppress(ImportError, OSError):
        import fcntl

        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)


def _is_held(path: Path) -> bool:
    if path.is_dir():
        return False
    try:
        import fcntl

        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except (ImportError, OSError):
        return False
    return False


def checked(path: Path) -> FileIdentity | None:
    """Return what a file of the cache was when its content was last compared with its checksum; None if it never was.

    It counts as used now.
    """
    mark = path.with_suffix(_MARK)
    try:
        os.utime(mark)
        return FileIdentity(*map(int, json.loads(mark.read_text())))
    except (OSError, ValueError, TypeError):
        return None


def remember_checked(path: Path, state: FileIdentity) -> None:
    """Keep that the content of a file of the cache has been compared with its checksum."""
    with contextlib.suppress(OSError), atomic_path(path.with_suffix(_MARK)) as part:
        part.write_text(json.dumps(list(state)))


def remember_written(path: Path) -> None:
    """Keep that a file of the cache has just been written with the checksum of its content."""
    with path.open("rb") as file:
        remember_checked(path, file_identity(file))


def _last_used(path: Path) -> float:
    times = [path.stat().st_mtime]
    with contextlib.suppress(OSError):
        times.append(path.with_suffix(_MARK).stat().st_mtime)
    return max(times)


def _size(path: Path) -> int:
    if path.is_dir():
        return sum(each.stat().st_size for each in path.rglob("*") if each.is_file())
    return path.stat().st_size


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
        path.with_suffix(_MARK).unlink(missing_ok=True)


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
def lock(path: Path) -> Iterator[None]:
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
