"""Site as a node serves it: its changes are taken over, and of a part of it the tiles follow the node's robots."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from coview_stream.basemap.site.fetch import Mirror
from coview_stream.basemap.site.manifest import Around, Key, Manifest, keep_places, kept_places, part_file, tiles_around
from coview_stream.basemap.site.route import Route, Whereabouts
from coview_stream.errors import TransportError


class ServedSite:
    """A site in a directory or a mirror, whole or around some robots.

    Attributes:
        directory: of the site, or of its mirror.
        mirror: of a site elsewhere; None of one that is here.
        route: of the robots that its tiles follow; None where all tiles are served.
        map_path: what a map is opened from; its content changes with the route.
    """

    def __init__(self, directory: Path, mirror: Mirror | None = None, around: Around | None = None) -> None:
        """Take a site; of a mirror that has been opened.

        Args:
            directory: of the site, or of its mirror.
            mirror: of a site elsewhere.
            around: only the tiles in this circle at first, and later those around the robots; None for all.

        Raises:
            MapError: no tile is there. TransportError: what is missing cannot be fetched.
        """
        self.directory, self.mirror = directory, mirror
        self.route: Route | None = None
        self.map_path = directory
        self._keys: set[Key] = set()
        self._changed = False  # since the last answer of refresh or follow
        self._behind = False  # whether the tiles are not those of the route yet
        if around is not None:
            self._name = str(around)
            self.route = Route(around, kept_places(directory, self._name))
            if len(self.route.circles()) > 1:
                self._fetch(self.route)
            self._choose()
            self._changed = False

    @property
    def name(self) -> str:
        """Where the site is, for messages."""
        return str(self.directory) if self.mirror is None else self.mirror.source.name

    @property
    def offline(self) -> str:
        """Why its source could not be asked the last time; empty where it could, or where it is here."""
        return "" if self.mirror is None else self.mirror.offline

    def refresh(self) -> bool:
        """Ask the source, fetch what is missing, and return whether anything has changed since that was last told.

        Raises:
            TransportError: it cannot be asked. MapError: what it gave is not what it should be.
        """
        if self.mirror is not None:
            self._changed |= self.mirror.refresh()
        if self._changed or self._behind:
            self._choose()
        return self._told()

    def follow(self, robots: Mapping[str, Whereabouts | None]) -> bool:
        """Move the route on to where the robots are or may be, and return whether other tiles are wanted now.

        What cannot be fetched now :meth:`refresh` fetches later; meanwhile there is what there is.

        Raises:
            TransportError: nothing of it is there, and it cannot be fetched. MapError: no tile is there at all, or
                what came is not what it should be. :meth:`refresh` tries again.
        """
        if self.route is None or not self.route.move(robots):
            return False
        self._behind = True
        keep_places(self.directory, self._name, self.route.last_places())
        self._fetch(self.route)
        self._choose()
        return self._told()

    def close(self) -> None:
        """End connections, and leave no file of this process."""
        if self.mirror is not None:
            self.mirror.source.close()
        if self.route is not None:
            self.map_path.unlink(missing_ok=True)

    def _fetch(self, route: Route) -> None:
        if self.mirror is None:
            return
        self.mirror.circles = tuple(route.circles())
        try:
            self._changed |= self.mirror.refresh()
        except TransportError as error:
            self.mirror.offline = str(error)

    def _choose(self) -> None:
        """Write the file that names the tiles of the route that are there; other processes go other ways."""
        if self.route is None:
            return
        manifest = Manifest.load(self.directory)
        keys = tiles_around(manifest, *self.route.circles())
        if self.mirror is not None:
            keys &= self.mirror.fetched(manifest)
            if not keys:
                raise TransportError(self.mirror.offline or f"{self.name}: none of the tiles around the robots came")
        if keys != self._keys:
            self.map_path = part_file(self.directory, keys, f"{self._name} {os.getpid()}")
            self._keys, self._changed = keys, True
        self._behind = False

    def _told(self) -> bool:
        changed, self._changed = self._changed, False
        return changed
