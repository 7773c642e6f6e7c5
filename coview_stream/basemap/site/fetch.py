"""Remote sources of sites (web server, object store, network disk), and their mirrors in the cache."""

from __future__ import annotations

import contextlib
import hashlib
import http.client
import logging
import os
import time
import urllib.request
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

from coview_stream.basemap.signature import VerifyKey
from coview_stream.basemap.site.manifest import (
    FILE,
    MAX_MANIFEST,
    OPENED,
    LayerEntry,
    Manifest,
    TileEntry,
    is_site,
    read_manifest,
    write_manifest,
)
from coview_stream.basemap.site.site_grid import Around, part_file
from coview_stream.basemap.site.store import TileStore, cache_bound, cache_folder, evict, layer_path
from coview_stream.clouds.fetch import open_web_file
from coview_stream.clouds.progress import Progress
from coview_stream.errors import CloudError, CoViewError, MapError, TransportError, require_library, warn

_PIECE = 1 << 20  # bytes read at a time
_PATIENCE, _SLOWEST = 30.0, 10_000.0  # seconds an answer may take, least bytes per second of one that takes longer

log = logging.getLogger("coview_stream.maps")
_TRIES, _WAIT = 3, 0.5  # tries for a layer, seconds before the third; half of them before the second


class SiteSource(Protocol):
    """Source of a site's bytes, which are untrusted; ``name`` is for messages."""

    name: str

    def manifest(self) -> bytes:
        """Return the manifest's bytes. TransportError: they cannot be fetched now."""

    def layer(self, sha256: str, size: int) -> bytes:
        """Return a layer's bytes, ``size`` + 1 at most. TransportError: they cannot be fetched now."""

    def close(self) -> None:
        """Close connections, if any are open."""
        return


class WebSource(SiteSource):
    """A site's directory on any web server: plain files below an address."""

    def __init__(self, address: str) -> None:
        self.name = address.rstrip("/")
        self._known: tuple[str, bytes] | None = None

    def manifest(self) -> bytes:
        """Return the manifest's bytes, which the server sends again only if they have changed."""
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


class ObjectStoreSource(SiteSource):
    """A site below a prefix of an object store: ``s3://bucket/prefix``, also ``gs://`` and ``az://``.

    Keys and regions come from the environment, as obstore reads it (``AWS_ACCESS_KEY_ID`` ...).
    """

    def __init__(self, address: str) -> None:
        # DependencyError without obstore, TransportError if the address names no store
        store: Any = require_library("obstore.store", "obstore>=0.6", "maps in object stores")
        self.name = address.rstrip("/")
        try:
            self._store = store.from_url(self.name)
        except Exception as error:
            raise TransportError(f"{self.name}: {_reason(error)}; check the address and the credentials") from error

    def manifest(self) -> bytes:
        """Return the manifest's bytes."""
        return self._get(FILE, MAX_MANIFEST)

    def layer(self, sha256: str, size: int) -> bytes:
        """Return a layer's bytes."""
        return self._get(layer_path(sha256), size)

    def _get(self, path: str, limit: int) -> bytes:
        try:
            raw = bytearray()
            for piece in self._store.get(path).stream(min_chunk_size=_PIECE):
                raw += piece
                if len(raw) > limit:
                    break
        except Exception as error:  # obstore has many classes of errors
            raise TransportError(f"{self.name}/{path}: {_reason(error)}") from error
        return bytes(raw[: limit + 1])


def _reason(error: BaseException) -> str:
    return " ".join(str(error).split())[:160] or type(error).__name__


def is_site_address(name: object) -> bool:
    """Return whether a name is the address of a site, not the path of a map."""
    return urlsplit(str(name)).scheme in ("zenoh", "http", "https", "s3", "gs", "az") and "://" in str(name)


def _body(answer: Any, limit: int, address: str) -> bytes:
    """Return the body of an answer, at most ``limit`` + 1 bytes; TransportError if it is cut off or too slow."""
    raw, begin = bytearray(), time.monotonic()
    promised = answer.length
    wanted = limit + 1 if promised is None else min(limit + 1, promised)
    try:
        while len(raw) < wanted and (piece := answer.read1(min(_PIECE, wanted - len(raw)))):
            raw += piece
            if time.monotonic() - begin > _PATIENCE + len(raw) / _SLOWEST:
                raise TransportError(f"{address}: is too slow, {len(raw)} bytes in {time.monotonic() - begin:.0f} s")
    except (OSError, ValueError, http.client.HTTPException) as error:
        raise TransportError(f"{address}: broke off ({error})") from error
    if promised is not None and len(raw) < wanted:
        raise TransportError(f"{address}: broke off after {len(raw)} of {promised} bytes")
    return bytes(raw)


