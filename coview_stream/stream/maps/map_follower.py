"""Follower of a site: has a node take over what has changed at its source, and the tiles that its robots come to."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from coview_stream.basemap.joined import ServedMaps
from coview_stream.basemap.site.route import Whereabouts
from coview_stream.basemap.site.served_site import ServedSite
from coview_stream.errors import CoViewError, TransportError

log = logging.getLogger("coview_stream.maps")

PERIOD = 10.0
"""Seconds between two questions to the source, and from a change that failed to the next try; set by hand."""

_LOOK = 1.0  # seconds between two looks at where the robots are; set by hand
_MOST_DOUBLINGS = 5  # of the time to the next try
_TAKEN = ("changed", "unchanged")


class MapFollower:
    """Asks a site's source now and then, and moves its tiles with the robots, on a thread of its own.

    Attributes:
        last: ``address``, ``result`` (``current``, ``fetched``, ``unreachable`` or ``refused``) and ``error``; where
            tiles follow robots, ``around`` has the x, y and radius of the circles.
    """

    def __init__(
        self,
        site: ServedSite | ServedMaps,
        take_over: Callable[[], object],
        robots: Callable[[], Mapping[str, Whereabouts | None]] = dict,
        outcome: Callable[[], str] = lambda: "changed",
        period: float = PERIOD,
    ) -> None:
        """Take a site.

        Args:
            site: the site, or several maps as one.
            take_over: asks for its change to be taken over.
            robots: returns where robots are or may be, in the frame of the site's sources.
            outcome: says what became of that: ``changed``, ``unchanged``, that it failed, or ``loading`` until then,
                while the site is left as it is. A change that failed is asked for again, each time later.
            period: seconds between two questions to the source.
        """
        self._site, self._take_over, self._robots, self._outcome = site, take_over, robots, outcome
        self._period = period
        self._pending = False  # a change that has not been taken over yet
        self.last: dict[str, Any] = {}
        self._note("unreachable" if site.offline else "current", site.offline or None)

    def run(self, stopping: threading.Event) -> None:
        """Follow until ``stopping`` is set; what goes wrong is logged once, and the map that is there is kept."""
        asked, tries, again_at = time.monotonic(), 0, 0.0
        try:
            while not stopping.wait(min(_LOOK, self._period)):
                now, outcome = time.monotonic(), self._outcome()
                if outcome == "loading":
                    continue
                if outcome in _TAKEN:
                    self._pending, tries = False, 0
                changed = self._site.route is not None and self._look(self._moved, quiet=True)
                if not changed and now - asked >= self._period:
                    asked = now
                    changed = self._look(self._site.refresh)
                if changed:
                    tries = 0
                elif not self._pending or now < again_at:
                    continue
                log.info(
                    "%s: %s", self._site.name, "other tiles are wanted, or it has changed" if changed else "once more"
                )
                self._pending, again_at = True, now + self._period * 2 ** min(tries, _MOST_DOUBLINGS)
                tries += 1
                self._take_over()
        finally:
            self._site.close()

    def _moved(self) -> bool:
        return self._site.follow(self._robots())

    def _look(self, ask: Callable[[], bool], quiet: bool = False) -> bool:
        """Ask for changes and return whether there are any; ``quiet``: that there are none is no news."""
        try:
            changed = ask()
        except (CoViewError, OSError) as error:
            text = " ".join(str(error).split())
            if text != self.last["error"]:
                log.error("%s; the map that is there is kept", text)
            self._note("unreachable" if isinstance(error, OSError | TransportError) else "refused", text)
            return False
        if quiet and not changed:
            return False
        if self.last["error"] and not self._site.offline:
            log.info("%s answers again", self._site.name)
        self._note("fetched" if changed else "current", self._site.offline or None)
        return changed

    def _note(self, result: str, error: str | None = None) -> None:
        self.last = {"address": self._site.name, "result": result, "error": error}
        if self._site.route is not None:
            self.last["around"] = [[each.x, each.y, each.radius] for each in self._site.route.circles()]
