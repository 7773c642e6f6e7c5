"""Store of layers: files named by the sha256 of their content, so that none is ever changed."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection
from pathlib import Path

from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.errors import MapError

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
