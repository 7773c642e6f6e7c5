"""Several maps as a node serves them: what changes at the source of any of them is taken over."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from coview_stream.basemap.joined.joined_names import write_names
from coview_stream.basemap.site.mirror import Mirror
from coview_stream.basemap.site.route import Whereabouts
from coview_stream.errors import TransportError


class ServedMaps:
    """Maps by name, of which some are mirrors of sites elsewhere; tiles of parts stay those of their circles.

    Attributes:
        map_path: what they are opened from, as one.
        route: None: no robot is followed.
    """

    route = None

    def __init__(self, maps: Sequence[tuple[str, Path]], mirrors: Sequence[Mirror]) -> None:
        """Take the maps' names and paths, and the mirrors among them, which have been opened."""
        self.map_path = write_names(maps)
        self._mirrors = mirrors

    @property
    def name(self) -> str:
        """Where those are that come from elsewhere, for messages."""
        return ", ".join(each.source.name for each in self._mirrors)

    @property
    def offline(self) -> str:
        """Why a source could not be asked the last time; empty where all could."""
        return "; ".join(each.offline for each in self._mirrors if each.offline)

    def refresh(self) -> bool:
        """Ask all sources, fetch what is missing, and return whether anything has changed.

        Raises:
            TransportError: one cannot be asked, and none has changed. MapError: what one gave is not what it should be.
        """
        changed, failed = False, None
        for mirror in self._mirrors:
            try:
                if mirror.refresh():
                    changed = True
                    _ = mirror.map_path  # a part's tiles may be others now
            except TransportError as error:
                mirror.offline, failed = str(error), error
        if failed is not None and not changed:
            raise failed
        return changed

    def follow(self, robots: Mapping[str, Whereabouts | None]) -> bool:
        """Return False: tiles do not follow robots here."""
        return False

    def close(self) -> None:
        """End connections."""
        for mirror in self._mirrors:
            mirror.source.close()
