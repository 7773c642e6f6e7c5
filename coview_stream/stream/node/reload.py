"""Change of the map under a running node: the new one is loaded and tried beside the old one, then takes its place."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from coview_stream.errors import CoViewError
from coview_stream.localization.state import State
from coview_stream.stream.node.engine_process import CancelledError, DiedError, EngineRunner
from coview_stream.stream.node.node import Node
from coview_stream.stream.node.session import Session

log = logging.getLogger("coview_stream.node")

_MAX_HANDOVER = 60.0  # seconds that a robot keeps the old map while the new one has not verified its place; set by hand
_STEP = 0.02  # seconds between two looks, set by hand


class OpenedMap(NamedTuple):
    """A map with engines that are ready for jobs.

    Attributes:
        sha256: of the map.
        engines: by name.
        sessions: one per robot, in the node's order; none of them has had a message.
    """

    sha256: str
    engines: Mapping[str, EngineRunner]
    sessions: Sequence[Session]


class MapReloader:
    """Changes the map when asked to, one change at a time, on a thread of its own.

    Each robot keeps the old map, and its poses, until the new one has verified its place: both are given all messages
    meanwhile, and the place on the old map is a hypothesis on the new one. A robot that has no place changes at once,
    one that is not found on the new map after a minute changes without a place, and is searched for.

    Args:
        node: the node; its map is the old one.
        open_map: opens the new map; called with a function that says whether to give up.
        on_change: called with True when a change begins, with False when it is over.
        max_handover: seconds that a robot keeps the old map at most.

    Attributes:
        last: what became of the newest change: ``result`` (``none``, ``loading``, ``handing over``, ``changed``,
            ``unchanged`` or ``refused``), ``map_sha256`` and ``error``.
    """

    def __init__(
        self,
        node: Node,
        open_map: Callable[[Callable[[], bool]], OpenedMap | None],
        on_change: Callable[[bool], None] = lambda busy: None,
        max_handover: float = _MAX_HANDOVER,
    ) -> None:
        self._node = node
        self._open_map = open_map
        self._on_change = on_change
        self._max_handover = max_handover
        self._asked = threading.Event()
        self._busy = False
        self.last: dict[str, Any] = {"result": "none", "map_sha256": node.map_sha256, "error": None}

    @property
    def outcome(self) -> str:
        """What became of the newest change that was asked for: as of :attr:`last`, ``loading`` until it is over."""
        return "loading" if self._busy or self._asked.is_set() else str(self.last["result"])

    def request(self) -> dict[str, Any]:
        """Ask for a change; return what is known of the newest one. Asked for during a change, another one follows."""
        self._asked.set()
        return {"ok": True, "busy": self._busy, "last": dict(self.last)}

    def run(self, stopping: threading.Event) -> None:
        """Change the map whenever that is asked for, until ``stopping`` is set."""
        while not stopping.is_set():
            if not self._asked.wait(0.1):
                continue
            self._busy = True
            self._asked.clear()
            self._on_change(True)
            try:
                self._change(stopping)
            except Exception as error:  # the next one is to be answered all the same
                self._note("failed", repr(error))
                log.exception("the change of the map failed")
            finally:
                self._busy = False
                self._on_change(False)

    def _note(self, result: str, error: str | None = None) -> None:
        self.last = {"result": result, "map_sha256": self._node.map_sha256, "error": error}

    def _change(self, stopping: threading.Event) -> None:
        self._note("loading")
        log.info("loading the map again")
        try:
            opened = self._open_map(stopping.is_set)
        except CancelledError:
            return
        except (CoViewError, DiedError, OSError, MemoryError) as error:
            why = " ".join(str(error).split()) or type(error).__name__
            self._note("refused", why)
            log.error("the new map is refused, going on with the one before: %s", why)
            return
        except Exception as error:
            self._note("refused", repr(error))
            log.exception("the new map is refused, going on with the one before")
            return
        if opened is None:
            self._note("unchanged")
            log.info("the map has not changed")
            return
        self._note("handing over")
        begin = time.monotonic()
        try:
            for old, new in zip(self._node.sessions, opened.sessions, strict=True):
                new.begin_beside(old)
            self._node.add_map(self._node.make_feed(opened.sessions, opened.engines))
        except BaseException:
            for engine in opened.engines.values():
                engine.close()
            raise
        waiting = dict(enumerate(opened.sessions))
        while waiting and not stopping.wait(_STEP):
            for number, new in list(waiting.items()):
                verified = new.state()[0] is State.TRACKING
                known = self._node.sessions[number].state()[0].has_place
                if verified or not known or time.monotonic() - begin > self._max_handover:
                    self._node.switch_robot(number)
                    del waiting[number]
        if waiting:
            return  # the node ends, and all engines with it
        self._node.drop_map()
        self._note("changed")
        log.info("map %s is in force after %.1f s", opened.sha256[:16], time.monotonic() - begin)
