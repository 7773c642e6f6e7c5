"""Follower of a map's source: has a node take over what has changed there, while its poses go on."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any

from coview_stream.basemap.site.mirror import Mirror
from coview_stream.errors import CoViewError

log = logging.getLogger("coview_stream.maps")

PERIOD = 10.0
"""Seconds between two questions to the source; set by hand."""


class MapFollower:
    """Asks a source now and then, on a thread of its own.

    Attributes:
        last: ``address``, ``result`` (``current``, ``fetched``, ``unreachable`` or ``refused``) and ``error``.
    """

    def __init__(self, mirror: Mirror, changed: Callable[[], object], period: float = PERIOD) -> None:
        """Take the mirror, and what is called when it has changed."""
        self._mirror, self._changed, self._period = mirror, changed, period
        self.last: dict[str, Any] = {}
        self._note("unreachable" if mirror.offline else "current", mirror.offline or None)

    def run(self, stopping: threading.Event) -> None:
        """Ask until ``stopping`` is set; what goes wrong is logged once, and the map that is there is kept."""
        try:
            while not stopping.wait(self._period):
                self._look()
        finally:
            self._mirror.source.close()

    def _look(self) -> None:
        try:
            fetched = self._mirror.refresh()
            if fetched:
                _ = self._mirror.map_path  # a part's tiles may be others now
        except (CoViewError, OSError) as error:
            result = "refused" if not isinstance(error, OSError) and "Transport" not in type(error).__name__ else ""
            text = " ".join(str(error).split())
            if text != self.last["error"]:
                log.error("%s; the map that is there is kept", text)
            self._note(result or "unreachable", text)
            return
        if self.last["error"]:
            log.info("%s answers again", self._mirror.source.name)
        self._note("fetched" if fetched else "current")
        if fetched:
            self._changed()

    def _note(self, result: str, error: str | None = None) -> None:
        self.last = {"address": self._mirror.source.name, "result": result, "error": error}
