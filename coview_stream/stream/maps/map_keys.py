"""Keys of map servers: ``{base}/maps/{site}/manifest``, ``.../layers/{sha256}`` and ``.../changed``."""

from __future__ import annotations

from dataclasses import dataclass

from coview_stream.stream.transport.keys import check_chunk, check_prefix


@dataclass(frozen=True)
class MapKeys:
    """The keys of one site.

    Attributes:
        prefix: of all of them.
    """

    prefix: str

    @classmethod
    def of(cls, site: str, base: str = "coview") -> MapKeys:
        """Return those of a site by its name; ConfigError where that is no chunk of a key."""
        return cls(f"{check_prefix(base, '--base')}/maps/{check_chunk(site, 'the name of a site')}")

    @property
    def manifest(self) -> str:
        """Answered with the manifest's bytes."""
        return f"{self.prefix}/manifest"

    def layer(self, sha256: str) -> str:
        """Answered with a layer's bytes."""
        return f"{self.prefix}/layers/{sha256}"

    @property
    def changed(self) -> str:
        """Published whenever the manifest changes: its sha256, as text."""
        return f"{self.prefix}/changed"

    @property
    def all(self) -> str:
        """Expression of all of them."""
        return f"{self.prefix}/**"
