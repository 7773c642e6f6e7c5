"""Follower of a site: has a node take over what has changed at its source, and the tiles that its robots come to."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from coview_stream.basemap.site.route import Place
from coview_stream.basemap.site.served_site import ServedSite
from coview_stream.errors import CoViewError, TransportError

log = logging.getLogger("coview_stream.maps")

PERIOD = 10.0
"""Seconds between two questions to the source; set by hand."""

_LOOK = 1.0  # seconds between two looks at where the robots are; set by hand


class MapFollower:
    """Asks a site's source now and then, and moves its tiles with the robots, on a thread of its own.

    Attributes:
        last: ``address``, ``result`` (``current``, ``fetched``, ``unreachable`` or ``refused``) and ``error``; where
            tiles follow robots, ``around`` has the x, y and radius of the circles.
    """

    def __init__(
        self,
        site: ServedSite,
        changed: Callable[[], object],
        robots: Callable[[], Mapping[str, Place | None]] = dict,
        busy: Callable[[], bool] = lambda: False,
        period: float = PERIOD,
    ) -> None:
        """Take a site.

        Args:
            site: the site.
            changed: called when it has changed.
            robots: returns where robots are or may be, in the frame of the site's sources.
            busy: tells whether a change is being taken over: the site is left as it is until then.
            period: seconds between two questions to the source.
        """
        self._site, self._changed, self._robots, self._busy, self._period = site, changed, robots, busy, period
        self.last: dict[str, Any] = {}
        self._note("unreachable" if site.offline else "current", site.offline or None)

    def run(self, stopping: threading.Event) -> None:
        """Follow until ``stopping`` is set; what goes wrong is logged once, and the map that is there is kept."""
        asked = time.monotonic()
        try:
            while not stopping.wait(min(_LOOK, self._period)):
                if self._busy():
                    continue
                if (now := time.monotonic()) - asked >= self._period:
                    asked = now
                    self._look(self._site.refresh)
                if self._site.route is not None and not self._busy():
                    self._look(lambda: self._site.follow(self._robots()), quiet=True)
        finally:
            self._site.close()

    def _look(self, ask: Callable[[], bool], quiet: bool = False) -> None:
        """Ask for changes and take them over; ``quiet``: that there is none is no news."""
        try:
            changed = ask()
        except (CoViewError, OSError) as error:
            text = " ".join(str(error).split())
            if text != self.last["error"]:
                log.error("%s; the map that is there is kept", text)
            self._note("unreachable" if isinstance(error, OSError | TransportError) else "refused", text)
            return
        if quiet and not changed:
            return
        if self.last["error"] and not self._site.offline:
            log.info("%s answers again", self._site.name)
        self._note("fetched" if changed else "current", self._site.offline or None)
        if changed:
            self._changed()

    def _note(self, result: str, error: str | None = None) -> None:
        self.last = {"address": self._site.name, "result": result, "error": error}
        if self._site.route is not None:
            self.last["around"] = [[each.x, each.y, each.radius] for each in self._site.route.circles()]
