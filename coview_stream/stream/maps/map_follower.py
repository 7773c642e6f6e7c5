"""Follower of remote sites: fetches their changes and makes a node load them."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from coview_stream.basemap.site.fetch import Mirror
from coview_stream.errors import TransportError
from coview_stream.stream.transport.error_guard import RateLimitedErrors, is_panic

log = logging.getLogger("coview_stream.maps")

PERIOD = 10.0
"""Seconds between requests to the source, and from a failed change to the next try."""

_LOOK = 1.0  # seconds between checks of a change's outcome
_MOST_DOUBLINGS = 5  # of the time to the next try or request
_HOUR = 3600.0  # seconds over which changes are counted: each doubles the time between requests
_SETTLED = ("changed", "unchanged")  # outcomes of a change that is over


class MapFollower:
    """Asks the sources of mirrored sites for changes, on its own thread.

    Attributes:
        last: outcome: ``address``, ``result`` (``current``, ``fetched``, ``unreachable`` or ``refused``), ``error``.
    """

    def __init__(
        self,
        mirrors: Sequence[Mirror],
        take_over: Callable[[], object],
        outcome: Callable[[], str] = lambda: "changed",
        period: float = PERIOD,
    ) -> None:
        """Follow the opened mirrors of all sites of the node's map, asking their sources every ``period`` seconds.

        Each change within an hour doubles the time between requests, up to 32 times. ``take_over`` asks the node to
        load the map again. ``outcome`` returns the result: ``changed``, ``unchanged``, ``loading`` (mirrors stay as
        they are meanwhile), or another word for a failure. A failed change is tried again, with growing delays.
        """
        self._mirrors, self._take_over, self._outcome = mirrors, take_over, outcome
        self._period = period
        self._guard = RateLimitedErrors(log)
        self._asked, self._again_at, self._tries, self._pending = time.monotonic(), 0.0, 0, False
        self._changes: deque[float] = deque(maxlen=_MOST_DOUBLINGS)  # times of the newest changes
        self.name = ", ".join(mirror.source.name for mirror in mirrors)
        self.last: dict[str, Any] = {}
        self._note("unreachable" if self._offline else "current", self._offline or None)

    @property
    def _offline(self) -> str:
        return "; ".join(mirror.offline for mirror in self._mirrors if mirror.offline)

    def run(self, stopping: threading.Event) -> None:
        """Follow until ``stopping`` is set; an error is logged once, and the present map stays."""
        try:
            while not stopping.wait(min(_LOOK, self._period)):
                with self._guard.catch(self.name):
                    self._turn()
        finally:
            for mirror in self._mirrors:
                with self._guard.catch(mirror.source.name):
                    mirror.source.close()

    def _turn(self) -> None:
        now, outcome = time.monotonic(), self._outcome()
        if outcome == "loading":
            return
        if outcome in _SETTLED:
            self._pending, self._tries = False, 0
        changed = False
        recent = sum(now - at < _HOUR for at in self._changes)  # a source may alternate, and each change starts engines
        if now - self._asked >= self._period * 2**recent:
            self._asked = now
            changed = self._refresh()
        if changed:
            self._tries = 0
            self._changes.append(now)
        elif not self._pending or now < self._again_at:
            return
        log.info("%s: %s", self.name, "it has changed" if changed else "once more")
        self._pending, self._again_at = True, now + self._period * 2 ** min(self._tries, _MOST_DOUBLINGS)
        self._tries += 1
        self._take_over()

    def _refresh(self) -> bool:
        """Fetch changes and return whether there are any."""
        changed, failure = False, None
        for mirror in self._mirrors:
            try:
                if mirror.refresh():
                    changed = True
                    _ = mirror.map_path  # chooses the tiles of a part again
            except BaseException as error:  # of any kind: the thread must continue
                if not (isinstance(error, Exception) or is_panic(error)):
                    raise
                mirror.offline, failure = str(error) or type(error).__name__, error
        if failure is not None and not changed:
            text = " ".join((str(failure) or type(failure).__name__).split())
            if text != self.last["error"]:
                log.error("%s; the map that is there is kept", text)
            self._note("unreachable" if isinstance(failure, OSError | TransportError) else "refused", text)
            return False
        if self.last["error"] and not self._offline:
            log.info("%s answers again", self.name)
        self._note("fetched" if changed else "current", self._offline or None)
        return changed

    def _note(self, result: str, error: str | None = None) -> None:
        self.last = {"address": self.name, "result": result, "error": error}