class Mirror:
    """Cached copy of a site or of a part, from which maps are opened with or without a network.

    Layers are compared with their hashes before they are written, and the manifest with its signature if there is a
    key. The manifest is written last, so the mirror always holds a whole state; it also keeps the one opened last.

    Attributes:
        source: source of the site.
        directory: directory of the mirror, itself a site.
        around: circle whose tiles are fetched; None fetches all.
        offline: why the source could not be used the last time, else empty.
    """

    def __init__(self, source: SiteSource, verify_key: VerifyKey | None = None, around: Around | None = None) -> None:
        # does not contact the source yet
        self.source = source
        self.around = around
        self.offline = ""
        self._verify_key = verify_key
        self._known: tuple[bytes, Manifest] | None = None  # newest manifest read, and the hash of its bytes
        name = hashlib.sha256(source.name.encode()).hexdigest()[:32]
        self.directory = cache_folder() / "sites" / name
        self._store = TileStore(self.directory)

    @property
    def map_path(self) -> Path:
        """Path of the map: the mirror, or its part in the circle."""
        if self.around is None:
            return self.directory
        keys = Manifest.load(self.directory).tiles_around(self.around)
        return part_file(self.directory, keys, str(self.around))

    def open(self, progress: Progress | None = None) -> Path:
        """Update the mirror, or keep a good cached copy with a warning; return :attr:`map_path`.

        Raises:
            TransportError: the source cannot be reached, and the cache is empty.
            MapError: the source gave no site, damaged layers, or a manifest that is not signed with the key, and the
                cache has no whole copy with a valid signature.
        """
        try:
            self.refresh(progress, check=True)
        except (TransportError, MapError) as error:
            if not is_site(self.directory):
                raise
            try:
                cached = Manifest.load(self.directory, key=self._verify_key)
                wanted = self._wanted(cached)
            except MapError as damaged:
                raise MapError(f"{error}; and the copy that was fetched before: {damaged}") from error
            if isinstance(error, MapError) and not all(
                self._store.is_whole(layer.sha256, layer.bytes) for layer, _ in wanted.values()
            ):
                raise
            self.offline = str(error)
            warn(f"{error}; going on with the tiles fetched before, manifest {cached.sha256[:12]}")
        return self.map_path

    def _wanted(self, manifest: Manifest) -> dict[str, tuple[LayerEntry, TileEntry]]:
        """Return, by hash, the layers of the tiles in the circle, each with its tile."""
        keys = None if self.around is None else manifest.tiles_around(self.around)
        return {
            layer.sha256: (layer, tile)
            for tile in manifest.tiles
            if keys is None or (tile.column, tile.row) in keys
            for layer in tile.layers.values()
        }

    def _read(self, raw: bytes, name: str) -> Manifest:
        """Read a manifest, unless its bytes are those read last; errors as in :meth:`Manifest.from_bytes`."""
        digest = hashlib.sha256(raw).digest()
        if self._known is None or self._known[0] != digest:
            self._known = digest, Manifest.from_bytes(raw, name, self._verify_key)
        return self._known[1]

    def _asked(self, ask: Callable[[], bytes]) -> bytes:
        """Return the source's answer; TransportError for any failure."""
        try:
            return ask()
        except CoViewError:
            raise
        except Exception as error:  # a server may send anything
            raise TransportError(f"{self.source.name}: {type(error).__name__}: {_reason(error)}") from error

    def refresh(self, progress: Progress | None = None, check: bool = False) -> bool:
        """Ask the source, fetch missing layers, and return whether the site has changed; errors as in :meth:`open`.

        ``progress`` counts bytes. ``check`` compares existing layers with their hashes, not only with their lengths.
        """
        self.offline = ""
        with contextlib.suppress(OSError):
            os.utime(self.directory)  # marks it as recently used, for the cache
        raw = self._asked(self.source.manifest)
        manifest = self._read(raw, f"{self.source.name}/{FILE}")
        local, before = b"", None
        with contextlib.suppress(MapError):  # none yet
            local = read_manifest(self.directory)
            before = self._read(local, str(self.directory))
        wanted = self._wanted(manifest)
        if (size := sum(layer.bytes for layer, _ in wanted.values())) > cache_bound():  # a wrong manifest's too
            raise MapError(
                f"{self.source.name}: its tiles are {size / 1e9:.1f} GB, more than the cache may hold; open a part of "
                "it (--around X,Y,RADIUS), or set COVIEW_CACHE_GB"
            )
        exists = self._store.is_whole if check else self._store.holds
        missing = [(layer, tile) for layer, tile in wanted.values() if not exists(layer.sha256, layer.bytes)]
        done, total = 0, sum(layer.bytes for layer, _ in missing)
        for layer, tile in missing:
            for left in reversed(range(_TRIES)):
                try:
                    content = self._asked(partial(self.source.layer, layer.sha256, layer.bytes))
                    break
                except TransportError:
                    if not left:
                        raise
                    time.sleep(_WAIT * 2 ** (_TRIES - 2 - left))
            if len(content) != layer.bytes or hashlib.sha256(content).hexdigest() != layer.sha256:
                raise MapError(
                    f"{self.source.name}: a layer of tile {tile.column}, {tile.row} ({layer.sha256[:12]}) is not what "
                    "the manifest says: damaged or swapped; nothing of it is used. Build or copy the site again"
                )
            self._store.put(content)
            done += layer.bytes
            if progress:
                progress(done, total)
        changed, opened = before is None or before.sha256 != manifest.sha256, set[str]()
        if local != raw:
            self.directory.mkdir(parents=True, exist_ok=True)
            write_manifest(self.directory, raw)
            self._known = hashlib.sha256(raw).digest(), manifest
        if changed and before is not None:  # a process may still use the earlier state
            with contextlib.suppress(MapError):  # none was opened
                opened = Manifest.load(self.directory, OPENED).hashes()
            self._store.prune(manifest.hashes() | before.hashes() | opened)
        elif changed:
            evict(cache_folder(), self.directory)
        return changed or bool(missing)
