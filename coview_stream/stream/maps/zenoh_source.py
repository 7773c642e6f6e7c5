"""Source for a site on a zenoh map server."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from coview_stream.basemap.site.manifest import MAX_LAYER, MAX_MANIFEST
from coview_stream.errors import TransportError
from coview_stream.stream.transport import zenoh_config
from coview_stream.stream.transport.keys import check_chunk, check_prefix

_NO_ANSWER, _UNREACHABLE = "Timeout", "Unable to connect"  # zenoh's words
_MAX_MESSAGE = MAX_LAYER + (1 << 20)  # bytes of an answer with its framing; no manifest is larger either
_MAX_SITES = 100  # sites that are asked for their names
_TIMEOUT = 30.0  # seconds for an answer: 256 MB at 10 MB/s


@dataclass(frozen=True)
class MapKeys:
    """The zenoh keys of one site."""

    prefix: str  # of all its keys

    @classmethod
    def of(cls, site: str, base: str = "coview") -> MapKeys:
        """Return the keys of a site; ConfigError if its name cannot be part of a key."""
        return cls(f"{check_prefix(base, '--base')}/maps/{check_chunk(site, 'the name of a site')}")

    @property
    def manifest(self) -> str:
        """Key that is answered with the manifest's bytes."""
        return f"{self.prefix}/manifest"

    def layer(self, sha256: str) -> str:
        """Key that is answered with a layer's bytes."""
        return f"{self.prefix}/layers/{sha256}"

    @property
    def changed(self) -> str:
        """Key on which the manifest's sha256 is published, as text, when the manifest changes."""
        return f"{self.prefix}/changed"

    @property
    def all(self) -> str:
        """Key expression that matches all of them."""
        return f"{self.prefix}/**"


class ZenohSource:
    """A site on a map server; the first query opens the zenoh session."""

    def __init__(
        self, site: str, base: str = "coview", connect: Sequence[str] = (), config: Path | None = None
    ) -> None:
        """Take a site's name and zenoh endpoints; ConfigError if the name cannot be part of a key."""
        # the mirror's name holds everything that selects the site
        parts = [*connect, *([] if config is None else [str(config)]), *([] if base == "coview" else [f"base {base}"])]
        where = ",".join(parts)
        self.name = f"zenoh://{site}" + (f" ({where})" if where else "")
        self._keys = MapKeys.of(site, base)
        self._connect, self._config = connect, config
        self._session: Any = None

    def manifest(self) -> bytes:
        """Return the manifest's bytes. TransportError: no server answers."""
        return self._get(self._keys.manifest, MAX_MANIFEST)

    def layer(self, sha256: str, size: int) -> bytes:
        """Return a layer's bytes. TransportError: no server answers, or it cannot read the layer."""
        return self._get(self._keys.layer(sha256), size)

    def close(self) -> None:
        """Close the session."""
        session, self._session = self._session, None
        if session is not None:
            with zenoh_config.zenoh_errors("zenoh session"):
                session.close()

    def _get(self, key: str, limit: int) -> bytes:
        import zenoh

        if self._session is None:
            configuration = zenoh_config.compose(self._connect, (), self._config, max_message=_MAX_MESSAGE)
            try:
                with zenoh_config.zenoh_errors(self.name):
                    self._session = zenoh.open(configuration)
            except TransportError as error:
                if _UNREACHABLE not in str(error):
                    raise
                raise TransportError(f"{self.name}: nothing answers there; is serve-map running?") from error
        with zenoh_config.zenoh_errors(self.name):
            refusal = ""
            own = zenoh.SourceInfo(self._session.id, 0)  # servers answer each reader in turn
            target = zenoh.QueryTarget.BEST_MATCHING
            for reply in self._session.get(key, timeout=_TIMEOUT, target=target, source_info=own):
                if reply.ok is None:
                    refusal = bytes(reply.err.payload)[:300].decode(errors="replace").replace(_NO_ANSWER, "")
                    continue
                if len(reply.ok.payload) > limit:
                    raise TransportError(f"{self.name}: the answer has {len(reply.ok.payload)} bytes, {limit} at most")
                return bytes(reply.ok.payload)
        raise TransportError(f"{self.name}: {refusal or self._silence()}")

    def _silence(self) -> str:
        """Return why no answer came: the server has other sites, or no server answers."""
        import zenoh

        begin, end = self._keys.prefix.rpartition("/")[0] + "/", "/manifest"
        with zenoh_config.zenoh_errors(self.name):
            replies = self._session.get(f"{begin}*{end}", timeout=_TIMEOUT, target=zenoh.QueryTarget.ALL)
            # one at a time: each holds a manifest
            keys = [str(reply.ok.key_expr) for reply in islice(replies, _MAX_SITES) if reply.ok is not None]
        others = sorted({key.removeprefix(begin).removesuffix(end) for key in keys})
        if others and self._keys.manifest not in keys:
            return f"no map server there has it; there are {', '.join(others)[:200]}"
        return "no map server answers; is serve-map running there?"
