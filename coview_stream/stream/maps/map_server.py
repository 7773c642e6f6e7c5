"""Map server: answers zenoh queries for the manifest and layers in a site's directory."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from coview_stream.basemap.site.manifest import Manifest, read_manifest
from coview_stream.basemap.site.store import TileStore
from coview_stream.errors import MapError
from coview_stream.stream.maps.zenoh_source import MapKeys
from coview_stream.stream.transport import zenoh_config
from coview_stream.stream.transport.error_guard import RateLimitedErrors

log = logging.getLogger("coview_stream.maps")

_LOOK = 1.0  # seconds between checks of the manifest file
_QUEUE, _OF_ONE = 256, 32  # waiting queries, in all and of one reader; more are refused, and clients repeat them
_ANSWERS = 8  # at once, one per reader: a stopped reader blocks a thread until zenoh drops it


class MapServer:
    """Serves one site: its manifest, and the layers in the present and the previous manifest; no other file."""

    def __init__(
        self,
        directory: Path,
        keys: MapKeys,
        connect: Sequence[str] = (),
        listen: Sequence[str] = (),
        config: Path | None = None,
    ) -> None:
        """Open a session and start answering; MapError for no site, TransportError without network."""
        import zenoh

        self._raw = read_manifest(directory)
        self.manifest = Manifest.from_bytes(self._raw, str(directory))
        self.answered = 0
        """Number of queries answered with data."""
        self.sent = 0
        """Bytes in these answers."""
        self._directory, self._keys = directory, keys
        self._store = TileStore(directory)
        self._layers = _sizes(self.manifest)
        self._guard = RateLimitedErrors(log)
        self._stopping = threading.Event()
        self._queries: deque[tuple[str, Any]] = deque()  # with the reader that sent each
        self._answering: set[str] = set()  # readers with an answer under way
        self._waiting = threading.Condition()
        self._counting = threading.Lock()
        with zenoh_config.zenoh_errors("zenoh session"):
            self._session: Any = zenoh.open(zenoh_config.compose(connect, listen, config))
            self._queryable: Any = self._session.declare_queryable(
                keys.all, zenoh.handlers.Callback(self._put, indirect=False), complete=True
            )
            self._publisher = self._session.declare_publisher(keys.changed)
        self._threads = [
            threading.Thread(target=work, name=f"coview {name}", daemon=True)
            for name, work in (*[("maps", self._answer_all)] * _ANSWERS, ("manifest", self._look))
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop the server."""
        self._stopping.set()
        with self._guard.catch("closing"):
            self._session.close()  # and everything declared on it
        with self._waiting:
            self._queries.clear()
            self._waiting.notify_all()
        end = time.monotonic() + 2.0
        for thread in self._threads:
            thread.join(max(0.0, end - time.monotonic()))

    def _put(self, query: Any) -> None:
        source = query.source_info
        reader = "" if source is None else str(source.source_id.zid)  # readers without an id count as one
        with self._waiting:
            own = sum(waiting == reader for waiting, _ in self._queries)
            if taken := own < _OF_ONE and len(self._queries) < _QUEUE:
                self._queries.append((reader, query))
                self._waiting.notify()
        if not taken:
            with self._guard.catch("refusing"):
                query.reply_err(b"too many queries wait: ask again")

    def _next(self) -> tuple[str, Any] | None:
        """Wait for a query from a reader without an answer under way; None at the end."""
        with self._waiting:
            while not self._stopping.is_set():
                for at, (reader, query) in enumerate(self._queries):
                    if reader not in self._answering:
                        del self._queries[at]
                        self._answering.add(reader)
                        return reader, query
                self._waiting.wait()
        return None

    def _answer_all(self) -> None:
        while (taken := self._next()) is not None:
            reader, query = taken
            with self._guard.catch("answering"), query:
                if query.key_expr.intersects(self._keys.manifest):
                    self._reply(query, self._keys.manifest, self._raw)
                key = str(query.key_expr)  # no wildcards for layers: one query could ask for the whole site
                sha256 = key.removeprefix(self._keys.layer(""))
                if sha256 != key and sha256 in self._layers:
                    try:
                        self._reply(query, key, self._store.get(sha256, self._layers[sha256]))
                    except MapError as error:
                        log.error("%s", error)
                        query.reply_err(str(error).encode())

            with self._waiting:
                self._answering.discard(reader)
                self._waiting.notify()

    def _reply(self, query: Any, key: str, raw: bytes) -> None:
        query.reply(key, raw)
        with self._counting:
            self.answered += 1
            self.sent += len(raw)

    def _look(self) -> None:
        refused, seen = "", self._raw
        while not self._stopping.wait(_LOOK):
            with self._guard.catch("looking at the manifest"):
                try:
                    raw = read_manifest(self._directory)
                    if raw == seen:
                        continue
                    seen = raw
                    manifest = Manifest.from_bytes(raw, str(self._directory))
                except MapError as error:
                    if str(error) != refused:
                        log.error("%s; going on with manifest %s", error, self.manifest.sha256[:12])
                    refused = str(error)
                    continue
                refused = ""
                if manifest == self.manifest:
                    continue
                self._layers = _sizes(self.manifest) | _sizes(manifest)  # clients may still fetch with the previous one
                self.manifest, self._raw = manifest, raw
                log.info("manifest %s is served now", manifest.sha256[:12])
                self._publisher.put(manifest.sha256)


def _sizes(manifest: Manifest) -> dict[str, int]:
    return {layer.sha256: layer.bytes for tile in manifest.tiles for layer in tile.layers.values()}
