"""Sources of sites: where a manifest and layers come from. What they give is checked by who asked, never trusted."""

from __future__ import annotations

import http.client
import urllib.request
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

from coview_stream.basemap.site.manifest import FILE, MAX_MANIFEST
from coview_stream.basemap.site.tile_store import TileStore, layer_path
from coview_stream.clouds.http_file import open_web_file
from coview_stream.errors import CloudError, MapError, TransportError, require_library

_PIECE = 1 << 20


class SiteSource(Protocol):
    """Where a site is read from.

    Attributes:
        name: for messages.
    """

    name: str

    def manifest(self) -> bytes:
        """Return the manifest's bytes, whatever they are. TransportError: it cannot be had now."""
        ...

    def layer(self, sha256: str, size: int) -> bytes:
        """Return a layer's bytes, ``size`` + 1 at most, whatever they are. TransportError: it cannot be had now."""
        ...

    def close(self) -> None:
        """End connections."""
        ...


class DirectorySource:
    """A site's directory, on a disk or a network's file system."""

    def __init__(self, directory: Path) -> None:
        """Take the directory."""
        self.name = str(directory)
        self._directory, self._store = directory, TileStore(directory)

    def manifest(self) -> bytes:
        """Return the manifest's bytes."""
        return _read(self._directory / FILE, MAX_MANIFEST)

    def layer(self, sha256: str, size: int) -> bytes:
        """Return a layer's bytes."""
        return _read(self._store.path(sha256), size)

    def close(self) -> None:
        """Nothing is open."""


class WebSource:
    """A site's directory as any web server serves it: plain files below an address."""

    def __init__(self, address: str) -> None:
        """Take the directory's address."""
        self.name = address.rstrip("/")
        self._known: tuple[str, bytes] | None = None

    def manifest(self) -> bytes:
        """Return the manifest's bytes; they are not sent again while the server says that they are the same."""
        headers = {} if self._known is None else {"If-None-Match": self._known[0]}
        try:
            answer = open_web_file(urllib.request.Request(f"{self.name}/{FILE}", headers=headers))
        except CloudError as error:
            raise TransportError(str(error)) from error
        with answer:
            if answer.status == http.client.NOT_MODIFIED and self._known is not None:
                return self._known[1]
            raw = _body(answer, MAX_MANIFEST, f"{self.name}/{FILE}")
            tag = answer.headers.get("ETag")
        self._known = (tag, raw) if tag else None
        return raw

    def layer(self, sha256: str, size: int) -> bytes:
        """Return a layer's bytes."""
        address = f"{self.name}/{layer_path(sha256)}"
        try:
            with open_web_file(urllib.request.Request(address)) as answer:
                return _body(answer, size, address)
        except CloudError as error:
            raise TransportError(str(error)) from error

    def close(self) -> None:
        """Nothing is open."""


class ObjectStoreSource:
    """A site below a prefix of an object store: ``s3://bucket/prefix``, also ``gs://`` and ``az://``.

    Keys and regions come from the environment, as obstore reads it (``AWS_ACCESS_KEY_ID`` ...).
    """

    def __init__(self, address: str) -> None:
        """Take the prefix's address; DependencyError without obstore, TransportError where it names no store."""
        store: Any = require_library("obstore.store", "obstore>=0.6", "maps in object stores")
        self.name = address.rstrip("/")
        try:
            self._store = store.from_url(self.name)
        except Exception as error:
            raise TransportError(f"{self.name}: {_short(error)}; check the address and the credentials") from error

    def manifest(self) -> bytes:
        """Return the manifest's bytes."""
        return self._get(FILE, MAX_MANIFEST)

    def layer(self, sha256: str, size: int) -> bytes:
        """Return a layer's bytes."""
        return self._get(layer_path(sha256), size)

    def close(self) -> None:
        """Nothing is open."""

    def _get(self, path: str, limit: int) -> bytes:
        try:
            found = self._store.get(path)
            raw = bytearray()
            for piece in found.stream(min_chunk_size=_PIECE):
                raw += piece
                if len(raw) > limit:
                    break
        except Exception as error:  # obstore's are of many kinds
            raise TransportError(f"{self.name}/{path}: {_short(error)}") from error
        return bytes(raw[: limit + 1])


def is_site_address(name: object) -> bool:
    """Tell whether a name is the address of a site, not the path of a map."""
    return urlsplit(str(name)).scheme in ("zenoh", "http", "https", "s3", "gs", "az") and "://" in str(name)


def _read(path: Path, limit: int) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(limit + 1)
    except (OSError, MapError) as error:
        raise TransportError(f"{path}: cannot be read ({error})") from error


def _body(answer: Any, limit: int, address: str) -> bytes:
    raw = bytearray()
    try:
        while len(raw) <= limit and (piece := answer.read(min(_PIECE, limit + 1 - len(raw)))):
            raw += piece
    except OSError as error:
        raise TransportError(f"{address}: broke off ({error})") from error
    return bytes(raw)


def _short(error: BaseException) -> str:
    return " ".join(str(error).split())[:160] or type(error).__name__
